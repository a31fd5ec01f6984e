//! Simulated trials of grasps as the command line sets them: gripper, mass and friction, the usual setting and a hard one.

use anyhow::{Context, Result};
use clap::Args;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sixfold_geometry::Pose;
use sixfold_geometry::random::normal;
use sixfold_grasp::Gripper;
use sixfold_render::DepthSensor;
use sixfold_simulation::{AttemptOptions, AttemptOutcome, TrialOptions};

use super::gripper::gripper;

/// Mass of an object in the usual setting and in the hard one, kg.
const MASS: f64 = 0.2;
const HARD_MASS: f64 = 0.5;

/// Numbers of the simulated trial.
#[derive(Debug, Args)]
pub struct PhysicsArguments {
    /// Gripper: jaws-140, jaws-85, or a file
    #[arg(long, value_name = "NAME_OR_FILE", default_value = "jaws-140")]
    pub gripper: String,
    /// Mass of the objects, kg (default: 0.2; with --hard, where there is that, 0.5)
    #[arg(long, value_name = "KG")]
    pub mass: Option<f64>,
    /// Friction coefficient of the pads (default: the gripper's)
    #[arg(long, value_name = "MU")]
    pub friction: Option<f64>,
    /// Force of each finger, newtons (default: the gripper's)
    #[arg(long, value_name = "N")]
    pub force: Option<f64>,
}

/// Gripper and trial as the command line sets them, tested.
///
/// # Errors
/// When the gripper is not known, or a number makes no trial.
pub fn physics(a: &PhysicsArguments) -> Result<(Gripper, TrialOptions)> {
    let mut gripper = gripper(&a.gripper)?;
    gripper.friction = a.friction.unwrap_or(gripper.friction);
    gripper.force = a.force.unwrap_or(gripper.force);
    gripper.check(&a.gripper).context("--friction and --force change the gripper")?;
    let options = TrialOptions { mass: a.mass.unwrap_or(MASS), ..TrialOptions::default() };
    options.check()?;
    Ok((gripper, options))
}

/// With what scenes are made and grasps are tried.
pub struct Hardness {
    /// The gripper as whoever proposes knows it.
    pub gripper: Gripper,
    /// The gripper as it is.
    pub real: Gripper,
    /// Sensor, planner and trial.
    pub options: AttemptOptions,
    /// Standard deviations of the hand's position (metres) and orientation (radians) from where it was sent.
    pub error: Option<(f64, f64)>,
}

impl Hardness {
    /// Where the hand goes when it is sent somewhere; the same deviation for the same seed.
    pub fn reached(&self, world_from_gripper: &Pose, seed: u64) -> Pose {
        let Some((position, orientation)) = self.error else { return *world_from_gripper };
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(u64::from(u32::MAX));
        let mut draw = |deviation: f64| deviation * f64::from(normal(&mut random));
        let shift = [draw(position), draw(position), draw(position)];
        let turn = [draw(orientation), draw(orientation), draw(orientation)];
        // In the hand's own frame, about its tips.
        *world_from_gripper * Pose::exp(&[shift[0], shift[1], shift[2], turn[0], turn[1], turn[2]].into())
    }
}

/// The usual setting, or the hard one.
///
/// # Errors
/// As [`physics`].
pub fn hardness(a: &PhysicsArguments, hard: bool) -> Result<Hardness> {
    let (gripper, mut trial) = physics(a)?;
    let mut options = AttemptOptions::default();
    let mut real = gripper.clone();
    let mut error = None;
    if hard {
        // A --friction that was asked for is known to both.
        real.friction = a.friction.unwrap_or(0.25);
        trial.mass = a.mass.unwrap_or(HARD_MASS);
        error = Some((0.005, 3f64.to_radians()));
        let kinect = DepthSensor::kinect();
        options.sensor = Some(DepthSensor {
            axial_base: 2.0 * kinect.axial_base,
            axial_growth: 2.0 * kinect.axial_growth,
            lateral: 1.5 * kinect.lateral,
            edge_loss: 0.8,
            ..kinect
        });
    }
    options.trial = trial;
    Ok(Hardness { gripper, real, options, error })
}

/// The word for an ending in files and tables.
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
    fn what_was_asked_for_holds_in_the_hard_setting_too() {
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
