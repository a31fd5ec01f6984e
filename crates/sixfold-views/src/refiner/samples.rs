//! Training samples of the refiner: synthetic objects rendered like photographs, each with renders at poses near the true one and
//! at wrong ones.
//!
//! A sample is a function of seed and number alone.

use rand::RngExt;
use sixfold_align::outline::projected_box;
use sixfold_geometry::nalgebra::{Unit, UnitQuaternion};
use sixfold_geometry::random::{Random, stream};
use sixfold_geometry::{Pose, Vec2, Vec3};
use sixfold_mesh::Mesh;
use sixfold_nn::xfeat::CELL;
use sixfold_render::VisibilityBuffer;
use sixfold_synth::augment::Backgrounds;
use sixfold_synth::distractors::random_rotation;

use super::{HALF_CELL, Shown, shown};
use crate::network::input;
use crate::samples::{Framing, Photograph, SEEN, between, distance, object, photograph};
use crate::templates::{CROP_FACTOR, wide_camera};

/// Renders per photograph.
pub(crate) const RENDERS: usize = 4;
/// Fewest cells that show the object in a render.
const MIN_CELLS: usize = 12;
/// The largest changes of a pose that is to be refined: an angle (radians), a displacement in cells, a factor of distance.
const ANGLE: f64 = 0.5;
const SHIFT: f64 = 2.2;
const DISTANCE: f64 = 0.16;

/// How the photograph of a sample is cropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// Around the box of the object or of its visible part, as a detector gives it.
    Detected,
    /// Around the object at a pose that is to be refined: the size of the crop does not reveal the object's distance.
    Close,
}

/// A photograph and renders of the same object.
pub(crate) struct RefinerSample {
    /// The network's input of the photograph.
    pub photograph: Vec<f32>,
    /// The renders.
    pub renders: Vec<Target>,
}

/// A render, and the positions of its points in the photograph.
pub(crate) struct Target {
    /// The render.
    pub shown: Shown,
    /// For each of its cells, the displacement to the position of its point in the photograph, cells.
    pub flow: Vec<[f32; 2]>,
    /// Whether the photograph shows the point at all.
    pub visible: Vec<bool>,
}

/// A random pose near another; `size` from 0 to 1 scales the change.
fn near(pose: &Pose, centre: &Vec3, focal: f64, size: f64, random: &mut Random) -> Pose {
    let axis = Vec3::from_fn(|_, _| between(random, -1.0, 1.0));
    let axis = Unit::try_new(axis, 1e-6).unwrap_or_else(Vec3::z_axis);
    let rotation = UnitQuaternion::from_axis_angle(&axis, size * ANGLE * random.random::<f64>());
    moved(pose, centre, focal, &rotation, size, random)
}

/// The pose rotated about the object's centre, which is also shifted.
fn moved(
    pose: &Pose,
    centre: &Vec3,
    focal: f64,
    rotation: &UnitQuaternion<f64>,
    size: f64,
    random: &mut Random,
) -> Pose {
    let at = pose.transform_point(centre);
    let cells = |random: &mut Random| between(random, -1.0, 1.0) * size * SHIFT * CELL as f64 * at.z / focal;
    let aside = Vec3::new(cells(random), cells(random), 0.0);
    let to = (at + aside) * (between(random, -1.0, 1.0) * size * DISTANCE).exp();
    let rotation = rotation * pose.rotation();
    Pose::new(rotation, to - rotation * centre)
}

/// The poses to render in a crop around a box: three to refine, often nearly right, and a wrong one.
fn poses(pose: &Pose, centre: &Vec3, focal: f64, random: &mut Random) -> [Pose; RENDERS] {
    std::array::from_fn(|k| {
        let size = random.random::<f64>();
        match k {
            0 => near(pose, centre, focal, size * size, random),
            1 | 2 => near(pose, centre, focal, size, random),
            _ => wrong(pose, centre, focal, random),
        }
    })
}

/// The poses to render in a crop around the object at the pose `start`: this one, one between it and the true pose, one very close
/// to the true pose, and a wrong one.
fn later_poses(pose: &Pose, start: &Pose, centre: &Vec3, focal: f64, random: &mut Random) -> [Pose; RENDERS] {
    std::array::from_fn(|k| match k {
        0 => *start,
        1 => {
            let part = random.random::<f64>();
            let rotation = pose.rotation().slerp(&start.rotation(), part);
            let at = pose.transform_point(centre).lerp(&start.transform_point(centre), part);
            near(&Pose::new(rotation, at - rotation * centre), centre, focal, 0.2, random)
        }
        2 => near(pose, centre, focal, 0.2, random),
        _ => wrong(pose, centre, focal, random),
    })
}

fn wrong(pose: &Pose, centre: &Vec3, focal: f64, random: &mut Random) -> Pose {
    let other = random_rotation(random).rotation();
    let angle = other.angle().max(ANGLE);
    let axis = other.axis().unwrap_or_else(Vec3::z_axis);
    moved(pose, centre, focal, &UnitQuaternion::from_axis_angle(&axis, angle), 0.5, random)
}

fn target(shown: Shown, photograph: &Photograph, diameter: f32) -> Target {
    let side = photograph.crop.camera.width;
    let cells = side / CELL;
    let mut out = Target { flow: Vec::new(), visible: Vec::new(), shown };
    for (cell, point) in out.shown.cells.iter().zip(&out.shown.points) {
        let from = cell_centre(usize::from(*cell), cells);
        let there = photograph.pose.transform_point(&Vec3::from(point.map(f64::from)));
        let pixel = photograph.crop.camera.project(&there);
        let flow = pixel.map_or([0.0; 2], |p| [p.x - from.x, p.y - from.y].map(|v| (v / CELL as f64) as f32));
        let visible = pixel.is_some_and(|p| {
            let (x, y) = (p.x.round(), p.y.round());
            if x < 0.0 || y < 0.0 || x >= side as f64 || y >= side as f64 {
                return false;
            }
            let seen = photograph.coordinates[(x as usize, y as usize)];
            !seen[0].is_nan()
                && photograph.hidden.sample(x as f32, y as f32) < 0.5
                && distance(&seen, point) < SEEN * diameter
        });
        out.flow.push(flow);
        out.visible.push(visible);
    }
    out
}

/// The pixel at the centre of a cell.
pub(crate) fn cell_centre(cell: usize, cells: usize) -> Vec2 {
    Vec2::new((cell % cells * CELL + HALF_CELL) as f64, (cell / cells * CELL + HALF_CELL) as f64)
}

fn attempt(textures: &Backgrounds, kind: Kind, side: usize, random: &mut Random) -> Option<RefinerSample> {
    let mesh = object(textures, random)?;
    let diameter = mesh.diameter();
    let rotation = random_rotation(random).rotation();
    let range = diameter * between(random, 4.0, 9.0);
    let shift = Vec3::new(between(random, -0.05, 0.05), between(random, -0.05, 0.05), 1.0) * range;
    let pose = Pose::new(rotation, shift);
    let (low, high) = mesh.bounding_box();
    let centre = (low + high) * 0.5;
    let start = (kind == Kind::Close).then(|| {
        // Where a crop around the object has about this focal length.
        let focal = side as f64 / CROP_FACTOR * range / diameter;
        near(&pose, &centre, focal, 0.7 * random.random::<f64>(), random)
    });
    let framing = match &start {
        Some(start) => Framing::Box(projected_box(&mesh, &wide_camera(), start)?),
        None => Framing::Around { whole: random.random::<f32>() < 0.5, scale: [0.8, 1.25] },
    };
    let photograph = photograph(&mesh, &pose, textures, side, &framing, random)?;
    let bare = (random.random::<f32>() < 0.15)
        .then(|| Mesh::new(mesh.vertices().to_vec(), mesh.faces().to_vec()).ok())
        .flatten();
    let known = bare.as_ref().unwrap_or(&mesh);
    let camera = &photograph.crop.camera;
    let mut frame = VisibilityBuffer::new(camera);
    let mut renders = Vec::with_capacity(RENDERS);
    let poses = match start {
        Some(start) => {
            let start = photograph.crop.to_crop(&start);
            later_poses(&photograph.pose, &start, &centre, camera.fx, random)
        }
        None => poses(&photograph.pose, &centre, camera.fx, random),
    };
    for pose in poses {
        let shown = shown(&mut frame, known, &pose)?;
        if shown.cells.len() < MIN_CELLS {
            return None;
        }
        renders.push(target(shown, &photograph, diameter as f32));
    }
    Some(RefinerSample { photograph: input(&photograph.patch.data), renders })
}

/// The sample with a number, in a crop of `side` pixels.
pub(crate) fn make_sample(
    textures: &Backgrounds,
    kind: Kind,
    side: usize,
    seed: u64,
    number: u64,
) -> RefinerSample {
    let mut random = stream(seed, number);
    loop {
        if let Some(sample) = attempt(textures, kind, side, &mut random) {
            return sample;
        }
    }
}
