//! A grasp that was tried, whatever came of it.

use serde::{Deserialize, Serialize};
use sixfold_grasp::{AntipodalQuality, GraspDescription};

/// A grasp that was tried.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Attempt {
    /// What was known of it before.
    pub description: GraspDescription,
    /// The fraction of experience that agreed with it, 0 to 1.
    pub share: f64,
    /// It was transferred from experience; else the planner proposed it.
    pub transferred: bool,
    /// Whether it held.
    pub held: bool,
    /// The gripper's name: attempts of one say little of another.
    pub gripper: String,
    /// What was grasped.
    pub object: String,
    /// Seconds since 1970.
    pub time: i64,
    /// Where it comes from.
    pub provenance: String,
}

impl Attempt {
    /// The attempt with its numbers rounded to a millionth, so that they survive being written as text and read again.
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
            &mut self.share,
        ] {
            *v = (*v * 1e6).round() / 1e6;
        }
        d.table_room = d.table_room.map(|v| (v * 1e6).round() / 1e6);
        self
    }

    /// Tests that all its numbers are finite.
    ///
    /// # Errors
    /// The name of the first field that holds no finite number.
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
            ("share", &self.share),
        ] {
            if !value.is_finite() {
                return Err(name);
            }
        }
        Ok(())
    }
}
