//! From experiences to grasps for the current view (dissertation, section 6.2.3).

mod align;
mod combine;
mod fit;
mod grasps;
mod memory;
mod propose;
mod shapes;
mod upright;

pub use align::{AlignmentHypothesis, ExperienceAlignmentOptions, Transferred, transfer};
pub use combine::{
    Kind, Ranked, rank, rank_as_published, rank_by_agreement, rank_by_outcome, rank_experience_as_published,
    rank_on_part,
};
pub use grasps::{GraspsError, RankedGrasps, grasps_as_published, grasps_from_experience};
pub use memory::Memory;
pub use propose::{Proposal, Proposals, ProposeError, ProposeOptions, propose};
