//! Training samples: synthetic objects, each rendered once like a photograph (any light, with clutter behind it and occluders in
//! front) and twice like a template, from about the same side and from another one.
//!
//! A sample is a function of seed and number alone.

use rand::RngExt;
use sixfold_geometry::nalgebra::{Unit, UnitQuaternion};
use sixfold_geometry::random::{Random, stream, uniform};
use sixfold_geometry::{Camera, PointImage, Pose, Rect, RgbImage, Vec3};
use sixfold_mesh::Mesh;
use sixfold_nn::xfeat::CELL;
use sixfold_render::{Light, Material, RenderOptions, SceneObject, VisibilityBuffer, shade};
use sixfold_synth::augment::{Backgrounds, ColorAugmentation, Coverage, Patch, Shape, occluder_of_fraction};
use sixfold_synth::distractors::{random_rotation, random_solid};
use sixfold_synth::randomly_colored;
use sixfold_synth::shapes::toy;

use crate::crop::Crop;
use crate::network::input;
use crate::templates::{CROP_FACTOR, cells_on_object, input_over_grey, render, wide_camera};

/// Correspondences per sample.
pub(crate) const POINTS: usize = 96;
/// Points of an object that are closer to each other than this fraction of its diameter are not used as negatives.
const SAME_POINT: f32 = 0.05;
/// A point is visible if the surface in the photograph is within this fraction of the diameter from it.
pub(crate) const SEEN: f32 = 0.02;
/// Fewest correspondences of a sample.
const MIN_POINTS: usize = 12;

/// A photograph, two templates, and their corresponding cells.
#[derive(Debug, Clone)]
pub(crate) struct Sample {
    /// Inputs of the network: the photograph, the template from about the same side, and one from another side.
    pub inputs: [Vec<f32>; 3],
    /// [`POINTS`] cells of the first template.
    pub cells: Vec<usize>,
    /// Position of each of them in the photograph: four cells with their weights.
    pub places: Vec<[(usize, f32); 4]>,
    /// For each of them and every cell of both templates, whether that cell shows another point.
    pub others: Vec<Vec<bool>>,
}

pub(crate) fn between(random: &mut Random, low: f64, high: f64) -> f64 {
    low + (high - low) * random.random::<f64>()
}

/// An object centred on the origin, with or without colours.
pub(crate) fn object(textures: &Backgrounds, random: &mut Random) -> Option<Mesh> {
    let mesh = if random.random::<f32>() < 0.6 {
        randomly_colored(&toy(random).ok()?, random)
    } else {
        random_solid(textures, &[], random).scaled(between(random, 0.08, 0.25))
    };
    let (low, high) = mesh.bounding_box();
    Some(mesh.transformed(&Pose::from_translation(-(low + high) * 0.5)))
}

/// A rotation by an angle up to `largest` about any axis in the image plane, and up to `roll` about the line of sight.
fn nearby(
    rotation: &UnitQuaternion<f64>,
    [smallest, largest]: [f64; 2],
    roll: f64,
    random: &mut Random,
) -> UnitQuaternion<f64> {
    let angle = between(random, 0.0, std::f64::consts::TAU);
    let axis = Unit::new_normalize(Vec3::new(angle.cos(), angle.sin(), 0.0));
    let tilt = UnitQuaternion::from_axis_angle(&axis, between(random, smallest, largest));
    UnitQuaternion::from_axis_angle(&Vec3::z_axis(), between(random, -roll, roll)) * tilt * rotation
}

/// The object rendered like a template.
struct Side {
    input: Vec<f32>,
    cells: Vec<u16>,
    points: Vec<[f32; 3]>,
}

fn template(mesh: &Mesh, rotation: &UnitQuaternion<f64>, distance: f64, side: usize) -> Option<Side> {
    let wide = wide_camera();
    let pose = Pose::new(*rotation, Vec3::new(0.0, 0.0, distance));
    let mut frame = VisibilityBuffer::new(&wide);
    frame.render(&[SceneObject { mesh, camera_from_object: pose }], &RenderOptions::default());
    let crop = Crop::of_box(&wide, &frame.bounding_box()?, CROP_FACTOR, side)?;
    let mut frame = VisibilityBuffer::new(&crop.camera);
    let rendered = render(&mut frame, mesh, &crop.to_crop(&pose), None);
    let (cells, points) = cells_on_object(&rendered, side / CELL);
    Some(Side { input: input_over_grey(&rendered), cells, points })
}

/// Indoor light: ambient light, and one or two lamps in front of the object.
fn lights(random: &mut Random) -> (Vec<Light>, Material) {
    let ambient = uniform(random, [0.15, 0.6]);
    let mut lights = vec![Light::Ambient { color: [ambient; 3] }];
    for _ in 0..random.random_range(1..=2u32) {
        let direction = Vec3::new(between(random, -1.2, 1.2), between(random, -0.6, 1.4), 1.0);
        let power = uniform(random, [0.25, 0.8]);
        lights.push(Light::Directional {
            direction,
            color: std::array::from_fn(|_| power * uniform(random, [0.9, 1.1])),
        });
    }
    let specular = if random.random::<f32>() < 0.5 { uniform(random, [0.0, 0.6]) } else { 0.0 };
    let plain = std::array::from_fn(|_| uniform(random, [30.0, 240.0]) as u8);
    (lights, Material { specular, shininess: uniform(random, [5.0, 60.0]), plain })
}

/// The object rendered like a photograph.
pub(crate) struct Photograph {
    pub(crate) patch: Patch,
    pub(crate) crop: Crop,
    /// In the crop's frame.
    pub(crate) pose: Pose,
    pub(crate) coordinates: PointImage,
    pub(crate) hidden: Coverage,
}

/// The box around which a photograph is cropped.
pub(crate) enum Framing {
    /// That of the whole object or of its visible part, shifted a little.
    Around {
        /// Whether it is the box of the whole object; otherwise that of the visible part.
        whole: bool,
        /// Range of the scale factor of that box.
        scale: [f64; 2],
    },
    /// A box in the image of [`wide_camera`].
    Box(Rect),
}

pub(crate) fn photograph(
    mesh: &Mesh,
    pose: &Pose,
    textures: &Backgrounds,
    side: usize,
    framing: &Framing,
    random: &mut Random,
) -> Option<Photograph> {
    let wide = wide_camera();
    let mut frame = VisibilityBuffer::new(&wide);
    frame.render(&[SceneObject { mesh, camera_from_object: *pose }], &RenderOptions::default());
    let mask = frame.mask(0);
    let mut visible = Coverage::from_fn(wide.width, wide.height, |x, y| f32::from(mask[(x, y)]));
    let mut hidden = Coverage::filled(wide.width, wide.height, 0.0);
    let [x, y, w, h] = mask.bounding_box()?.map(|v| v as f32);
    if random.random::<f32>() < 0.6 {
        let centre = [x + uniform(random, [0.0, 1.0]) * w, y + uniform(random, [0.0, 1.0]) * h];
        let fraction = uniform(random, [0.05, 0.6]);
        if let Some(cover) = occluder_of_fraction(&Shape::random(random), centre, &visible, fraction) {
            visible.remove(&cover);
            hidden = cover;
        }
    }
    let seen = visible
        .data
        .iter()
        .enumerate()
        .filter(|(_, v)| **v > 0.5)
        .map(|(i, _)| (i % wide.width, i / wide.width));
    let corners = seen.fold([usize::MAX, usize::MAX, 0, 0], |b, (x, y)| {
        [b[0].min(x), b[1].min(y), b[2].max(x), b[3].max(y)]
    });
    if corners[0] > corners[2] {
        return None;
    }
    let bbox = match framing {
        Framing::Box(bbox) => *bbox,
        Framing::Around { whole, scale } => {
            let [x0, y0, x1, y1] = corners.map(|v| v as f64);
            let seen = [x0, y0, x1 - x0 + 1.0, y1 - y0 + 1.0];
            let [x0, y0, w, h] = if *whole { [x, y, w, h].map(f64::from) } else { seen };
            let jitter = |random: &mut Random| between(random, -0.07, 0.07) * w.max(h);
            let moved = Rect { x: x0 + jitter(random), y: y0 + jitter(random), width: w, height: h };
            moved.scaled(between(random, scale[0], scale[1]))
        }
    };
    let crop = Crop::of_box(&wide, &bbox, CROP_FACTOR, side)?;
    let pose = crop.to_crop(pose);
    let mut frame = VisibilityBuffer::new(&crop.camera);
    let objects = [SceneObject { mesh, camera_from_object: pose }];
    frame.render(&objects, &RenderOptions::default());
    let (lights, material) = lights(random);
    let background: RgbImage = textures.patch(side, side, random).to_rgb();
    let mut patch = Patch::from_rgb(&shade(&frame, &objects, &lights, &material, Some(&background)));
    let hidden = in_crop(&hidden, &wide, &crop);
    patch.blend(&textures.patch(side, side, random), &hidden);
    let augmentation = ColorAugmentation { blur: [0.3, 2.0], ..ColorAugmentation::renders() };
    augmentation.apply(&mut patch, random);
    if random.random::<f32>() < 0.1 {
        let area = side * side;
        for i in 0..area {
            let grey = (patch.data[i] + patch.data[area + i] + patch.data[2 * area + i]) / 3.0;
            (0..3).for_each(|c| patch.data[c * area + i] = grey);
        }
    }
    Some(Photograph { patch, crop, pose, coordinates: frame.object_coordinates(&objects), hidden })
}

/// A coverage of the wide image, resampled to the crop.
fn in_crop(cover: &Coverage, wide: &Camera, crop: &Crop) -> Coverage {
    let back = crop.crop_from_camera.inverse();
    Coverage::from_fn(crop.camera.width, crop.camera.height, |x, y| {
        let ray = crop.camera.unproject(&sixfold_geometry::Vec2::new(x as f64, y as f64), 1.0);
        wide.project(&(back * ray)).map_or(0.0, |p| cover.sample(p.x as f32, p.y as f32))
    })
}

pub(crate) fn distance(a: &[f32; 3], b: &[f32; 3]) -> f32 {
    (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f32>().sqrt()
}

/// Generates a sample of crops of `side` pixels; `None` if the object is hardly visible.
fn attempt(textures: &Backgrounds, side: usize, random: &mut Random) -> Option<Sample> {
    let mesh = object(textures, random)?;
    let diameter = mesh.diameter();
    let rotation = random_rotation(random).rotation();
    let range = diameter * between(random, 4.0, 9.0);
    let shift = Vec3::new(between(random, -0.05, 0.05), between(random, -0.05, 0.05), 1.0) * range;
    let framing = Framing::Around { whole: false, scale: [0.9, 1.15] };
    let photograph = photograph(&mesh, &Pose::new(rotation, shift), textures, side, &framing, random)?;
    // Most meshes of users have colours, some do not.
    let bare = (random.random::<f32>() < 0.15)
        .then(|| Mesh::new(mesh.vertices().to_vec(), mesh.faces().to_vec()).ok())
        .flatten();
    let known = bare.as_ref().unwrap_or(&mesh);
    let range = 6.0 * diameter;
    let same = template(known, &nearby(&rotation, [0.0, 0.45], 0.26, random), range, side)?;
    let other = template(known, &nearby(&rotation, [0.7, 3.1], 3.1, random), range, side)?;
    let diameter = diameter as f32;
    let cells = side / CELL;
    let mut pairs = Vec::new();
    for (i, point) in same.points.iter().enumerate() {
        let seen = photograph.pose.transform_point(&Vec3::from(point.map(f64::from)));
        let Some(pixel) = photograph.crop.camera.project(&seen) else { continue };
        let (x, y) = (pixel.x.round(), pixel.y.round());
        if x < 0.0 || y < 0.0 || x >= side as f64 || y >= side as f64 {
            continue;
        }
        let there = photograph.coordinates[(x as usize, y as usize)];
        let visible = photograph.hidden.sample(x as f32, y as f32) < 0.5;
        if !there[0].is_nan() && visible && distance(&there, point) < SEEN * diameter {
            pairs.push((i, bilinear(pixel.x / CELL as f64, pixel.y / CELL as f64, cells)));
        }
    }
    if pairs.len() < MIN_POINTS {
        return None;
    }
    let mut sample = Sample {
        inputs: [input(&photograph.patch.data), same.input, other.input],
        cells: vec![],
        places: vec![],
        others: vec![],
    };
    for _ in 0..POINTS {
        let (i, places) = pairs[random.random_range(0..pairs.len())];
        let mut others = vec![false; 2 * cells * cells];
        for (first, cells_of, points) in
            [(0, &same.cells, &same.points), (cells * cells, &other.cells, &other.points)]
        {
            for (cell, point) in cells_of.iter().zip(points) {
                others[first + usize::from(*cell)] = distance(point, &same.points[i]) > SAME_POINT * diameter;
            }
        }
        sample.cells.push(usize::from(same.cells[i]));
        sample.places.push(places);
        sample.others.push(others);
    }
    Some(sample)
}

/// The four cells around a position, and their weights.
fn bilinear(x: f64, y: f64, cells: usize) -> [(usize, f32); 4] {
    let last = (cells - 1) as f64;
    let (x, y) = (x.clamp(0.0, last), y.clamp(0.0, last));
    let (x0, y0) = (x.floor().min(last - 1.0), y.floor().min(last - 1.0));
    let (fx, fy) = ((x - x0) as f32, (y - y0) as f32);
    let first = y0 as usize * cells + x0 as usize;
    [
        (first, (1.0 - fx) * (1.0 - fy)),
        (first + 1, fx * (1.0 - fy)),
        (first + cells, (1.0 - fx) * fy),
        (first + cells + 1, fx * fy),
    ]
}

/// The sample with a number.
pub(crate) fn make_sample(textures: &Backgrounds, side: usize, seed: u64, number: u64) -> Sample {
    let mut random = stream(seed, number);
    loop {
        if let Some(sample) = attempt(textures, side, &mut random) {
            return sample;
        }
    }
}
