//! A grasp that was tried, successful or not.

use serde::{Deserialize, Serialize};
use sixfold_grasp::{AntipodalQuality, GraspDescription};

/// A grasp that was tried.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Attempt {
    /// Its description before the trial.
    pub description: GraspDescription,
    /// The fraction of experience that agreed with the grasp, 0 to 1.
    pub agreement: f64,
    /// Whether it was transferred from experience; otherwise the planner proposed it.
    pub transferred: bool,
    /// Whether the grasp held the object.
    pub held: bool,
    /// The gripper's name: attempts with one gripper say little about another.
    pub gripper: String,
    /// The object's name.
    pub object: String,
    /// Seconds since 1970.
    pub time: i64,
    /// Origin of the attempt.
    pub provenance: String,
}

impl Attempt {
    /// The attempt with its numbers rounded to a millionth, so that writing them as text and reading them again does not change
    /// them.
    pub fn rounded(mut self) -> Attempt {
        let d = &mut self.description;
        let q = &mut d.quality;
        for v in [
            &mut q.alignment,
            &mut q.support,
            &mut q.centring,
            &mut q.observed,
            &mut d.overlap,
            &mut d.lever,
            &mut d.above_middle,
            &mut self.agreement,
        ] {
            *v = (*v * 1e6).round() / 1e6;
        }
        d.table_room = d.table_room.map(|v| (v * 1e6).round() / 1e6);
        self
    }

    /// Tests that all its numbers are finite.
    ///
    /// # Errors
    /// The name of the first field that is not finite.
    pub fn check(&self) -> Result<(), &'static str> {
        let GraspDescription { quality: q, overlap, lever, above_middle, table_room } = &self.description;
        let AntipodalQuality { alignment, support, centring, observed } = q;
        for (name, value) in [
            ("alignment", alignment),
            ("support", support),
            ("centring", centring),
            ("observed", observed),
            ("overlap", overlap),
            ("lever", lever),
            ("above_middle", above_middle),
            ("table_room", table_room.as_ref().unwrap_or(&0.0)),
            ("agreement", &self.agreement),
        ] {
            if !value.is_finite() {
                return Err(name);
            }
        }
        Ok(())
    }
}
