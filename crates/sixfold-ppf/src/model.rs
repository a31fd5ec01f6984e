//! The model of an object: samples of its outer surface, and the table of its point pair features (Drost et al. 2010, section 3).
//!
//! Differences to the paper, and why:
//! * The surface is sampled from renderings around the object, not from the mesh: inner walls are excluded and normals point
//!   outwards independent of the winding (as proposed by Hinterstoisser et al. 2016, section 3.1).
//! * Every sample stores the views in which it is visible. Pairs that are not visible in a common view are not in the table: one
//!   depth image cannot show them.

use rayon::prelude::*;
use sixfold_align::verification_mesh;
use sixfold_geometry::{Camera, OptionError, PointCloud, Pose, Vec3, sphere_directions};
use sixfold_mesh::Mesh;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};
use thiserror::Error;

use crate::V3;
use crate::voting::THINNING_ANGLE;

/// Why no model can be made from a mesh.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum ModelError {
    /// The mesh has no faces to render.
    #[error(
        "the mesh has {faces} faces, a model to be matched needs a surface: give a mesh, not a point cloud"
    )]
    NoSurface {
        /// Faces found.
        faces: usize,
    },
    /// Too few samples are visible from outside.
    #[error(
        "only {found} surface samples are seen from outside, at least {needed} are needed: lower the sampling step or check the mesh"
    )]
    TooFewSamples {
        /// Samples found.
        found: usize,
        /// Samples needed.
        needed: usize,
    },
    /// Too many samples: their pairs would not fit into memory.
    #[error(
        "{found} surface samples are seen from outside, at most {maximum} are taken: raise the sampling \
         step or check the mesh for faces that cross each other"
    )]
    TooManySamples {
        /// Samples found.
        found: usize,
        /// Maximum number of samples.
        maximum: usize,
    },
    /// An option is out of range.
    #[error(transparent)]
    Option(#[from] OptionError),
}

/// Options of the model.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ModelOptions {
    /// Distance between samples as a fraction of the diameter; also the step of the feature's distance
    /// (Drost et al. 2010: 0.05).
    pub sampling_step: f64,
    /// Number of steps of each of the feature's angles over half a turn.
    pub angle_steps: usize,
}

/// Distance between samples as a fraction of the diameter (Drost et al. 2010: 0.05).
const SAMPLING_STEP: f64 = 0.05;
/// Steps of each of the feature's angles over half a turn: 12 degrees each (Drost et al. 2010: 30 steps of a whole turn).
const ANGLE_STEPS: usize = 15;

impl Default for ModelOptions {
    fn default() -> Self {
        ModelOptions { sampling_step: SAMPLING_STEP, angle_steps: ANGLE_STEPS }
    }
}

impl ModelOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_within("sampling_step", self.sampling_step, 0.02..=0.2, "0.02 to 0.2")?;
        OptionError::unless_within("angle_steps", self.angle_steps, 4..=60, "4 to 60")
    }
}

/// Views around the object from which its surface is sampled (a Fibonacci sphere), one bit each of a word.
pub(crate) const VIEWS: usize = 64;
/// Side of a view, pixels: several per sampling step. Chosen by hand; not swept.
const VIEW_PIXELS: usize = 160;
/// Distance of the views, in diameters; chosen by hand, not swept.
const VIEW_DISTANCE: f64 = 4.0;
/// Fraction of a view that a sphere of [`VIEW_SPAN`] diameters would fill, seen from its distance; chosen by hand, so that every
/// object is inside.
const VIEW_FILL: f64 = 0.9;
/// See [`VIEW_FILL`].
const VIEW_SPAN: f64 = 1.15;
/// Pixels whose normals have a z (camera frame) above this are seen at a grazing angle: their depth and normals are unreliable
/// there. Chosen by hand; not swept.
const GRAZING: f32 = -0.3;
/// A sample is visible in a view only if the cosine between its normal and the ray is below this; chosen by hand, not swept.
const SEEN_COSINE: f64 = -0.1;
/// A sample is visible in a view only if it is behind the view's depth image by less than this fraction of a sampling step: samples
/// are means over cells of that size.
const SEEN_TOLERANCE: f64 = 0.5;
/// Minimum number of samples of a model; chosen by hand, not swept.
pub(crate) const MIN_SAMPLES: usize = 20;
/// Maximum number of samples: a sphere has 12,000 at the finest sampling step. The table grows with their square, to about 2 GB
/// here.
pub(crate) const MAX_SAMPLES: usize = 16_000;
/// Points closer than this have no direction between them, metres.
const SAME_POINT: f32 = 1e-6;
/// Logarithm (metres, radians) of a transformation below which it is the identity.
const IDENTITY: f64 = 1e-9;
/// The camera's up direction is the object's z unless the ray has a z above this, where it is the object's y.
const UPRIGHT: f64 = 0.9;

/// An object prepared for matching.
#[derive(Debug, Clone)]
pub struct ObjectModel {
    pub(crate) mesh: Mesh,
    pub(crate) options: ModelOptions,
    pub(crate) diameter: f64,
    /// Centre of the bounding box, in the object's frame, metres.
    pub(crate) centre: Vec3,
    /// Samples for the feature table, in the object's frame.
    pub(crate) samples: PointCloud,
    /// Per sample, the views in which it is visible, one bit each.
    pub(crate) visible_from: Vec<u64>,
    /// Directions from the object to the views.
    pub(crate) view_directions: Vec<V3>,
    /// Symmetry transformations of the object, including the identity.
    pub(crate) symmetries: Vec<Pose>,
    pub(crate) table: FeatureTable,
}

/// The part of an [`ObjectModel`] that is slow to compute and small to store.
#[derive(Debug, Clone)]
pub(crate) struct Description {
    pub mesh: Mesh,
    pub options: ModelOptions,
    pub diameter: f64,
    pub centre: Vec3,
    pub samples: PointCloud,
    pub visible_from: Vec<u64>,
}

/// Reference points whose votes are counted together: their votes (16 kB) stay in the first-level cache.
pub(crate) const BLOCK: usize = 256;

/// Model point pairs by their quantised feature: rows of `(reference point, angle)`, each in blocks of [`BLOCK`] reference points.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct FeatureTable {
    /// Metres per distance step.
    pub distance_step: f32,
    pub distance_steps: usize,
    pub angle_steps: usize,
    /// For each row the rotations at which it casts no vote, one bit each: all of them for a row without entries, otherwise none.
    pub silent: Vec<u32>,
    /// Blocks in a row.
    pub blocks: usize,
    /// Start of each block of each row in `entries`, and the end.
    pub starts: Vec<u32>,
    /// `reference << 8 | angle`: the number of the reference point in its block and the rotation about its normal in 256ths. Sorted by
    /// angle within a block, so that successive entries vote for different reference points: a vote that waits for the one before it
    /// makes counting a fifth slower.
    pub entries: Vec<u16>,
}

impl FeatureTable {
    /// Number of the feature's row.
    #[inline]
    pub(crate) fn row(&self, distance: usize, angles: [usize; 3]) -> usize {
        ((distance * self.angle_steps + angles[0]) * self.angle_steps + angles[1]) * self.angle_steps
            + angles[2]
    }
}

/// The point pair feature of Drost et al. (2010), equation 1: distance in metres and three angles in
/// radians.
#[inline]
pub(crate) fn pair_feature(p1: &V3, n1: &V3, p2: &V3, n2: &V3) -> Option<(f32, [f32; 3])> {
    let d = p2 - p1;
    let length = d.norm();
    if length < SAME_POINT {
        return None;
    }
    let u = d / length;
    Some((length, [fast_acos(n1.dot(&u)), fast_acos(n2.dot(&u)), fast_acos(n1.dot(n2))]))
}

/// Arc cosine to 7e-5 radians (Abramowitz and Stegun 1964, 4.4.45).
#[inline]
pub(crate) fn fast_acos(x: f32) -> f32 {
    let a = x.abs().min(1.0);
    let p = ((-0.018_729_3 * a + 0.074_261) * a - 0.212_114_4) * a + 1.570_728_8;
    let r = (1.0 - a).sqrt() * p;
    if x < 0.0 { std::f32::consts::PI - r } else { r }
}

/// A frame at a point: rows of a rotation that takes the normal to the x axis.
#[inline]
pub(crate) fn local_frame(n: &V3) -> [V3; 3] {
    // Duff et al. (2017), Building an orthonormal basis, revisited.
    let sign = 1f32.copysign(n.z);
    let a = -1.0 / (sign + n.z);
    let b = n.x * n.y * a;
    [*n, V3::new(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x), V3::new(b, sign + n.y * n.y * a, -n.y)]
}

/// The angle of `d` about the frame's x axis, in 256ths of a turn.
#[inline]
pub(crate) fn turn_about_normal(frame: &[V3; 3], d: &V3) -> u8 {
    let (y, z) = (frame[1].dot(d), frame[2].dot(d));
    (z.atan2(y) * (128.0 / std::f32::consts::PI)).round() as i32 as u8
}

/// The pose for a camera aimed at `centre` from `direction`, `distance` metres away.
pub(crate) fn look_at(centre: &Vec3, direction: &Vec3, distance: f64) -> Pose {
    let z = -direction;
    let up = if z.z.abs() < UPRIGHT { Vec3::z() } else { Vec3::y() };
    let x = up.cross(&z).normalize();
    let y = z.cross(&x);
    let rotation = sixfold_geometry::Mat3::from_rows(&[x.transpose(), y.transpose(), z.transpose()]);
    let translation = -rotation * (centre + direction * distance);
    let q =
        nalgebra::UnitQuaternion::from_rotation_matrix(&nalgebra::Rotation3::from_matrix_unchecked(rotation));
    Pose::new(q, translation)
}

impl ObjectModel {
    /// Makes the model of a mesh. `symmetries` are the transformations that map the object onto itself; the identity is added.
    ///
    /// # Errors
    /// [`ModelError`].
    pub fn new(mesh: &Mesh, symmetries: &[Pose], options: &ModelOptions) -> Result<ObjectModel, ModelError> {
        options.check()?;
        if mesh.faces().is_empty() {
            return Err(ModelError::NoSurface { faces: 0 });
        }
        let diameter = mesh.diameter();
        let (low, high) = mesh.bounding_box();
        let centre = (low + high) * 0.5;
        let step = diameter * options.sampling_step;
        let directions = sphere_directions(VIEWS);
        let distance = VIEW_DISTANCE * diameter;
        let focal = VIEW_FILL * VIEW_PIXELS as f64 * distance / (diameter * VIEW_SPAN);
        let principal = (VIEW_PIXELS as f64 - 1.0) / 2.0;
        let camera = Camera {
            fx: focal,
            fy: focal,
            cx: principal,
            cy: principal,
            width: VIEW_PIXELS,
            height: VIEW_PIXELS,
            distortion: None,
        };
        let mut dense = PointCloud::default();
        let mut views = Vec::with_capacity(VIEWS);
        let mut frame = VisibilityBuffer::new(&camera);
        let flat =
            verification_mesh(mesh).map_err(|_| ModelError::NoSurface { faces: mesh.faces().len() })?;
        for direction in &directions {
            let pose = look_at(&centre, direction, distance);
            let objects = [SceneObject { mesh: &flat, camera_from_object: pose }];
            frame.render(&objects, &RenderOptions::default());
            let depth = frame.depth();
            let normals = frame.normals(&objects).map(|n| if n[2] < GRAZING { *n } else { [0.0; 3] });
            let seen = PointCloud::from_depth(&depth, Some(&normals), &camera);
            let back = seen.transformed(&pose.inverse());
            dense.points.extend(back.points);
            dense.normals.extend(back.normals);
            views.push((pose, depth));
        }
        let samples = dense.voxel_downsample(step, THINNING_ANGLE.to_radians());
        let tolerance = SEEN_TOLERANCE * step;
        let mut kept = PointCloud::default();
        let mut visible_from = Vec::new();
        for (p, n) in samples.points.iter().zip(&samples.normals) {
            let mut bits = 0u64;
            for (i, (pose, depth)) in views.iter().enumerate() {
                let q = pose.transform_point(p);
                if pose.transform_direction(n).dot(&q.normalize()) > SEEN_COSINE {
                    continue;
                }
                let Some(pixel) = camera.project(&q) else { continue };
                let (x, y) = (pixel.x.round().max(0.0) as usize, pixel.y.round().max(0.0) as usize);
                if depth.get(x, y).is_some_and(|&z| z == 0.0 || q.z < f64::from(z) + tolerance) {
                    bits |= 1 << i;
                }
            }
            if bits != 0 {
                kept.points.push(*p);
                kept.normals.push(*n);
                visible_from.push(bits);
            }
        }
        if kept.len() < MIN_SAMPLES {
            return Err(ModelError::TooFewSamples { found: kept.len(), needed: MIN_SAMPLES });
        }
        if kept.len() > MAX_SAMPLES {
            return Err(ModelError::TooManySamples { found: kept.len(), maximum: MAX_SAMPLES });
        }
        Ok(ObjectModel::assemble(
            Description { mesh: flat, options: *options, diameter, centre, samples: kept, visible_from },
            symmetries,
        ))
    }

    /// Computes the rest of the model from the description: symmetries and the feature table.
    pub(crate) fn assemble(description: Description, symmetries: &[Pose]) -> ObjectModel {
        let Description { mesh, options, diameter, centre, samples, visible_from } = description;
        let step = diameter * options.sampling_step;
        let table = build_table(&samples, &visible_from, step, diameter, options.angle_steps);
        let mut all_symmetries = vec![Pose::identity()];
        all_symmetries.extend(symmetries.iter().filter(|s| s.log().amax() > IDENTITY));
        let view_directions = sphere_directions(VIEWS).iter().map(|d| d.cast()).collect();
        ObjectModel {
            mesh,
            options,
            diameter,
            centre,
            samples,
            visible_from,
            view_directions,
            symmetries: all_symmetries,
            table,
        }
    }

    /// Largest distance between two points of the object, metres.
    pub fn diameter(&self) -> f64 {
        self.diameter
    }

    /// The surface samples from which the features are computed, in the object's frame.
    pub fn samples(&self) -> &PointCloud {
        &self.samples
    }

    /// Number of point pairs in the feature table.
    pub fn pair_count(&self) -> usize {
        self.table.entries.len()
    }

    /// The mesh that is rendered for verification (simplified if it was very fine), in the object's frame.
    pub fn mesh(&self) -> &Mesh {
        &self.mesh
    }

    /// The transformations that map the object onto itself, the identity first.
    pub fn symmetries(&self) -> &[Pose] {
        &self.symmetries
    }

    /// The number of the sampled view nearest to a camera that looks along `-direction` (a unit vector from the object to the
    /// camera, in the object's frame).
    pub(crate) fn view_of(&self, direction: &V3) -> usize {
        let mut best = (0, f32::NEG_INFINITY);
        for (i, d) in self.view_directions.iter().enumerate() {
            let c = d.dot(direction);
            if c > best.1 {
                best = (i, c);
            }
        }
        best.0
    }
}

fn build_table(
    samples: &PointCloud,
    visible_from: &[u64],
    step: f64,
    diameter: f64,
    angle_steps: usize,
) -> FeatureTable {
    let distance_steps = (diameter / step).ceil() as usize + 1;
    let blocks = samples.len().div_ceil(BLOCK);
    let mut table = FeatureTable {
        distance_step: step as f32,
        distance_steps,
        angle_steps,
        silent: vec![],
        blocks,
        starts: vec![0; distance_steps * angle_steps.pow(3) * blocks + 1],
        entries: vec![],
    };
    let points: Vec<V3> = samples.points.iter().map(|p| p.cast()).collect();
    let normals: Vec<V3> = samples.normals.iter().map(|n| n.cast()).collect();
    let per_angle = angle_steps as f32 / std::f32::consts::PI;
    let pairs: Vec<Vec<(usize, u16)>> = (0..points.len())
        .into_par_iter()
        .map(|r| {
            let frame = local_frame(&normals[r]);
            let partners = (0..points.len()).filter(|&i| i != r && visible_from[i] & visible_from[r] != 0);
            partners
                .filter_map(|i| {
                    let (length, angles) = pair_feature(&points[r], &normals[r], &points[i], &normals[i])?;
                    let distance = ((length / table.distance_step) as usize).min(distance_steps - 1);
                    let angles = angles.map(|a| ((a * per_angle) as usize).min(angle_steps - 1));
                    let turn = turn_about_normal(&frame, &(points[i] - points[r]));
                    let block = table.row(distance, angles) * blocks + r / BLOCK;
                    Some((block, u16::from_le_bytes([turn, (r % BLOCK) as u8])))
                })
                .collect()
        })
        .collect();
    // Counting sort.
    for (block, _) in pairs.iter().flatten() {
        table.starts[block + 1] += 1;
    }
    for i in 1..table.starts.len() {
        table.starts[i] += table.starts[i - 1];
    }
    let of_row = |row: &[u32]| if row[0] == row[blocks] { u32::MAX } else { 0 };
    table.silent = table.starts.windows(blocks + 1).step_by(blocks).map(of_row).collect();
    let mut next = table.starts.clone();
    table.entries = vec![0; pairs.iter().map(Vec::len).sum()];
    for (block, entry) in pairs.into_iter().flatten() {
        let at = &mut next[block];
        table.entries[*at as usize] = entry;
        *at += 1;
    }
    for block in table.starts.windows(2) {
        table.entries[block[0] as usize..block[1] as usize].sort_unstable_by_key(|e| e.rotate_left(8));
    }
    table
}
