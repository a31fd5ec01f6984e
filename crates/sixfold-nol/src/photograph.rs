//! What a user gives: photographs of the object with rough poses.

use std::sync::Arc;

use sixfold_geometry::{Camera, CameraError, Mask, Pose, RgbImage, Vec2};
use sixfold_mesh::Mesh;
use sixfold_synth::augment::Window;

/// What is wrong with photographs or options.
#[derive(Debug, thiserror::Error)]
pub enum NolError {
    /// The camera cannot be used.
    #[error("photograph {name}: {source}")]
    Camera {
        /// The photograph.
        name: String,
        /// What is wrong.
        source: CameraError,
    },
    /// Image, mask and camera are not of one size.
    #[error(
        "photograph {name}: the {what} is {width}x{height}, the camera says {camera_width}x{camera_height}; give the camera of this image"
    )]
    Size {
        /// The photograph.
        name: String,
        /// Which image.
        what: &'static str,
        /// Its columns.
        width: usize,
        /// Its rows.
        height: usize,
        /// The camera's columns.
        camera_width: usize,
        /// The camera's rows.
        camera_height: usize,
    },
    /// The pose puts the object outside the image.
    #[error(
        "photograph {name}: its pose puts the object outside the image (translation {translation:.3?} m); poses are object to camera, in metres here and in millimetres in BOP files"
    )]
    OutsideImage {
        /// The photograph.
        name: String,
        /// Translation of the pose, metres.
        translation: [f64; 3],
    },
    /// The mask is empty, or shows something else.
    #[error(
        "photograph {name}: the mask covers {share:.0} % of the object's outline at the given pose, expected at least {least:.0} %; check that the mask belongs to this object and image"
    )]
    Mask {
        /// The photograph.
        name: String,
        /// Covered part of the outline, per cent.
        share: f64,
        /// What it should be at least.
        least: f64,
    },
    /// An option is out of range.
    #[error("{field}: expected {expected}, found {found}")]
    Option {
        /// Which.
        field: &'static str,
        /// What it must be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
}

/// One photograph of the object: pose and mask may be rough.
#[derive(Debug, Clone)]
pub struct Photograph {
    name: String,
    image: Arc<RgbImage>,
    camera: Camera,
    camera_from_object: Pose,
    mask: Option<Mask>,
}

impl Photograph {
    /// A photograph by a pinhole camera. `name` stands for it in messages; `mask` says where the object is visible, `None`
    /// stands for all of its outline.
    ///
    /// # Errors
    /// [`NolError::Camera`], [`NolError::Size`], [`NolError::OutsideImage`].
    pub fn new(
        name: impl Into<String>,
        image: Arc<RgbImage>,
        camera: Camera,
        camera_from_object: Pose,
        mask: Option<Mask>,
    ) -> Result<Self, NolError> {
        let name = name.into();
        if let Err(source) = camera.check() {
            return Err(NolError::Camera { name, source });
        }
        let sizes = [("photograph", Some(image.size())), ("mask", mask.as_ref().map(Mask::size))];
        for (what, size) in sizes {
            let Some((width, height)) = size else { continue };
            if (width, height) != (camera.width, camera.height) {
                let (camera_width, camera_height) = (camera.width, camera.height);
                return Err(NolError::Size { name, what, width, height, camera_width, camera_height });
            }
        }
        let photograph =
            Photograph { name, image, camera: camera.without_distortion(), camera_from_object, mask };
        photograph.check_pose(&camera_from_object)?;
        Ok(photograph)
    }

    fn check_pose(&self, pose: &Pose) -> Result<(), NolError> {
        let t = pose.translation();
        let (w, h) = (self.camera.width as f64, self.camera.height as f64);
        let near = |p: Vec2| p.x > -0.5 * w && p.y > -0.5 * h && p.x < 1.5 * w && p.y < 1.5 * h;
        if t.iter().all(|v| v.is_finite()) && t.z > 0.01 && self.camera.project(&t).is_some_and(near) {
            return Ok(());
        }
        Err(NolError::OutsideImage { name: self.name.clone(), translation: [t.x, t.y, t.z] })
    }

    /// The same photograph with another pose.
    ///
    /// # Errors
    /// [`NolError::OutsideImage`].
    pub fn with_pose(&self, camera_from_object: Pose) -> Result<Self, NolError> {
        self.check_pose(&camera_from_object)?;
        Ok(Photograph { camera_from_object, ..self.clone() })
    }

    /// The name in messages.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The image.
    pub fn image(&self) -> &Arc<RgbImage> {
        &self.image
    }

    /// Its pinhole camera.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The rough pose.
    pub fn camera_from_object(&self) -> &Pose {
        &self.camera_from_object
    }

    /// Where the object is visible, if that is known.
    pub fn mask(&self) -> Option<&Mask> {
        self.mask.as_ref()
    }
}

/// A square about the mesh at a pose, `room` times as wide as the longer side of its box in the image; `None` where a vertex
/// lies behind the camera.
pub fn object_window(camera: &Camera, mesh: &Mesh, pose: &Pose, room: f64) -> Option<Window> {
    let mut low = Vec2::repeat(f64::INFINITY);
    let mut high = Vec2::repeat(f64::NEG_INFINITY);
    for v in mesh.vertices() {
        let p = camera.project(&pose.transform_point(v))?;
        low = low.inf(&p);
        high = high.sup(&p);
    }
    // Far away, something of a few pixels still has a crop.
    Some(Window { centre: (low + high) * 0.5, side: (high - low).amax().max(4.0) * room })
}
