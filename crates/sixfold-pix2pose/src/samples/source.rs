//! The source of training samples: combines objects, photographs and backgrounds.

use super::composition::{Composition, Scenery, gain};
use super::error::SampleError;
use super::options::SampleOptions;
use super::second_stage;
use super::symmetry::canonical;
use super::targets::{synchronise, targets};
use super::window::{Extent, rotated, rotated_pixel, window_around};
use rand::RngExt;
use sixfold_data::{
    DEFAULT_CAMERA, PoseRange, PosedImage, PreparedMesh, TrainingObject, color_patch, colors,
    default_distances, distances, is_textured, random_lights, random_material,
};
use sixfold_geometry::random::{Random, stream, uniform};
use sixfold_geometry::{Camera, Mask, Pose, Vec2};
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_render::BoundingBoxScale;
use sixfold_synth::augment::{Backgrounds, Coverage, Cutout, Patch, Window};
use sixfold_synth::randomly_colored;
use std::collections::BTreeMap;

/// Number of renders of each object for clutter and occluders, and their side in pixels.
const CUTOUTS_PER_OBJECT: u64 = 16;
const CUTOUT_SIDE: usize = 96;
/// Directions whose extreme vertices determine a mesh's bounding box.
const EXTREMES: usize = 300;

/// One training sample. All arrays are row-major, channel first; S is the input's side, T the targets' ([`SampleOptions::target`]).
/// Target pixel `(x, y)` represents the centre of its block of input pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// The input image, 3 x S x S, in 0..1.
    pub rgb: Vec<f32>,
    /// Normalised object coordinates, 3 x T x T, in -1..1, 0 outside the object; including hidden parts.
    pub coordinates: Vec<f32>,
    /// 1 within the silhouette, including hidden parts, T x T.
    pub object: Vec<f32>,
    /// 1 where the object is visible in the input, T x T.
    pub visible: Vec<f32>,
    /// Index of the object in the list given to [`SampleSource::new`].
    pub object_index: usize,
}

/// A training object prepared for sampling.
struct Prepared {
    id: u32,
    info: ModelInfo,
    scale: BoundingBoxScale,
    /// The mesh from which targets are sampled.
    drawn: PreparedMesh,
    /// The textured mesh, if there is one, because the simplified mesh has no texture.
    textured: Option<Mesh>,
    real: Vec<PosedImage>,
    real_poses: Vec<Pose>,
    distance: [f64; 2],
    camera: Camera,
}

/// Generates training samples; shared between threads by reference.
pub struct SampleSource {
    objects: Vec<Prepared>,
    backgrounds: Backgrounds,
    cutouts: Vec<(usize, Cutout)>,
    options: SampleOptions,
}

impl SampleSource {
    /// Prepares objects and photographs. Meshes are simplified and a few images of each object rendered, which takes seconds for
    /// large meshes.
    ///
    /// # Errors
    /// [`SampleError`] for options out of range, a mesh without surface, a photograph of an unknown object, and an
    /// object that can neither be cut from a photograph nor rendered.
    pub fn new(
        objects: Vec<TrainingObject>,
        real: Vec<PosedImage>,
        backgrounds: Backgrounds,
        options: SampleOptions,
    ) -> Result<Self, SampleError> {
        options.check()?;
        if objects.is_empty() {
            return Err(SampleError::NoObjects);
        }
        let mut real_of: BTreeMap<u32, Vec<PosedImage>> = BTreeMap::new();
        for crop in real {
            crop.check_visible()?;
            if !objects.iter().any(|o| o.id == crop.object_id()) {
                let known: Vec<String> = objects.iter().map(|o| o.id.to_string()).collect();
                return Err(SampleError::UnknownObject { id: crop.object_id(), known: known.join(", ") });
            }
            real_of.entry(crop.object_id()).or_default().push(crop);
        }
        // An object without photographs uses distances and camera of the others.
        let mut any_real = real_of.values().flatten();
        let common_distance = distances(any_real.clone());
        let common_camera = options.camera.or_else(|| any_real.next().map(|c| *c.camera()));
        let camera = common_camera.unwrap_or(DEFAULT_CAMERA).without_distortion();
        let mut prepared = Vec::with_capacity(objects.len());
        for object in objects {
            let real = real_of.remove(&object.id).unwrap_or_default();
            let own = distances(&real);
            let diameter = object.info.diameter;
            let distance = options
                .distance
                .or(own)
                .or(common_distance)
                .unwrap_or(default_distances(diameter))
                .map(|d| d.max(diameter));
            prepared.push(Prepared::new(object, real, distance, camera, &options)?);
        }
        let mut source = SampleSource { objects: prepared, backgrounds, cutouts: Vec::new(), options };
        source.cutouts = source.draw_cutouts();
        Ok(source)
    }

    /// The options.
    pub fn options(&self) -> &SampleOptions {
        &self.options
    }

    /// Number of objects.
    pub fn objects(&self) -> usize {
        self.objects.len()
    }

    /// Number of photographs of an object.
    ///
    /// # Panics
    /// If there is no such object.
    pub fn photographs(&self, object_index: usize) -> usize {
        self.objects[object_index].real.len()
    }

    /// Generates a sample: the same for the same arguments, on any thread.
    ///
    /// # Panics
    /// If there is no such object.
    pub fn sample(&self, object_index: usize, seed: u64, number: u64) -> Sample {
        let object = &self.objects[object_index];
        let options = &self.options;
        // Different objects get different samples for the same number.
        let mut random = stream(seed ^ (object_index as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15), number);
        let can_render = object.drawn.colored || options.random_color_probability > 0.0;
        let rendered =
            can_render && (object.real.is_empty() || random.random::<f32>() < options.render_fraction);
        let scenery =
            Scenery { options, backgrounds: &self.backgrounds, cutouts: &self.cutouts, object_index };
        let (mut composition, coordinates, object_mask, hidden) = if rendered {
            self.render(object, &scenery, &mut random)
        } else {
            self.photograph(object, &scenery, &mut random)
        };
        match hidden {
            Some(cover) => scenery.hide(&mut composition, &cover, &mut random),
            None => scenery.occlude(&mut composition, &mut random),
        }
        let Composition { mut image, visible } = composition;
        options.color.apply(&mut image, &mut random);
        if options.is_second_stage(number, &mut random) {
            let whole = object_mask.resampled(options.size, options.size);
            second_stage::imitate(&mut image, &visible, &whole, &mut random);
        }
        let mut seen = visible.resampled(options.target(), options.target());
        for (seen, object) in seen.data.iter_mut().zip(&object_mask.data) {
            // Slightly below one half, so that pixels on the object's own border are treated as in the silhouette.
            *seen = if *seen > 0.4 && *object > 0.5 { 1.0 } else { 0.0 };
        }
        Sample { rgb: image.data, coordinates, object: object_mask.data, visible: seen.data, object_index }
    }

    fn photograph(
        &self,
        object: &Prepared,
        scenery: &Scenery<'_>,
        random: &mut Random,
    ) -> (Composition, Vec<f32>, Coverage, Option<Coverage>) {
        let options = &self.options;
        let crop = &object.real[random.random_range(0..object.real.len())];
        let camera = crop.camera();
        let turn = f64::from(uniform(random, [-options.rotation, options.rotation]));
        let pose = rotated(crop.camera_from_object(), turn);
        let of_visible = || Extent::of(crop.outline().iter().map(|p| rotated_pixel(camera, p, turn)));
        let whole = object.extent(camera, &pose);
        let extent =
            if random.random::<f32>() < options.visible_box_probability { of_visible() } else { None };
        let extent =
            extent.or(whole).or_else(of_visible).unwrap_or(Extent::at(Vec2::new(camera.cx, camera.cy)));
        let (window, hidden) = self.window(extent, random);
        let map = window.map(camera, options.size, turn);
        let (mut patch, inside) =
            Patch::warp(crop.image(), &map, options.size, options.size, [second_stage::GREY; 3]);
        let visible = crop.visible(&map, options.size);
        let (mut coordinates, mut mask) = targets(
            &object.drawn.mesh,
            &object.scale,
            &window.camera(camera, options.target()),
            &canonical(&pose, &object.info, options.view_limits),
        );
        if options.synchronised_masks {
            synchronise(&mut coordinates, &mut mask, &visible.resampled(options.target(), options.target()));
        }
        let composition = if random.random::<f32>() < options.keep_background_probability {
            scenery.keep(patch, &inside, visible, random)
        } else {
            gain(&mut patch, uniform(random, options.paste_gain));
            scenery.paste(&patch, visible, random)
        };
        (composition, coordinates, mask, hidden)
    }

    fn render(
        &self,
        object: &Prepared,
        scenery: &Scenery<'_>,
        random: &mut Random,
    ) -> (Composition, Vec<f32>, Coverage, Option<Coverage>) {
        let options = &self.options;
        let pose = object.pose_range().draw(&options.poses(), random);
        let extent = object
            .extent(&object.camera, &pose)
            .unwrap_or(Extent::at(Vec2::new(object.camera.cx, object.camera.cy)));
        let (window, hidden) = self.window(extent, random);
        let (coordinates, mask) = targets(
            &object.drawn.mesh,
            &object.scale,
            &window.camera(&object.camera, options.target()),
            &canonical(&pose, &object.info, options.view_limits),
        );
        let camera = window.camera(&object.camera, options.size);
        let random_colors =
            !object.drawn.colored || random.random::<f32>() < options.random_color_probability;
        let (mut patch, silhouette) = if random_colors {
            color_patch(&randomly_colored(&object.drawn.mesh, random), &camera, &pose, random)
        } else {
            color_patch(object.textured.as_ref().unwrap_or(&object.drawn.mesh), &camera, &pose, random)
        };
        options.render_color.apply(&mut patch, random);
        let mut composition = scenery.paste(&patch, silhouette, random);
        // A photograph's crop with fewer pixels than the input is enlarged and therefore less sharp.
        let enlarged = options.size as f64 / window.side;
        if enlarged > 1.0 && random.random::<f32>() < 0.7 {
            composition.image.blur((0.4 * enlarged) as f32);
        }
        (composition, coordinates, mask, hidden)
    }

    /// The crop's window around an object's box, and the part of the object that is to be hidden.
    fn window(&self, extent: Extent, random: &mut Random) -> (Window, Option<Coverage>) {
        let options = &self.options;
        if random.random::<f32>() >= options.cut_probability {
            return (window_around(&extent, options, random), None);
        }
        let (rest, cut) = extent.cut(options, random);
        let window = window_around(&rest, options, random);
        (window, Some(cut.beyond(&window, options.size)))
    }

    /// Cut-outs: the visible parts of photographs and a few renders of each object.
    fn draw_cutouts(&self) -> Vec<(usize, Cutout)> {
        let mut cutouts = Vec::new();
        if self.objects.len() < 2 {
            return cutouts;
        }
        for (index, object) in self.objects.iter().enumerate() {
            cutouts.extend(object.real.iter().filter_map(PosedImage::cutout).map(|c| (index, c)));
            if !object.drawn.colored {
                continue;
            }
            for number in 0..CUTOUTS_PER_OBJECT {
                let mut random = stream(self.options.seed, index as u64 * CUTOUTS_PER_OBJECT + number);
                let pose = object.pose_range().draw(&self.options.poses(), &mut random);
                let Some(extent) = object.extent(&object.camera, &pose) else { continue };
                let window = Window { centre: extent.centre(), side: extent.longest() * 1.02 };
                let camera = window.camera(&object.camera, CUTOUT_SIDE);
                let mesh = object.textured.as_ref().unwrap_or(&object.drawn.mesh);
                let lights = random_lights(&mut random);
                let (image, silhouette) =
                    colors(mesh, &camera, &pose, &lights, &random_material(&mut random));
                let mask = Mask::from_fn(CUTOUT_SIDE, CUTOUT_SIDE, |x, y| {
                    silhouette.data[y * CUTOUT_SIDE + x] > 0.5
                });
                cutouts.extend(Cutout::new(&image, &mask).map(|c| (index, c)));
            }
        }
        cutouts
    }
}

impl Prepared {
    fn new(
        object: TrainingObject,
        real: Vec<PosedImage>,
        distance: [f64; 2],
        camera: Camera,
        options: &SampleOptions,
    ) -> Result<Self, SampleError> {
        let TrainingObject { id, mesh, info, scale } = object;
        if mesh.faces().is_empty() {
            return Err(SampleError::NoFaces { id, vertices: mesh.vertices().len() });
        }
        if !(info.diameter.is_finite() && info.diameter > 0.0) {
            let found = info.diameter.to_string();
            return Err(SampleError::Extent { id, field: "diameter", found });
        }
        if !(scale.half_size.iter().all(|h| h.is_finite() && *h > 0.0)
            && scale.centre.iter().all(|c| c.is_finite()))
        {
            return Err(SampleError::Extent { id, field: "scale", found: format!("{scale:?}") });
        }
        let drawn = PreparedMesh::new(&mesh, options.faces, EXTREMES);
        if !drawn.colored && real.is_empty() && options.random_color_probability <= 0.0 {
            return Err(SampleError::NoPictures { id });
        }
        Ok(Prepared {
            id,
            drawn,
            textured: is_textured(&mesh).then_some(mesh),
            real_poses: real.iter().map(|c| *c.camera_from_object()).collect(),
            real,
            info,
            scale,
            distance,
            camera,
        })
    }

    fn pose_range(&self) -> PoseRange<'_> {
        PoseRange {
            camera: &self.camera,
            centre: self.drawn.centre,
            distance: self.distance,
            real: &self.real_poses,
        }
    }

    /// The bounding box of the whole object in the image; `None` when a part of it is behind the camera.
    fn extent(&self, camera: &Camera, pose: &Pose) -> Option<Extent> {
        let (low, high) = self.drawn.pixel_box(camera, pose)?;
        Extent::of([low, high])
    }
}

impl std::fmt::Debug for SampleSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SampleSource")
            .field("objects", &self.objects.iter().map(|o| o.id).collect::<Vec<_>>())
            .field("photographs", &self.objects.iter().map(|o| o.real.len()).sum::<usize>())
            .field("cutouts", &self.cutouts.len())
            .field("options", &self.options)
            .finish_non_exhaustive()
    }
}
