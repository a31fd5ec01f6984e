//! One object in one image with known camera and pose, from a training set or from a user's photographs.

use std::sync::Arc;

use sixfold_geometry::{Camera, FrameId, Mask, Pose, Rect, RgbImage, Vec2};
use sixfold_synth::augment::{AffineMap, Coverage, Cutout};

use crate::error::PosedImageError;
use crate::visible_mask::VisibleMask;

/// Minimum number of visible pixels: fewer add no information.
pub const MIN_PIXELS: usize = 64;

/// One object in one image: pinhole camera, pose, and the mask of the visible object, if known. The image is shared between
/// its objects.
#[derive(Debug, Clone)]
pub struct PosedImage {
    name: String,
    frame: Option<FrameId>,
    object_id: u32,
    image: Arc<RgbImage>,
    camera: Camera,
    camera_from_object: Pose,
    mask: Option<VisibleMask>,
    visible_fraction: Option<f64>,
}

impl PosedImage {
    /// One object in an image of a pinhole camera. `name` is its name in messages. Without [`PosedImage::with_mask`],
    /// occlusion of the object is unknown.
    ///
    /// # Errors
    /// [`PosedImageError::Camera`], [`PosedImageError::Size`], [`PosedImageError::OutsideImage`].
    pub fn new(
        name: impl Into<String>,
        object_id: u32,
        image: Arc<RgbImage>,
        camera: Camera,
        camera_from_object: Pose,
    ) -> Result<Self, PosedImageError> {
        let name = name.into();
        if let Err(source) = camera.check_lens() {
            return Err(PosedImageError::Camera { name, source });
        }
        let posed = PosedImage {
            name,
            frame: None,
            object_id,
            image,
            camera: camera.without_distortion(),
            camera_from_object,
            mask: None,
            visible_fraction: None,
        };
        posed.check_size("image", posed.image.size())?;
        posed.check_pose(&camera_from_object)?;
        Ok(posed)
    }

    /// One object in an image of a dataset, named after both.
    ///
    /// # Errors
    /// As [`PosedImage::new`].
    pub fn of_frame(
        frame: FrameId,
        object_id: u32,
        image: Arc<RgbImage>,
        camera: Camera,
        camera_from_object: Pose,
    ) -> Result<Self, PosedImageError> {
        let name = format!("{frame} of object {object_id}");
        let posed = PosedImage::new(name, object_id, image, camera, camera_from_object)?;
        Ok(PosedImage { frame: Some(frame), ..posed })
    }

    fn check_size(&self, what: &'static str, (width, height): (usize, usize)) -> Result<(), PosedImageError> {
        let (camera_width, camera_height) = (self.camera.width, self.camera.height);
        if (width, height) == (camera_width, camera_height) {
            return Ok(());
        }
        let name = self.name.clone();
        Err(PosedImageError::Size { name, what, width, height, camera_width, camera_height })
    }

    fn check_pose(&self, pose: &Pose) -> Result<(), PosedImageError> {
        let t = pose.translation();
        let (w, h) = (self.camera.width as f64, self.camera.height as f64);
        // The object's origin may be somewhat outside the image while the object is inside, but not behind the camera.
        let near = |p: Vec2| p.x > -w && p.y > -h && p.x < 2.0 * w && p.y < 2.0 * h;
        if t.iter().all(|v| v.is_finite()) && t.z > 0.01 && self.camera.project(&t).is_some_and(near) {
            return Ok(());
        }
        Err(PosedImageError::OutsideImage { name: self.name.clone(), translation: [t.x, t.y, t.z] })
    }

    /// The same with a mask of the pixels that show the object.
    ///
    /// # Errors
    /// [`PosedImageError::Size`] for a mask that is not of the image's size.
    pub fn with_mask(self, mask: &Mask) -> Result<Self, PosedImageError> {
        self.check_size("mask", mask.size())?;
        Ok(PosedImage { mask: Some(VisibleMask::new(mask)), ..self })
    }

    /// The same with the visible fraction of the object's silhouette, 0 to 1.
    pub(crate) fn with_visible_fraction(self, fraction: f64) -> Self {
        PosedImage { visible_fraction: Some(fraction), ..self }
    }

    /// The same image with another pose; the mask stays.
    ///
    /// # Errors
    /// [`PosedImageError::OutsideImage`].
    pub fn with_pose(&self, camera_from_object: Pose) -> Result<Self, PosedImageError> {
        self.check_pose(&camera_from_object)?;
        Ok(PosedImage { camera_from_object, ..self.clone() })
    }

    /// An error unless a mask shows enough of the object to learn from.
    ///
    /// # Errors
    /// [`PosedImageError::NoMask`], and [`PosedImageError::NotVisible`] for fewer than [`MIN_PIXELS`].
    pub fn check_visible(&self) -> Result<(), PosedImageError> {
        let name = || self.name.clone();
        let Some(mask) = &self.mask else { return Err(PosedImageError::NoMask { name: name() }) };
        let pixels = mask.pixels();
        if pixels < MIN_PIXELS {
            return Err(PosedImageError::NotVisible { name: name(), pixels, minimum: MIN_PIXELS });
        }
        Ok(())
    }

    /// The name in messages.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The frame of a dataset, if the image is from one.
    pub fn frame(&self) -> Option<FrameId> {
        self.frame
    }

    /// Id of the object.
    pub fn object_id(&self) -> u32 {
        self.object_id
    }

    /// The image.
    pub fn image(&self) -> &Arc<RgbImage> {
        &self.image
    }

    /// Its pinhole camera.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The object's pose.
    pub fn camera_from_object(&self) -> &Pose {
        &self.camera_from_object
    }

    /// The mask of the visible object, if known.
    pub fn mask(&self) -> Option<&VisibleMask> {
        self.mask.as_ref()
    }

    /// The visible fraction of the object's silhouette, 0 to 1, if known.
    pub fn visible_fraction(&self) -> Option<f64> {
        self.visible_fraction
    }

    /// The box of the visible part, pixels; `None` without a mask.
    pub fn visible_box(&self) -> Option<Rect> {
        self.mask.as_ref().map(VisibleMask::bounding_box)
    }

    /// Points of the image whose bounding box is that of the visible part for any rotation of the image; empty without a mask.
    pub fn outline(&self) -> &[Vec2] {
        self.mask.as_ref().map_or(&[], VisibleMask::outline)
    }

    /// The fraction of each pixel of a crop that shows the object; 0 without a mask.
    pub fn visible(&self, map: &AffineMap, size: usize) -> Coverage {
        Coverage::from_fn(size, size, |x, y| {
            let [u, v] = map.apply(x as f32, y as f32);
            self.mask.as_ref().map_or(0.0, |mask| mask.sample(u, v))
        })
    }

    /// The visible part as a separate image; `None` if nothing is visible.
    pub fn cutout(&self) -> Option<Cutout> {
        let mask = self.mask.as_ref()?;
        let area = mask.bounding_box();
        let (x0, y0) = (area.x as usize, area.y as usize);
        let (width, height) = (area.width as usize, area.height as usize);
        let image = RgbImage::from_fn(width, height, |x, y| self.image[(x0 + x, y0 + y)]);
        let inside = |x: usize, y: usize| mask.contains((x0 + x) as isize, (y0 + y) as isize);
        Cutout::new(&image, &Mask::from_fn(width, height, inside))
    }
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::Vec3;

    use super::*;

    #[test]
    fn what_does_not_fit_is_refused() {
        let camera = Camera::new(600.0, 590.0, 155.0, 118.0, 320, 240).unwrap();
        let image = Arc::new(RgbImage::filled(320, 240, [9; 3]));
        let pose = Pose::from_translation(Vec3::new(0.02, 0.02, 0.6));
        let make = |pose| PosedImage::new("first.png", 5, image.clone(), camera, pose);
        let posed = make(pose).unwrap();
        assert!(matches!(posed.check_visible(), Err(PosedImageError::NoMask { .. })));
        let with = |mask: &Mask| posed.clone().with_mask(mask);
        let full = with(&Mask::filled(320, 240, true)).unwrap();
        assert!(full.check_visible().is_ok());
        let empty = with(&Mask::filled(320, 240, false)).unwrap();
        let text = empty.check_visible().unwrap_err().to_string();
        assert!(text.contains("0 pixels") && text.contains("at least 64"), "{text}");
        assert!(empty.cutout().is_none());
        let text = with(&Mask::filled(3, 3, true)).unwrap_err().to_string();
        assert!(text.contains("first.png: the mask is 3x3, the camera is for 320x240"), "{text}");
        // Behind the camera, far outside the image, not a number; slightly outside is no error.
        for place in [[0.0, 0.0, -0.6], [9.0, 0.0, 0.6], [0.0, f64::NAN, 0.6]] {
            let text = make(Pose::from_translation(place.into())).unwrap_err().to_string();
            assert!(text.contains("outside the image"), "{text}");
        }
        assert!(full.with_pose(Pose::from_translation(Vec3::new(0.3, 0.0, 0.6))).is_ok());
        assert!(full.with_pose(Pose::from_translation(Vec3::new(9.0, 0.0, 0.6))).is_err());
    }

    #[test]
    fn an_image_of_a_dataset_is_named_after_its_frame() {
        let camera = Camera::new(60.0, 60.0, 15.5, 11.5, 32, 24).unwrap();
        let image = Arc::new(RgbImage::filled(32, 24, [9; 3]));
        let pose = Pose::from_translation(Vec3::new(0.0, 0.0, 0.6));
        let posed = PosedImage::of_frame(FrameId::new(2, 36), 5, image, camera, pose).unwrap();
        assert_eq!((posed.name(), posed.frame()), ("2/36 of object 5", Some(FrameId::new(2, 36))));
        assert_eq!(serde_json::to_string(&posed.frame()).unwrap(), r#"{"scene_id":2,"im_id":36}"#);
    }
}
