//! Simulated grasp trials as configured on the command line: gripper, mass and friction, the usual setting and a hard one.

use anyhow::{Context, Result};
use clap::Args;
use sixfold_grasp::Gripper;
pub use sixfold_simulation::Hardness;
use sixfold_simulation::{AttemptOutcome, TrialOptions};

use super::gripper::gripper;

/// Mass of an object in the usual setting, kg.
const MASS: f64 = 0.2;

/// Numbers of the simulated trial.
#[derive(Debug, Args)]
pub struct PhysicsArguments {
    /// Gripper: jaws-140, jaws-85, or a file
    #[arg(long, value_name = "NAME_OR_FILE", default_value = "jaws-140")]
    pub gripper: String,
    /// Mass of the objects, kg (default: 0.2; 0.5 where --hard is given)
    #[arg(long, value_name = "KG")]
    pub mass: Option<f64>,
    /// Friction coefficient of the pads (default: the gripper's)
    #[arg(long, value_name = "MU")]
    pub friction: Option<f64>,
    /// Force of each finger, newtons (default: the gripper's)
    #[arg(long, value_name = "N")]
    pub force: Option<f64>,
}

/// Gripper and trial options from the command line, checked.
///
/// # Errors
/// When the gripper is unknown, or a number is out of range.
pub fn physics(a: &PhysicsArguments) -> Result<(Gripper, TrialOptions)> {
    let mut gripper = gripper(&a.gripper)?;
    gripper.friction = a.friction.unwrap_or(gripper.friction);
    gripper.force = a.force.unwrap_or(gripper.force);
    gripper.check(&a.gripper).context("--friction and --force change the gripper")?;
    let options = TrialOptions { mass: a.mass.unwrap_or(MASS), ..TrialOptions::default() };
    options.check()?;
    Ok((gripper, options))
}

/// The usual setting, or the hard one.
///
/// # Errors
/// As [`physics`].
pub fn hardness(a: &PhysicsArguments, hard: bool) -> Result<Hardness> {
    let (gripper, trial) = physics(a)?;
    if !hard {
        return Ok(Hardness::usual(gripper, trial));
    }
    let mut setting = Hardness::hard(gripper, trial);
    // An explicit --friction or --mass takes precedence.
    setting.real.friction = a.friction.unwrap_or(setting.real.friction);
    setting.options.trial.mass = a.mass.unwrap_or(setting.options.trial.mass);
    Ok(setting)
}

/// The word for an outcome in files and tables.
pub fn outcome_name(ending: AttemptOutcome) -> String {
    match serde_json::to_value(ending) {
        Ok(serde_json::Value::String(word)) => word,
        Ok(serde_json::Value::Object(map)) => {
            map.values().next().and_then(|v| v.as_str()).unwrap_or("tried").to_owned()
        }
        _ => format!("{ending:?}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn explicit_options_hold_in_the_hard_setting_too() {
        let of = |mass, friction, hard| {
            let arguments = PhysicsArguments { gripper: "jaws-140".to_owned(), mass, friction, force: None };
            let set = hardness(&arguments, hard).unwrap();
            (set.options.trial.mass, set.real.friction)
        };
        let usual = Gripper::built_in("jaws-140").unwrap().friction;
        assert_eq!(of(None, None, false), (0.2, usual));
        assert_eq!(of(None, None, true), (0.5, 0.25));
        assert_eq!(of(Some(0.2), Some(0.4), true), (0.2, 0.4));
        assert_eq!(of(Some(0.3), None, false), (0.3, usual));
    }
}
