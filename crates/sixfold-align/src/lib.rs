//! Does a pose agree with an image? A depth image prepared once for every method, verification by rendering, ICP of a rendered
//! mesh against measured depth, and the outline of a mesh aligned with a colour image. How hypotheses arise is not known here.

#![warn(unreachable_pub, unnameable_types)]
// `!(x > 0.0)` refuses NaN, `x <= 0.0` does not: that is what the checks here mean.
#![allow(clippy::neg_cmp_op_on_partial_ord)]

mod depth_icp;
pub mod evidence;
mod mesh;
pub mod outline;
mod prepared;
pub mod verification;
mod verify;

pub use depth_icp::{AlignedToDepth, align_to_depth};
pub use evidence::{ColorEvidence, ColorGradients, DepthEvidence, Evidence, EvidenceCollector};
pub use mesh::{VerificationMesh, VerificationMeshError, could_be_simplified, verification_mesh};
pub use prepared::{DepthOptions, DepthRegion, PreparedDepth, PreparedDepthError};
pub use verification::{VerificationOptions, VerificationScore, Verifier};
pub use verify::{VerifiedPose, refine, verify};
