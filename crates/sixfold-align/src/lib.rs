//! Agreement of poses with images: a depth image prepared once for all methods, verification by rendering, ICP of a rendered mesh
//! against measured depth, and alignment of a mesh's outline with a colour image. This crate does not depend on how hypotheses are
//! found.

#![warn(unreachable_pub, unnameable_types)]
// `!(x > 0.0)` refuses NaN and `x <= 0.0` does not: the checks here rely on this.
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
pub use verify::{VerifiedPose, refine, verify, verify_published};
