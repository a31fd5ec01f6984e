//! The identity of an image in a dataset: the ids of its scene and of the image in the scene.

use serde::{Deserialize, Serialize};

/// One image of a dataset, with BOP's ids. Written as `scene/image` for people, and as
/// `{"scene_id": 2, "im_id": 36}` in JSON.
///
/// ```
/// let frame = sixfold_geometry::FrameId::new(2, 36);
/// assert_eq!(frame.to_string(), "2/36");
/// assert!(frame < sixfold_geometry::FrameId::new(10, 0));
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct FrameId {
    /// The scene.
    pub scene_id: u32,
    /// The image in it.
    pub im_id: u32,
}

impl FrameId {
    /// The image `im_id` of the scene `scene_id`.
    pub const fn new(scene_id: u32, im_id: u32) -> Self {
        FrameId { scene_id, im_id }
    }
}

impl std::fmt::Display for FrameId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}/{}", self.scene_id, self.im_id)
    }
}

impl From<(u32, u32)> for FrameId {
    /// From scene and image.
    fn from((scene_id, im_id): (u32, u32)) -> Self {
        FrameId { scene_id, im_id }
    }
}
