//! A new object from photographs: it stands on a printed board of tags, or on a textured ground, and is photographed from all
//! sides.
//!
//! [`locate`] finds camera and poses from the board, [`put_together`] finds them without a board from local features. [`segment`]
//! finds the object in every photograph, from salience, from the covered print of the board, and from the consensus of all
//! photographs. [`reconstruct`] makes a closed, coloured mesh: the visual hull, carved where photographs or measured depth show it
//! to be hollow. [`Teaching`] keeps all steps in a folder, so that each can be inspected, corrected and resumed, and stores the
//! object for all methods. [`simulation`] renders such photographs with exact ground truth.
//!
//! The world's frame is the board's: origin at the centre of the tags, z out of the sheet; metres. Without a board z is the normal
//! of the plane on which the object stands. The object's frame has its origin at the centre of the mesh's box and the same axes.

#![deny(clippy::print_stdout, clippy::print_stderr)]
mod border;
mod by_features;
mod cones;
mod cut;
mod distance;
mod error;
mod fusion;
mod given;
mod grid;
mod ground;
mod hollow;
mod hull;
mod located;
mod one_side;
mod paint;
mod pairs;
mod pictures;
mod placed;
mod posed_file;
mod record;
mod reduce;
mod shading;
mod shape;
mod silhouette;
pub mod simulation;
mod snapshot;
mod standing;
mod stereo;
mod surface;
mod teaching;
mod unboarded;
mod unseen;
mod upright;
mod view;
pub use cones::{Cone, volume_of_masks};
pub use error::TeachError;
pub use located::{Located, SeenTags, locate};
pub use pairs::pose_of_points;
pub use record::{Stored, export_bop, photographs_of};
pub use shape::{
    Capture, FEWEST_PHOTOGRAPHS, FEWEST_WITH_DEPTH, Segmentation, Shape, ShapeOptions, reconstruct, segment,
};
pub use silhouette::{SalientSegmenter, Segmenter};
pub use snapshot::Snapshot;
pub use teaching::{
    By, MAX_PHOTOGRAPHS, Photograph, ShapeFacts, TeachOptions, Teaching, World, photograph_name,
};
pub use unboarded::{DepthOf, KnownLength, PutTogether, SeenFeatures, features_of, put_together};
pub use view::{PosedPhotograph, Volume};
