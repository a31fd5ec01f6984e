//! Settings of simulated scenes and trials: a usual one, and a hard one in which sensor, gripper and object are worse than the
//! planner assumes.

use sixfold_geometry::Pose;
use sixfold_geometry::random::{normal, stream};
use sixfold_grasp::Gripper;
use sixfold_render::DepthSensor;

use crate::{AttemptOptions, TrialOptions};

/// Mass of an object in the hard setting, kg.
const HARD_MASS: f64 = 0.5;
/// Friction coefficient of the pads in the hard setting, unknown to the planner.
const HARD_FRICTION: f64 = 0.25;

/// Settings of simulated scenes and trials.
#[derive(Debug, Clone)]
pub struct Hardness {
    /// The gripper that the planner assumes.
    pub gripper: Gripper,
    /// The actual gripper in the trial.
    pub real: Gripper,
    /// Sensor, planner and trial.
    pub options: AttemptOptions,
    /// Standard deviations of the errors of the gripper's position (metres) and orientation (radians) relative to the commanded
    /// pose.
    pub error: Option<(f64, f64)>,
}

impl Hardness {
    /// The usual setting: a gripper that reaches the commanded pose exactly, and the friction that the planner assumes.
    pub fn usual(gripper: Gripper, trial: TrialOptions) -> Hardness {
        let options = AttemptOptions { trial, ..AttemptOptions::default() };
        Hardness { real: gripper.clone(), gripper, options, error: None }
    }

    /// The hard setting: twice the sensor noise and lost edges, errors of the gripper's pose of 5 mm and 3 degrees (standard
    /// deviation per axis), friction of 0.25, unknown to the planner, and objects of 0.5 kg.
    pub fn hard(gripper: Gripper, trial: TrialOptions) -> Hardness {
        let mut setting = Hardness::usual(gripper, TrialOptions { mass: HARD_MASS, ..trial });
        setting.real.friction = HARD_FRICTION;
        setting.error = Some((0.005, 3f64.to_radians()));
        let kinect = DepthSensor::kinect();
        setting.options.sensor = Some(DepthSensor {
            axial_base: 2.0 * kinect.axial_base,
            axial_growth: 2.0 * kinect.axial_growth,
            lateral: 1.5 * kinect.lateral,
            edge_loss: 0.8,
            ..kinect
        });
        setting
    }

    /// The pose that the gripper reaches for a commanded pose; the same seed gives the same error.
    pub fn reached(&self, world_from_gripper: &Pose, seed: u64) -> Pose {
        let Some((position, orientation)) = self.error else { return *world_from_gripper };
        let mut random = stream(seed, u64::from(u32::MAX));
        let mut draw = |deviation: f64| deviation * f64::from(normal(&mut random));
        let shift = [draw(position), draw(position), draw(position)];
        let turn = [draw(orientation), draw(orientation), draw(orientation)];
        // In the gripper's own frame, about its tips.
        *world_from_gripper * Pose::exp(&[shift[0], shift[1], shift[2], turn[0], turn[1], turn[2]].into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::Vec3;

    #[test]
    fn the_hand_errs_in_the_hard_setting_alone_and_the_same_for_the_same_seed() {
        let gripper = || Gripper::built_in("jaws-140").unwrap();
        let sent = Pose::from_translation(Vec3::new(0.1, 0.2, 0.3));
        let usual = Hardness::usual(gripper(), TrialOptions::default());
        assert_eq!(usual.reached(&sent, 1), sent);
        let hard = Hardness::hard(gripper(), TrialOptions::default());
        assert_eq!(hard.reached(&sent, 1), hard.reached(&sent, 1));
        let moved: Vec<f64> = (0..200).map(|seed| hard.reached(&sent, seed).distance_to(&sent)).collect();
        // The mean length of a vector of three normal numbers with a standard deviation of 5 mm is 8 mm.
        let mean = moved.iter().sum::<f64>() / 200.0;
        assert!((mean - 0.008).abs() < 0.001, "{mean}");
        assert_eq!((hard.gripper.friction, hard.real.friction), (gripper().friction, HARD_FRICTION));
        assert_eq!((usual.options.trial.mass, hard.options.trial.mass), (0.2, HARD_MASS));
    }
}
