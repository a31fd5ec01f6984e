//! Options of the samples.

use std::f32::consts::FRAC_PI_4;

use super::error::SampleError;
use rand::RngExt;
use sixfold_data::{PoseVariation, image_color_augmentation};
use sixfold_geometry::Camera;
use sixfold_geometry::random::Random;
use sixfold_synth::augment::ColorAugmentation;

/// Sizes, fractions and ranges. The defaults are for few real images of objects on a table, with occlusion.
#[derive(Debug, Clone, PartialEq)]
pub struct SampleOptions {
    /// Side of the input image, pixels.
    pub size: usize,
    /// Side of coordinates and masks, pixels; `None`: that of the input.
    pub target_size: Option<usize>,
    /// Fraction of rendered samples of an object that has photographs and can be rendered, 0..1.
    pub render_fraction: f32,
    /// Ratio of the crop's side to the longer side of the object's box (dissertation: 1.5).
    pub crop_factor: f64,
    /// Largest shift of the crop's centre, as a fraction of the box.
    pub centre_jitter: f64,
    /// Largest relative change of the crop's side.
    pub size_jitter: f64,
    /// Probability that the box is that of the visible part; otherwise that of the whole object.
    pub visible_box_probability: f32,
    /// Probability that one side of the object is hidden and the box is that of the rest: this is how partly hidden objects are
    /// detected, so they appear larger in their crops than whole ones.
    pub cut_probability: f32,
    /// Smallest and largest fraction of the box's side that is then cut off.
    pub cut: [f32; 2],
    /// Largest rotation in the image plane to either side, radians (table 3.3: 45 degrees).
    pub rotation: f32,
    /// Probability that a photograph keeps its own background.
    pub keep_background_probability: f32,
    /// Probability of an added occluder.
    pub occlusion_probability: f32,
    /// Fraction of the visible object that occluders hide (table 3.3).
    pub occlusion: [f32; 2],
    /// Occluders show only other parts of the background, as in the dissertation; otherwise also plain colours and textures.
    pub background_occluders: bool,
    /// Restrict targets and silhouette of a photograph to the photograph's own mask of the object: a CAD model or a hull is larger
    /// than the visible object (section 3.4.4). For photographs of unoccluded objects.
    pub synchronised_masks: bool,
    /// Probability that an occluder is an image of another object, if there are others.
    pub object_occluder_probability: f32,
    /// Maximum number of images of other objects pasted behind the object.
    pub clutter: u32,
    /// Range of the factor on the brightness of an object cut from a photograph, relative to its new background.
    pub paste_gain: [f32; 2],
    /// Range of the sigma of the blur along the border of a pasted object, pixels.
    pub border_blur: [f32; 2],
    /// Fraction of samples that imitate the input of the second stage (grey outside a disturbed mask), 0..1.
    pub second_stage_fraction: f32,
    /// `None`: the stage of every sample is chosen independently, which mixes both within a batch. `Some(n)`: `n` consecutive
    /// sample numbers have the same stage; with `n` equal to the batch size whole batches alternate, as in the dissertation.
    pub second_stage_block: Option<u64>,
    /// Colours of the finished image.
    pub color: ColorAugmentation,
    /// Colours of a rendered object before it is pasted.
    pub render_color: ColorAugmentation,
    /// Fraction of rendered poses that are near that of a photograph; the others are views from any direction within `elevation`.
    pub near_real_fraction: f32,
    /// Largest rotation about each axis away from a photograph's pose, radians.
    pub pose_noise: f64,
    /// Elevation of the camera above the object's xy plane, radians: `[0, pi/2]` is the upper hemisphere.
    pub elevation: [f32; 2],
    /// Largest rotation about the view axis from upright for poses that are not near a photograph's, radians.
    pub max_view_rotation: f32,
    /// Distance of rendered objects, metres; `None`: the photographs' range (without any: 4 to 12 diameters).
    pub distance: Option<[f64; 2]>,
    /// Camera of rendered objects; `None`: that of the photographs (without any: 640x480, focal length 600).
    pub camera: Option<Camera>,
    /// Probability that a rendered object has random colours instead of its mesh's (always, when the mesh has none).
    pub random_color_probability: f32,
    /// Use as targets of an object with discrete symmetries those of one side that represents all (for comparison with the
    /// transformer loss).
    pub view_limits: bool,
    /// Meshes with more faces are simplified to about this many before rendering.
    pub faces: usize,
    /// Seed of the images that are generated once (renders used as occluders).
    pub seed: u64,
}

impl Default for SampleOptions {
    fn default() -> Self {
        let poses = PoseVariation::default();
        SampleOptions {
            size: 128,
            target_size: None,
            render_fraction: 0.5,
            crop_factor: 1.5,
            centre_jitter: 0.07,
            size_jitter: 0.2,
            visible_box_probability: 0.5,
            cut_probability: 0.3,
            cut: [0.1, 0.55],
            rotation: poses.rotation,
            keep_background_probability: 0.5,
            occlusion_probability: 0.7,
            occlusion: [0.04, 0.5],
            background_occluders: false,
            synchronised_masks: false,
            object_occluder_probability: 0.5,
            clutter: 3,
            paste_gain: [0.8, 1.2],
            border_blur: [0.4, 1.5],
            second_stage_fraction: 0.5,
            second_stage_block: None,
            color: image_color_augmentation(),
            render_color: ColorAugmentation::renders(),
            near_real_fraction: poses.near_fraction,
            pose_noise: poses.noise,
            elevation: poses.elevation,
            max_view_rotation: poses.view_rotation,
            distance: None,
            camera: None,
            random_color_probability: 0.0,
            view_limits: false,
            faces: 6000,
            seed: 0,
        }
    }
}

impl SampleOptions {
    /// The dissertation's samples (section 3.4.1, tables 3.2 and 3.3): parts of photographs on random backgrounds, each with a part
    /// replaced by the background; whole batches of `batch` samples alternate between the first and the second stage.
    pub fn published(batch: u64) -> Self {
        SampleOptions {
            render_fraction: 0.0,
            visible_box_probability: 0.0,
            cut_probability: 0.0,
            rotation: FRAC_PI_4,
            keep_background_probability: 0.0,
            occlusion_probability: 1.0,
            object_occluder_probability: 0.0,
            background_occluders: true,
            clutter: 0,
            paste_gain: [1.0, 1.0],
            second_stage_block: Some(batch),
            color: ColorAugmentation::table_3_2(),
            ..SampleOptions::default()
        }
    }

    /// The side of coordinates and masks, pixels.
    pub fn target(&self) -> usize {
        self.target_size.unwrap_or(self.size)
    }

    /// The variation of the poses of renders.
    pub(super) fn poses(&self) -> PoseVariation {
        PoseVariation {
            near_fraction: self.near_real_fraction,
            noise: self.pose_noise,
            rotation: self.rotation,
            elevation: self.elevation,
            view_rotation: self.max_view_rotation,
        }
    }

    /// Whether sample `number` imitates the second stage.
    pub(super) fn is_second_stage(&self, number: u64, random: &mut Random) -> bool {
        let fraction = f64::from(self.second_stage_fraction);
        let Some(block) = self.second_stage_block else { return random.random::<f64>() < fraction };
        let block = (number / block.max(1)) as f64;
        ((block + 1.0) * fraction).floor() > (block * fraction).floor()
    }

    /// Tests every field.
    ///
    /// # Errors
    /// [`SampleError::Option`] and [`SampleError::Augment`].
    pub fn check(&self) -> Result<(), SampleError> {
        let wrong = |field, found: String, expected| Err(SampleError::Option { field, found, expected });
        for (field, size) in [("size", self.size), ("target_size", self.target())] {
            if !(8..=1024).contains(&size) {
                return wrong(field, size.to_string(), "8 to 1024 pixels");
            }
        }
        let probability = "a number between 0 and 1";
        for (field, value) in [
            ("render_fraction", self.render_fraction),
            ("visible_box_probability", self.visible_box_probability),
            ("cut_probability", self.cut_probability),
            ("keep_background_probability", self.keep_background_probability),
            ("occlusion_probability", self.occlusion_probability),
            ("object_occluder_probability", self.object_occluder_probability),
            ("second_stage_fraction", self.second_stage_fraction),
            ("near_real_fraction", self.near_real_fraction),
            ("random_color_probability", self.random_color_probability),
        ] {
            if !(0.0..=1.0).contains(&value) {
                return wrong(field, value.to_string(), probability);
            }
        }
        let numbers = [
            ("crop_factor", self.crop_factor, 1.0, 4.0, "a factor from 1 to 4"),
            ("centre_jitter", self.centre_jitter, 0.0, 0.5, "a fraction from 0 to 0.5"),
            ("size_jitter", self.size_jitter, 0.0, 0.9, "a fraction from 0 to 0.9"),
            ("rotation", f64::from(self.rotation), 0.0, 3.15, "an angle from 0 to pi, radians"),
            (
                "max_view_rotation",
                f64::from(self.max_view_rotation),
                0.0,
                3.15,
                "an angle from 0 to pi, radians",
            ),
            ("pose_noise", self.pose_noise, 0.0, 3.15, "an angle from 0 to pi, radians"),
        ];
        for (field, value, low, high, expected) in numbers {
            if !(value >= low && value <= high) {
                return wrong(field, value.to_string(), expected);
            }
        }
        let ranges = [
            ("cut", self.cut, 0.0, 0.9, "two fractions in order from 0 to 0.9"),
            ("occlusion", self.occlusion, 0.0, 0.95, "two fractions in order from 0 to 0.95"),
            ("paste_gain", self.paste_gain, 0.0, 4.0, "two factors in order from 0 to 4"),
            ("border_blur", self.border_blur, 0.0, 8.0, "two sigmas in order from 0 to 8 pixels"),
            ("elevation", self.elevation, -1.58, 1.58, "two angles in order from -pi/2 to pi/2, radians"),
        ];
        for (field, range, low, high, expected) in ranges {
            if !(range[0] >= low && range[0] <= range[1] && range[1] <= high) {
                return wrong(field, format!("{range:?}"), expected);
            }
        }
        if let Some(range) = self.distance
            && !(range[0] > 0.01 && range[0] <= range[1] && range[1] < 100.0)
        {
            return wrong("distance", format!("{range:?}"), "two distances in order from 0.01 to 100 metres");
        }
        if self.faces < 100 {
            return wrong("faces", self.faces.to_string(), "at least 100");
        }
        if let Some(camera) = &self.camera
            && let Err(error) = camera.check()
        {
            return wrong("camera", error.to_string(), "a usable camera");
        }
        self.color.check()?;
        self.render_color.check()?;
        Ok(())
    }
}
