//! Training images: the few photographs with all their annotations, objects cut out of them or rendered and pasted on other
//! backgrounds (dissertation, section 3.4.1: "Cropped patches of objects in real images are pasted to random background images"),
//! and images without any object.
//!
//! A photograph is never used as a mere background: the objects in it keep their annotations. Each sample is a function of seed and
//! number alone.

use crate::tabletop::{Tabletop, tabletop};
use crate::targets::{Annotation, IGNORED, Instance};
use rand::RngExt;
use serde::{Deserialize, Serialize};
use sixfold_data::{
    DEFAULT_CAMERA, PoseRange, PoseVariation, PosedImage, PosedImageError, PreparedMesh, TrainingObject,
    color_patch, default_distances, distances, image_color_augmentation, is_textured,
};
use sixfold_geometry::random::{Random, stream, uniform};
use sixfold_geometry::{Camera, Pose, RgbImage, Vec2, Vec3};
use sixfold_mesh::Mesh;
use sixfold_synth::augment::{
    AffineMap, AugmentError, Backgrounds, ColorAugmentation, Coverage, Cutout, Patch, Shape,
    procedural_texture,
};
use sixfold_synth::distractors::{random_rotation, random_solid};
use sixfold_synth::randomly_colored;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Objects with fewer visible pixels in a training image are ignored in the training.
const MIN_PIXELS: usize = 64;
/// Photographs per object from which colours are taken, and the number of colours from each.
const PALETTE_PICTURES: usize = 6;
const PALETTE_COLORS: usize = 40;
/// Meshes with more faces are simplified, except for those with a texture.
const FACES: usize = 5000;
/// Maximum number of different objects on a table.
const TABLETOP_CHOICE: usize = 40;
/// Directions whose extreme vertices determine a mesh's bounding box.
const EXTREMES: usize = 200;

/// Fractions and ranges. The defaults are for few real images of objects on a table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainingImageOptions {
    /// Side of the training images, pixels; a multiple of 32.
    pub size: usize,
    /// Fraction of images that are parts of photographs, 0..1.
    pub photograph_fraction: f32,
    /// Fraction of images without any object, 0..1.
    pub empty_fraction: f32,
    /// Factors on the size that objects have in the photographs.
    pub scale: [f32; 2],
    /// Largest rotation in the image plane to either side, radians.
    pub rotation: f32,
    /// Maximum number of objects pasted on a background.
    pub max_pasted: u32,
    /// Maximum number of objects pasted on a part of a photograph.
    pub max_added: u32,
    /// Fraction of renders among pasted objects that have photographs, 0..1.
    pub render_fraction: f32,
    /// Maximum number of distractors: solids, shapes, and outlines of objects filled with something else.
    pub max_distractors: u32,
    /// Fraction of solids among them, 0..1.
    pub solid_fraction: f32,
    /// Objects with a smaller visible fraction are ignored in the training.
    pub min_visibility: f32,
    /// Probability that a rendered object has random colours.
    pub random_color_probability: f32,
    /// Fraction of rendered poses near one of a photograph, 0..1.
    pub near_real_fraction: f32,
    /// Fraction of images that are rendered as a whole: the objects in their own colours on a table, 0..1.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub tabletop_fraction: f32,
    /// All objects are of one class: the detector learns what an object is, not which object it is.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub one_class: bool,
}

#[allow(clippy::trivially_copy_pass_by_ref)]
fn is_zero(fraction: &f32) -> bool {
    *fraction == 0.0
}

impl Default for TrainingImageOptions {
    fn default() -> Self {
        TrainingImageOptions {
            size: 320,
            photograph_fraction: 0.45,
            empty_fraction: 0.1,
            scale: [0.65, 1.5],
            rotation: 15f32.to_radians(),
            max_pasted: 7,
            max_added: 3,
            render_fraction: 0.4,
            max_distractors: 5,
            solid_fraction: 0.6,
            min_visibility: 0.15,
            random_color_probability: 0.0,
            near_real_fraction: 0.6,
            tabletop_fraction: 0.0,
            one_class: false,
        }
    }
}

/// Why training images cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum TrainingImageError {
    /// An option is out of its range.
    #[error("sample option {field}: found {found}, expected {expected}")]
    Option {
        /// Its name.
        field: &'static str,
        /// Its value.
        found: String,
        /// The values allowed.
        expected: &'static str,
    },
    /// No object was given.
    #[error("no object to learn was given; give at least one mesh")]
    NoObjects,
    /// There is no image of an object.
    #[error(
        "object {id}: no photograph shows it and its mesh has neither colours nor texture; give photographs or a coloured mesh, or set random_color_probability above 0"
    )]
    NoPictures {
        /// The object.
        id: u32,
    },
    /// An image does not show enough of its object.
    #[error(transparent)]
    Image(#[from] PosedImageError),
    /// Error in colours or backgrounds.
    #[error(transparent)]
    Augment(#[from] AugmentError),
}

/// An object prepared for the samples.
struct Prepared {
    drawn: PreparedMesh,
    poses: Vec<Pose>,
    distance: [f64; 2],
    /// Visible parts in photographs, with the length of the longer side in the photograph.
    cutouts: Vec<(Cutout, f32)>,
}

/// An image with a label for each visible object.
struct LabelledImage {
    image: Arc<RgbImage>,
    /// For every pixel 0 or the object's number in the photograph, from 1.
    labels: Vec<u8>,
    /// Class, visible pixels and centre of each object.
    instances: Vec<(usize, f32, [f32; 2])>,
}

/// One training image.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingImage {
    /// 3 x side x side, in 0..1.
    pub rgb: Vec<f32>,
    /// Its annotation.
    pub annotation: Annotation,
}

/// Generates training images; shared between threads by reference.
pub struct TrainingImageSource {
    objects: Vec<Prepared>,
    photographs: Vec<LabelledImage>,
    backgrounds: Backgrounds,
    camera: Camera,
    options: TrainingImageOptions,
    poses: PoseVariation,
    /// Colours of the finished image.
    color: ColorAugmentation,
    /// Colours of a rendered object before it is pasted.
    render_color: ColorAugmentation,
    /// Colours of the objects.
    palette: Vec<[u8; 3]>,
}

/// An image under construction.
struct Canvas {
    image: Patch,
    labels: Vec<u8>,
    /// Class and number of unoccluded pixels of each object; number 1 is the first.
    instances: Vec<(usize, f32)>,
    side: usize,
}

impl Canvas {
    /// Pastes a small image with its top left pixel at `corner`; returns the number of pixels it covers, including those outside
    /// the canvas. With `label` 0 it is an occluder.
    fn paste(&mut self, patch: &Patch, cover: &Coverage, corner: [i64; 2], feather: f32, label: u8) -> f32 {
        let mut soft = cover.clone();
        soft.blur(feather);
        let side = self.side as i64;
        let pixels = patch.width * patch.height;
        let planes = self.side * self.side;
        let mut covered = 0.0;
        for y in 0..patch.height {
            let to_y = corner[1] + y as i64;
            for x in 0..patch.width {
                let from = y * patch.width + x;
                let alpha = cover.data[from];
                if alpha <= 0.0 {
                    continue;
                }
                covered += alpha;
                let to_x = corner[0] + x as i64;
                if to_x < 0 || to_y < 0 || to_x >= side || to_y >= side {
                    continue;
                }
                let to = to_y as usize * self.side + to_x as usize;
                // The border is soft towards the inside, because the image has no colours outside.
                let alpha_soft = alpha * (1.6 * soft.data[from]).min(1.0);
                for c in 0..3 {
                    let value = &mut self.image.data[c * planes + to];
                    *value += (patch.data[c * pixels + from] - *value) * alpha_soft;
                }
                if alpha > 0.5 {
                    self.labels[to] = label;
                }
            }
        }
        covered
    }
}

impl TrainingImageSource {
    /// Prepares objects and photographs, which takes seconds. `real` has every visible object of the photographs that is to be
    /// learned, `cut` those of them that are complete enough for pasting.
    ///
    /// # Errors
    /// [`TrainingImageError`].
    pub fn new(
        objects: Vec<TrainingObject>,
        real: &[PosedImage],
        cut: &[PosedImage],
        backgrounds: Backgrounds,
        options: TrainingImageOptions,
    ) -> Result<Self, TrainingImageError> {
        options.check()?;
        for image in real.iter().chain(cut) {
            image.check_visible()?;
        }
        if objects.is_empty() {
            return Err(TrainingImageError::NoObjects);
        }
        let camera = real.first().map_or(DEFAULT_CAMERA, |c| *c.camera()).without_distortion();
        let class_of: BTreeMap<u32, usize> = objects.iter().enumerate().map(|(i, o)| (o.id, i)).collect();
        let photographs = photographs(real, &class_of);
        let prepared = objects
            .into_iter()
            .map(|object| Prepared::new(object, real, cut, &options))
            .collect::<Result<Vec<_>, _>>()?;
        let poses = PoseVariation {
            near_fraction: options.near_real_fraction,
            rotation: options.rotation,
            view_rotation: options.rotation,
            ..PoseVariation::default()
        };
        let palette = prepared.iter().flat_map(Prepared::palette).collect();
        Ok(TrainingImageSource {
            objects: prepared,
            photographs,
            backgrounds,
            camera,
            options,
            poses,
            color: image_color_augmentation(),
            render_color: ColorAugmentation::renders(),
            palette,
        })
    }

    /// The options.
    pub fn options(&self) -> &TrainingImageOptions {
        &self.options
    }

    /// Number of photographs.
    pub fn photographs(&self) -> usize {
        self.photographs.len()
    }

    /// A training image: the same for the same arguments, on any thread.
    pub fn sample(&self, seed: u64, number: u64) -> TrainingImage {
        let mut random = stream(seed ^ 0x5ce9_e000, number);
        let random = &mut random;
        let options = &self.options;
        // Without tabletops the samples are the same as before this option existed.
        let tabletop = options.tabletop_fraction > 0.0 && random.random::<f32>() < options.tabletop_fraction;
        let kind = random.random::<f32>();
        let mut canvas = if tabletop {
            self.tabletop(random)
        } else if kind < options.photograph_fraction && !self.photographs.is_empty() {
            let mut canvas = self.photograph(random);
            for _ in 0..random.random_range(0..=options.max_added) {
                self.paste_object(&mut canvas, random);
            }
            for _ in 0..random.random_range(0..=2) {
                self.distract(&mut canvas, random);
            }
            canvas
        } else {
            let empty = kind > 1.0 - options.empty_fraction;
            let mut canvas = self.background(random);
            for _ in 0..random.random_range(0..=options.max_distractors) {
                self.distract(&mut canvas, random);
            }
            if !empty {
                for _ in 0..random.random_range(1..=options.max_pasted.max(1)) {
                    self.paste_object(&mut canvas, random);
                    if random.random::<f32>() < 0.25 {
                        self.distract(&mut canvas, random);
                    }
                }
            }
            canvas
        };
        self.color.apply(&mut canvas.image, random);
        let annotation = self.annotation(&mut canvas);
        TrainingImage { rgb: canvas.image.data, annotation }
    }

    /// Objects on a table.
    fn tabletop(&self, random: &mut Random) -> Canvas {
        let side = self.options.size;
        let count = TABLETOP_CHOICE.min(self.objects.len());
        let chosen: Vec<usize> = (0..count).map(|_| random.random_range(0..self.objects.len())).collect();
        let meshes: Vec<&Mesh> = chosen.iter().map(|i| &self.objects[*i].drawn.mesh).collect();
        let Tabletop { image, labels, whole } = tabletop(&meshes, &self.backgrounds, side, random);
        let class = |index: usize| if self.options.one_class { 0 } else { chosen[index] };
        let instances = whole.into_iter().map(|(index, pixels)| (class(index), pixels)).collect();
        Canvas { image, labels, instances, side }
    }

    fn background(&self, random: &mut Random) -> Canvas {
        let side = self.options.size;
        let image = self.backgrounds.patch(side, side, random);
        Canvas { image, labels: vec![0; side * side], instances: vec![], side }
    }

    /// A factor on sizes, uniform in its logarithm.
    fn scale(&self, random: &mut Random) -> f32 {
        uniform(random, self.options.scale.map(f32::ln)).exp()
    }

    /// A part of a photograph around one of its objects, or anywhere.
    fn photograph(&self, random: &mut Random) -> Canvas {
        let side = self.options.size;
        let photograph = &self.photographs[random.random_range(0..self.photographs.len())];
        let (width, height) = photograph.image.size();
        let scale = self.scale(random);
        let step = 1.0 / scale;
        let turn = uniform(random, [-self.options.rotation, self.options.rotation]);
        let reach = 0.4 * side as f32 * step;
        let anywhere = photograph.instances.is_empty() || random.random::<f32>() < 0.2;
        let centre = if anywhere {
            [random.random::<f32>() * width as f32, random.random::<f32>() * height as f32]
        } else {
            let (_, _, instance_centre) =
                photograph.instances[random.random_range(0..photograph.instances.len())];
            instance_centre.map(|m| m + uniform(random, [-reach, reach]))
        };
        // The part should lie within the photograph if possible.
        let half = 0.35 * side as f32 * step;
        let clamped = |at: f32, limit: usize| {
            let (low, high) = (half, limit as f32 - half);
            if low < high { at.clamp(low, high) } else { 0.5 * limit as f32 }
        };
        let centre = [clamped(centre[0], width), clamped(centre[1], height)];
        let (s, c) = turn.sin_cos();
        let (sx, sy) = (c * step, s * step);
        let half = 0.5 * (side as f32 - 1.0);
        let map = AffineMap {
            x: [sx, -sy, centre[0] - (sx - sy) * half],
            y: [sy, sx, centre[1] - (sy + sx) * half],
        };
        let (patch, inside) = Patch::warp(&photograph.image, &map, side, side, [0.5; 3]);
        let mut canvas = if inside.data.iter().any(|v| *v < 0.5) && random.random::<bool>() {
            let mut canvas = self.background(random);
            canvas.image.blend(&patch, &inside);
            canvas
        } else {
            Canvas { image: patch, labels: vec![0; side * side], instances: vec![], side }
        };
        for y in 0..side {
            for x in 0..side {
                let [u, v] = map.apply(x as f32, y as f32).map(|v| (v + 0.5).floor());
                if u >= 0.0 && v >= 0.0 && u < width as f32 && v < height as f32 {
                    canvas.labels[y * side + x] = photograph.labels[v as usize * width + u as usize];
                }
            }
        }
        canvas.instances =
            photograph.instances.iter().map(|(class, pixels, _)| (*class, pixels * scale * scale)).collect();
        canvas
    }

    /// Pastes an object, cut out or rendered, at a random place.
    fn paste_object(&self, canvas: &mut Canvas, random: &mut Random) {
        if canvas.instances.len() >= usize::from(IGNORED) - 1 {
            return;
        }
        let class = random.random_range(0..self.objects.len());
        let object = &self.objects[class];
        let can_render = object.drawn.colored || self.options.random_color_probability > 0.0;
        let render = object.cutouts.is_empty()
            || (can_render && random.random::<f32>() < self.options.render_fraction);
        let drawn = if render { self.render(object, random) } else { self.cut(object, random) };
        let Some((mut patch, cover)) = drawn else { return };
        let gain = uniform(random, [0.75, 1.25]);
        patch.data.iter_mut().for_each(|v| *v = (*v * gain).min(1.0));
        let corner = self.corner(&patch, random);
        let feather = uniform(random, [0.4, 1.2]);
        let label = (canvas.instances.len() + 1) as u8;
        let pixels = canvas.paste(&patch, &cover, corner, feather, label);
        canvas.instances.push((if self.options.one_class { 0 } else { class }, pixels));
    }

    /// A random position of a patch's corner, with the patch's centre inside the canvas.
    fn corner(&self, patch: &Patch, random: &mut Random) -> [i64; 2] {
        let side = self.options.size as f32;
        [patch.width, patch.height].map(|length| {
            let centre_at = uniform(random, [0.02, 0.98]) * side;
            (centre_at - 0.5 * length as f32).round() as i64
        })
    }

    fn cut(&self, object: &Prepared, random: &mut Random) -> Option<(Patch, Coverage)> {
        let (cutout, longest) = object.cutouts.get(random.random_range(0..object.cutouts.len().max(1)))?;
        let longest = (longest * self.scale(random)).min(1.5 * self.options.size as f32);
        let turn = uniform(random, [-self.options.rotation, self.options.rotation]);
        Some(draw(cutout, longest, turn))
    }

    fn render(&self, object: &Prepared, random: &mut Random) -> Option<(Patch, Coverage)> {
        let range = PoseRange {
            camera: &self.camera,
            centre: object.drawn.centre,
            distance: object.distance,
            real: &object.poses,
        };
        let pose = range.draw(&self.poses, random);
        let scale = f64::from(self.scale(random));
        let (low, high) = object.drawn.pixel_box(&self.camera, &pose)?;
        let side = (high - low).max() * scale + 4.0;
        if !(8.0..=1.5 * self.options.size as f64).contains(&side) {
            return None;
        }
        let size = side.ceil() as usize;
        let corner = (low + high) * 0.5 * scale - Vec2::repeat(0.5 * size as f64);
        let camera = Camera {
            fx: self.camera.fx * scale,
            fy: self.camera.fy * scale,
            cx: self.camera.cx * scale - corner.x,
            cy: self.camera.cy * scale - corner.y,
            width: size,
            height: size,
            distortion: None,
        };
        let random_colors =
            !object.drawn.colored || random.random::<f32>() < self.options.random_color_probability;
        let (mut patch, cover) = if random_colors {
            color_patch(&randomly_colored(&object.drawn.mesh, random), &camera, &pose, random)
        } else {
            color_patch(&object.drawn.mesh, &camera, &pose, random)
        };
        self.render_color.apply(&mut patch, random);
        Some((patch, cover))
    }

    /// A distractor: a solid, a shape, or the outline of an object filled with another texture.
    fn distract(&self, canvas: &mut Canvas, random: &mut Random) {
        let side = self.options.size;
        let longest = uniform(random, [0.06, 0.5]) * side as f32;
        let feather = uniform(random, [0.4, 1.2]);
        if random.random::<f32>() < self.options.solid_fraction {
            let (patch, cover) = self.solid(longest, random);
            let corner = self.corner(&patch, random);
            canvas.paste(&patch, &cover, corner, feather, 0);
            return;
        }
        let outline = random.random::<f32>() < 0.5;
        let object = &self.objects[random.random_range(0..self.objects.len())];
        let cover = match object.cutouts.get(random.random_range(0..object.cutouts.len().max(1))) {
            Some((cutout, _)) if outline => {
                let turn = uniform(random, [-std::f32::consts::PI, std::f32::consts::PI]);
                draw(cutout, longest, turn).1
            }
            _ => {
                let window = (1.5 * longest).ceil().max(8.0) as usize;
                let half = 0.5 * window as f32;
                Shape::random(random).draw(window, window, [half, half], 0.35 * longest)
            }
        };
        let patch = match random.random_range(0..10u32) {
            0..=1 => Patch::filled(cover.width, cover.height, std::array::from_fn(|_| random.random())),
            2..=4 => procedural_texture(cover.width, cover.height, random),
            _ => self.backgrounds.patch(cover.width, cover.height, random),
        };
        let corner = self.corner(&patch, random);
        canvas.paste(&patch, &cover, corner, feather, 0);
    }

    /// A solid whose longest side is at most `longest` pixels long, from a random direction.
    fn solid(&self, longest: f32, random: &mut Random) -> (Patch, Coverage) {
        let mesh = random_solid(&self.backgrounds, &self.palette, random);
        let distance = f64::from(uniform(random, [4.0, 10.0]));
        let turn = random_rotation(random);
        let pose = Pose::new(turn.rotation(), Vec3::new(0.0, 0.0, distance));
        // A cube of side 1 fits into a ball of diameter 1.74, and its front is nearer than its centre.
        let size = (1.9 * longest).ceil().max(8.0) as usize;
        let focal = f64::from(longest) * (distance - 0.87);
        let principal = 0.5 * (size as f64 - 1.0);
        let camera = Camera {
            fx: focal,
            fy: focal,
            cx: principal,
            cy: principal,
            width: size,
            height: size,
            distortion: None,
        };
        let (mut patch, cover) = color_patch(&mesh, &camera, &pose, random);
        self.render_color.apply(&mut patch, random);
        (patch, cover)
    }

    /// The annotation of the visible objects.
    fn annotation(&self, canvas: &mut Canvas) -> Annotation {
        let side = canvas.side;
        let mut seen = vec![(0usize, [usize::MAX, usize::MAX, 0, 0]); canvas.instances.len()];
        for (row, y) in canvas.labels.chunks_exact(side).zip(0..) {
            for (label, x) in row.iter().zip(0..) {
                if let Some(place) = usize::from(*label).checked_sub(1).and_then(|i| seen.get_mut(i)) {
                    let [x0, y0, x1, y1] = place.1;
                    *place = (place.0 + 1, [x0.min(x), y0.min(y), x1.max(x), y1.max(y)]);
                }
            }
        }
        let mut numbers = vec![0u8; 256];
        let mut instances = vec![];
        for (index, ((class, whole), (pixels, corners))) in canvas.instances.iter().zip(&seen).enumerate() {
            let learnt = *pixels >= MIN_PIXELS && *pixels as f32 >= self.options.min_visibility * whole;
            numbers[index + 1] = if learnt {
                let corners = corners.map(|v| v as f32);
                instances.push(Instance { class: *class, corners });
                instances.len() as u8
            } else {
                IGNORED
            };
        }
        let labels = canvas.labels.iter().map(|l| numbers[usize::from(*l)]).collect();
        Annotation { size: [side, side], labels, instances }
    }
}

/// A cut-out as a small image around it.
fn draw(cutout: &Cutout, longest: f32, turn: f32) -> (Patch, Coverage) {
    let (width, height) = cutout.size();
    let scale = longest / width.max(height) as f32;
    let (w, h) = (width as f32 * scale, height as f32 * scale);
    let (s, c) = turn.sin_cos();
    let wide = (w * c.abs() + h * s.abs()).ceil().max(4.0) as usize + 2;
    let tall = (w * s.abs() + h * c.abs()).ceil().max(4.0) as usize + 2;
    cutout.draw(wide, tall, [0.5 * (wide as f32 - 1.0), 0.5 * (tall as f32 - 1.0)], longest, turn)
}

/// The photographs with their labels.
fn photographs(real: &[PosedImage], class_of: &BTreeMap<u32, usize>) -> Vec<LabelledImage> {
    let mut photographs: Vec<LabelledImage> = vec![];
    for crop in real {
        let Some(class) = class_of.get(&crop.object_id()) else { continue };
        let (width, height) = crop.image().size();
        let index =
            photographs.iter().position(|p| Arc::ptr_eq(&p.image, crop.image())).unwrap_or_else(|| {
                let image = crop.image().clone();
                photographs.push(LabelledImage { image, labels: vec![0; width * height], instances: vec![] });
                photographs.len() - 1
            });
        let photograph = &mut photographs[index];
        if photograph.instances.len() >= usize::from(IGNORED) - 1 {
            continue;
        }
        let number = (photograph.instances.len() + 1) as u8;
        let side = width.max(height);
        let seen = crop.visible(&AffineMap { x: [1.0, 0.0, 0.0], y: [0.0, 1.0, 0.0] }, side);
        let (mut pixels, mut sum) = (0.0f32, [0.0f32; 2]);
        for y in 0..height {
            for x in 0..width {
                if seen.data[y * side + x] > 0.5 {
                    photograph.labels[y * width + x] = number;
                    pixels += 1.0;
                    sum = [sum[0] + x as f32, sum[1] + y as f32];
                }
            }
        }
        photograph.instances.push((*class, pixels, sum.map(|s| s / pixels.max(1.0))));
    }
    photographs
}

impl Prepared {
    fn new(
        object: TrainingObject,
        real: &[PosedImage],
        cut: &[PosedImage],
        options: &TrainingImageOptions,
    ) -> Result<Self, TrainingImageError> {
        let TrainingObject { id, mesh, info, .. } = object;
        let faces = if is_textured(&mesh) { usize::MAX } else { FACES };
        let drawn = PreparedMesh::new(&mesh, faces, EXTREMES);
        let mine = || real.iter().filter(|c| c.object_id() == id);
        let cutouts: Vec<(Cutout, f32)> = cut
            .iter()
            .filter(|c| c.object_id() == id)
            .filter_map(PosedImage::cutout)
            .map(|c| {
                let longest = c.size().0.max(c.size().1) as f32;
                (c, longest)
            })
            .collect();
        if cutouts.is_empty()
            && !(drawn.colored || options.random_color_probability > 0.0 && !mesh.faces().is_empty())
        {
            return Err(TrainingImageError::NoPictures { id });
        }
        let poses: Vec<Pose> = mine().map(|c| *c.camera_from_object()).collect();
        // An object without images uses the distances of the others.
        let distance = distances(mine())
            .or_else(|| distances(real))
            .unwrap_or(default_distances(info.diameter))
            .map(|d| d.max(info.diameter));
        Ok(Prepared { drawn, poses, distance, cutouts })
    }

    /// A few of its colours: from photographs, otherwise from its mesh.
    fn palette(&self) -> Vec<[u8; 3]> {
        let mut colors = vec![];
        for (cutout, longest) in self.cutouts.iter().take(PALETTE_PICTURES) {
            let (patch, cover) = draw(cutout, longest.min(64.0), 0.0);
            let pixels = patch.width * patch.height;
            let inside: Vec<usize> = (0..pixels).filter(|i| cover.data[*i] > 0.9).collect();
            colors.extend(inside.iter().step_by((inside.len() / PALETTE_COLORS).max(1)).map(|i| {
                std::array::from_fn(|c| (255.0 * patch.data[c * pixels + i]).round().clamp(0.0, 255.0) as u8)
            }));
        }
        if let (true, Some(of_mesh)) = (colors.is_empty(), self.drawn.mesh.colors()) {
            colors.extend(of_mesh.iter().step_by((of_mesh.len() / PALETTE_COLORS).max(1)));
        }
        colors
    }
}

impl std::fmt::Debug for TrainingImageSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("TrainingImageSource")
            .field("objects", &self.objects.len())
            .field("photographs", &self.photographs.len())
            .field("options", &self.options)
            .finish_non_exhaustive()
    }
}

impl TrainingImageOptions {
    /// Tests every field.
    ///
    /// # Errors
    /// [`TrainingImageError::Option`].
    pub fn check(&self) -> Result<(), TrainingImageError> {
        let wrong =
            |field, expected, found: String| Err(TrainingImageError::Option { field, expected, found });
        if !self.size.is_multiple_of(32) || !(64..=1024).contains(&self.size) {
            return wrong("size", "a multiple of 32 from 64 to 1024 pixels", self.size.to_string());
        }
        for (field, fraction) in [
            ("photograph_fraction", self.photograph_fraction),
            ("empty_fraction", self.empty_fraction),
            ("render_fraction", self.render_fraction),
            ("solid_fraction", self.solid_fraction),
            ("min_visibility", self.min_visibility),
            ("random_color_probability", self.random_color_probability),
            ("near_real_fraction", self.near_real_fraction),
            ("tabletop_fraction", self.tabletop_fraction),
        ] {
            if !(0.0..=1.0).contains(&fraction) {
                return wrong(field, "0 to 1", fraction.to_string());
            }
        }
        let [low, high] = self.scale;
        if !(low >= 0.05 && low <= high && high <= 20.0) {
            return wrong("scale", "two factors in order between 0.05 and 20", format!("{low}, {high}"));
        }
        if !(0.0..=std::f32::consts::PI).contains(&self.rotation) {
            return wrong("rotation", "radians from 0 to pi", self.rotation.to_string());
        }
        Ok(())
    }
}
