//! Training data: posed images, training sets read from BOP datasets or made of meshes, and renderings of training
//! objects at random poses under random light. Nothing here depends on a network.
//!
//! [`TrainingSet::of_dataset`] reads objects and [`PosedImage`]s; [`PoseRange`] samples poses, [`color_patch`]
//! renders images.

#![warn(unreachable_pub, unnameable_types)]

mod backgrounds;
mod colors;
mod contents;
mod error;
mod photograph_file;
mod posed_image;
mod poses;
mod prepared_mesh;
mod reading;
mod rendering;
mod rough_images;
mod training_set;
mod visible_mask;

pub use backgrounds::{background_files, backgrounds_with_images, plain_backgrounds};
pub use colors::image_color_augmentation;
pub use error::{PosedImageError, TrainingSetError};
pub use photograph_file::{FloorEntry, PhotographEntry, PhotographFile};
pub use posed_image::{MIN_PIXELS, PosedImage};
pub use poses::{DEFAULT_CAMERA, PoseRange, PoseVariation, default_distances, distances};
pub use prepared_mesh::{PreparedMesh, is_textured};
pub use reading::read_posed_images;
pub use rendering::{color_patch, colors, random_lights, random_material};
pub use rough_images::{DetectMasks, RoughImage, RoughImageOptions, RoughImages, RoughObject};
pub use sixfold_geometry::FrameId;
pub use training_set::{FrameSelection, TrainingObject, TrainingSet};
pub use visible_mask::VisibleMask;
