//! Why photographs, or one of them, cannot be registered.

use sixfold_geometry::{CameraError, OptionError};
use thiserror::Error;

/// Why a photograph has no pose. Photographs are numbered from 0.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum LeftOut {
    /// Too few features.
    FewFeatures {
        /// How many it has.
        found: usize,
        /// How many are needed.
        minimum: usize,
    },
    /// Too few matches with any other photograph.
    FewMatches {
        /// The largest number of matches with another photograph that agree with one camera motion.
        found: usize,
        /// How many are needed.
        minimum: usize,
    },
    /// It matches other photographs, but none of the largest group.
    OtherGroup {
        /// The photographs of its group.
        group: Vec<usize>,
    },
    /// Too few of its features agree with the points of the other photographs.
    FewInliers {
        /// How many agree.
        found: usize,
        /// Number of features with known points.
        of: usize,
    },
}

impl LeftOut {
    /// The reason in words; `name` returns the name of a photograph.
    pub fn reason(&self, name: &dyn Fn(usize) -> String) -> String {
        match self {
            LeftOut::FewFeatures { found, minimum } => {
                format!("{found} features, expected at least {minimum}: blurred, or without texture?")
            }
            LeftOut::FewMatches { found, minimum } => format!(
                "at most {found} features match another photograph, expected at least {minimum}: blurred, \
                 or taken too far from the others?"
            ),
            LeftOut::OtherGroup { group } => {
                let others: Vec<String> = group.iter().map(|i| name(*i)).collect();
                let listed = others.iter().take(4).cloned().collect::<Vec<_>>().join(", ");
                let more =
                    if others.len() > 4 { format!(" and {} more", others.len() - 4) } else { String::new() };
                format!(
                    "matches only {listed}{more}: photographs between this group and the others are missing"
                )
            }
            LeftOut::FewInliers { found, of } => format!(
                "{found} of {of} features lie where the other photographs say: did something move, or is it blurred?"
            ),
        }
    }
}

/// Why photographs cannot be registered.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum SfmError {
    /// Too few photographs.
    #[error("{found} photographs match each other, expected at least {minimum}")]
    TooFew {
        /// How many match.
        found: usize,
        /// How many are needed.
        minimum: usize,
        /// For each photograph, why it does not match; `None` for those that match.
        left_out: Vec<Option<LeftOut>>,
    },
    /// The camera only rotated.
    #[error(
        "all photographs are taken from one place: the largest angle between two rays to one point is {degrees:.2} degrees, expected \
         at least {minimum:.1}; walk around the object"
    )]
    NoBaseline {
        /// The largest median angle of a pair.
        degrees: f64,
        /// What is needed.
        minimum: f64,
    },
    /// Lists of different lengths, or a match beyond a photograph's features.
    #[error("matches of photographs {first} and {second}: {what}")]
    Matches {
        /// The first photograph.
        first: usize,
        /// The second.
        second: usize,
        /// The values found and expected.
        what: String,
    },
    /// The receiver of the progress reports asked to stop.
    #[error("stopped")]
    Stopped,
    /// The camera is invalid.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// An option is out of range.
    #[error(transparent)]
    Option(#[from] OptionError),
}
