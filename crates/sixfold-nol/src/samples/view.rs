//! One sample: a target view, and source views with clutter, other light, other colours and inaccurate poses (dissertation, table
//! 4.1).

use rand::RngExt;
use serde::{Deserialize, Serialize};
use sixfold_geometry::nalgebra::{UnitQuaternion, Vector3};
use sixfold_geometry::random::{Random, stream, uniform};
use sixfold_geometry::{Camera, Mat3, Pose, Vec3};
use sixfold_synth::augment::{
    Backgrounds, ColorAugmentation, Coverage, Patch, Shape, Window, occluder_of_fraction,
};

use super::object::{Lamp, PaintedObject, between, random_direction};
use crate::projection::TargetSurface;
use crate::source::{MARGIN, SourceView};
use crate::window::object_window;

/// The target's side in units of the object's box in the image.
const TARGET_MARGIN: f64 = 1.1;

/// How samples are made.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ViewSampleOptions {
    /// Smallest and largest length of an object's longest side, metres.
    pub size: [f64; 2],
    /// Smallest and largest distance from camera to object, metres.
    pub distance: [f64; 2],
    /// Largest translation error of the sources' poses along every axis, metres (table 4.1).
    pub translation: f64,
    /// Largest rotation error about every axis, radians (table 4.1).
    pub rotation: f64,
    /// Fraction of the samples with good poses, as after refinement: with 0 to 30 % of these errors.
    pub good_poses: f64,
    /// Probability of an occluder in front of the object in a source.
    pub occluded: f64,
    /// Largest fraction of the object that it hides.
    pub occlusion: f32,
    /// Probability that the source's mask excludes the hidden part.
    pub mask_known: f64,
    /// Probability that a source is blurred, before the blur of table 4.1.
    pub blurred: f64,
    /// Whether the lamp changes from source to source, and surfaces have highlights.
    pub other_light: bool,
}

impl Default for ViewSampleOptions {
    fn default() -> Self {
        ViewSampleOptions {
            size: [0.06, 0.3],
            distance: [0.4, 1.2],
            translation: 0.01,
            rotation: 0.05,
            good_poses: 0.5,
            occluded: 0.4,
            occlusion: 0.4,
            mask_known: 0.7,
            blurred: 0.4,
            other_light: true,
        }
    }
}

impl ViewSampleOptions {
    /// The dissertation's: the changes of table 4.1 alone, all poses rough.
    pub fn published() -> Self {
        ViewSampleOptions {
            good_poses: 0.0,
            occluded: 0.0,
            blurred: 0.0,
            other_light: false,
            ..ViewSampleOptions::default()
        }
    }
}

/// Input of the network and its ground truth.
#[derive(Debug, Clone)]
pub struct Sample {
    /// The photographs' crops, with inaccurate poses.
    pub sources: Vec<SourceView>,
    /// The surface points of the target view; its pose is exact.
    pub surface: TargetSurface,
    /// X^GT, `side x side`.
    pub target: Patch,
}

/// The sample with this number and `sources` sources, all crops `side` pixels wide; the same for the same seed.
pub fn make_sample(
    textures: &Backgrounds,
    options: &ViewSampleOptions,
    side: usize,
    sources: usize,
    seed: u64,
    number: u64,
) -> Sample {
    let random = &mut stream(seed, number);
    let object = PaintedObject::random(textures, options.size, random);
    let camera = photographs_camera(random);
    // Half of the objects are seen from above only, as on a table.
    let upright = random.random::<bool>();
    let direction = |random: &mut Random| {
        let d = random_direction(random);
        if upright { Vec3::new(d.x, d.y, d.z.abs()) } else { d }
    };
    let off = if random.random::<f64>() < options.good_poses { between(random, 0.0, 0.3) } else { 1.0 };
    let shiny = random.random::<bool>();
    let lamp = Lamp {
        towards: direction(random),
        ambient: uniform(random, [0.5, 0.9]),
        diffuse: uniform(random, [0.1, 0.6]),
        specular: 0.0,
        shininess: uniform(random, [8.0, 60.0]),
    };
    // Either the object is fixed and the camera moves around it, or the object rotates under a fixed lamp.
    let object_rotates = random.random::<f64>() < 0.3;

    let from = direction(random);
    let pose = seen_from(&from, options, random);
    let window = window_of(&camera, &object, &pose, TARGET_MARGIN);
    let target_camera = window.camera(&camera, side);
    let surface = TargetSurface::new(&object.mesh, &target_camera, &pose);
    let (target, _) = object.draw(&target_camera, &pose, &lamp, Patch::filled(side, side, [0.5; 3]));

    let sources = (0..sources)
        .map(|_| {
            // Sources should show the surface of the target: most are within 60 degrees.
            let around = direction(random);
            let near = between(random, 0.3, 2.0);
            let from = (from * near + around).try_normalize(1e-6).unwrap_or(around);
            let pose = seen_from(&from, options, random);
            let lamp = if options.other_light {
                other_light(&lamp, object_rotates.then(|| direction(random)), shiny, random)
            } else {
                lamp
            };
            source(&object, textures, options, &camera, &pose, off, &lamp, side, random)
        })
        .collect();
    Sample { sources, surface, target }
}

/// The light of another photograph: from elsewhere, or from nearly the same direction; highlights on shiny objects.
fn other_light(lamp: &Lamp, elsewhere: Option<Vec3>, shiny: bool, random: &mut Random) -> Lamp {
    let towards = elsewhere.unwrap_or_else(|| lamp.towards + random_direction(random) * 0.3);
    Lamp {
        towards: towards.try_normalize(1e-6).unwrap_or(lamp.towards),
        ambient: lamp.ambient * uniform(random, [0.85, 1.15]),
        diffuse: lamp.diffuse * uniform(random, [0.8, 1.2]),
        specular: if shiny { uniform(random, [0.0, 0.6]) } else { 0.0 },
        ..*lamp
    }
}

/// A camera of 640x480 pixels.
fn photographs_camera(random: &mut Random) -> Camera {
    let f = between(random, 480.0, 680.0);
    Camera { fx: f, fy: f, cx: 319.5, cy: 239.5, width: 640, height: 480, distortion: None }
}

/// The pose of an object seen from a direction (object frame), at a random position in the image.
fn seen_from(direction: &Vec3, options: &ViewSampleOptions, random: &mut Random) -> Pose {
    let z = -direction;
    let helper = if z.z.abs() < 0.95 { Vec3::z() } else { Vec3::x() };
    let x = z.cross(&helper).normalize();
    let y = z.cross(&x);
    let rotation = UnitQuaternion::from_matrix(&Mat3::from_columns(&[x, y, z]).transpose());
    let roll = if random.random::<f64>() < 0.8 { 0.5 } else { std::f64::consts::PI };
    let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), between(random, -roll, roll));
    let distance = between(random, options.distance[0], options.distance[1]);
    let aside = Vec3::new(between(random, -0.3, 0.3), between(random, -0.22, 0.22), 1.0);
    Pose::new(roll * rotation, aside * distance)
}

/// A pose with the errors of table 4.1, scaled by `fraction`.
fn perturbed(pose: &Pose, options: &ViewSampleOptions, fraction: f64, random: &mut Random) -> Pose {
    let mut each = |most: f64| Vec3::from_fn(|_, _| fraction * most * (2.0 * random.random::<f64>() - 1.0));
    let (shift, angles) = (each(options.translation), each(options.rotation));
    let turn = UnitQuaternion::from_euler_angles(angles.x, angles.y, angles.z);
    Pose::new(turn * pose.rotation(), pose.translation() + shift)
}

fn window_of(camera: &Camera, object: &PaintedObject, pose: &Pose, margin: f64) -> Window {
    object_window(camera, &object.mesh, pose, margin)
        .unwrap_or_else(|| unreachable!("an object of 30 cm at 40 cm lies before the camera"))
}

#[allow(clippy::too_many_arguments)]
fn source(
    object: &PaintedObject,
    textures: &Backgrounds,
    options: &ViewSampleOptions,
    camera: &Camera,
    pose: &Pose,
    off: f64,
    lamp: &Lamp,
    side: usize,
    random: &mut Random,
) -> SourceView {
    let said = perturbed(pose, options, off, random);
    let camera = window_of(camera, object, &said, MARGIN).camera(camera, side);
    let (mut patch, seen) = object.draw(&camera, pose, lamp, textures.patch(side, side, random));
    patch.soften_border(&seen, 0.7);
    let mut visible = Coverage::filled(side, side, 1.0);
    if random.random::<f64>() < options.occluded {
        let shape = Shape::random(random);
        let centre = [0; 2].map(|_| random.random::<f32>() * side as f32);
        let fraction = uniform(random, [0.05, options.occlusion]);
        if let Some(cover) = occluder_of_fraction(&shape, centre, &seen, fraction) {
            patch.blend(&textures.patch(side, side, random), &cover);
            if random.random::<f64>() < options.mask_known {
                visible.remove(&cover);
            }
        }
    }
    // Small objects are enlarged by the crop and appear blurred.
    if random.random::<f64>() < options.blurred {
        patch.blur(uniform(random, [0.0, 1.2]));
    }
    ColorAugmentation::table_4_1().apply(&mut patch, random);
    SourceView::of_crop(patch, visible, camera, said, &object.mesh)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_keep_to_their_seed_and_sources_see_the_target() {
        let textures = Backgrounds::procedural();
        let options = ViewSampleOptions::default();
        let sample = |number| make_sample(&textures, &options, 64, 4, 3, number);
        let (a, b) = (sample(5), sample(5));
        assert_eq!(a.target, b.target);
        assert_eq!(a.sources[2].patch, b.sources[2].patch);
        let (mut seen, mut all) = (0, 0);
        for number in 0..20 {
            let s = sample(number);
            assert!(s.surface.pixels.len() > 200, "{}", s.surface.pixels.len());
            for source in &s.sources {
                let projection = source.project(&s.surface);
                seen += projection.cosines.iter().filter(|c| **c > 0.0).count();
                all += projection.cosines.len();
            }
        }
        let fraction = seen as f64 / all as f64;
        assert!((0.4..0.95).contains(&fraction), "{fraction}");
    }

    #[test]
    fn without_perturbation_sources_show_the_targets_colours() {
        let options = ViewSampleOptions {
            translation: 0.0,
            rotation: 0.0,
            occluded: 0.0,
            ..ViewSampleOptions::default()
        };
        let [same, other] = differences(&options);
        println!("{same} {other}");
        assert!(same < 0.13 && same < 0.7 * other, "{same} {other}");
    }

    #[test]
    fn as_published_only_the_changes_of_table_4_1_are_made() {
        let ViewSampleOptions { translation, rotation, good_poses, occluded, blurred, other_light, .. } =
            ViewSampleOptions::published();
        assert_eq!((translation, rotation), (0.01, 0.05));
        assert_eq!((good_poses, occluded, blurred, other_light), (0.0, 0.0, 0.0, false));
        // The light alone: two sources of exact pose differ less.
        let exact = |other_light| ViewSampleOptions {
            translation: 0.0,
            rotation: 0.0,
            other_light,
            ..ViewSampleOptions::published()
        };
        let textures = Backgrounds::procedural();
        let spread = |options: &ViewSampleOptions| -> f32 {
            let mean = |s: &SourceView, surface: &TargetSurface| {
                let projection = s.project(surface);
                let at = |p: &[f32; 2]| s.patch.data[p[1] as usize * 64 + p[0] as usize];
                let seen = projection.pixels.iter().zip(&projection.cosines).filter(|(_, c)| **c > 0.3);
                let values: Vec<f32> = seen.map(|(p, _)| at(p)).collect();
                values.iter().sum::<f32>() / values.len().max(1) as f32
            };
            let differences = (0..40).map(|number| {
                let s = make_sample(&textures, options, 64, 2, 1, number);
                (mean(&s.sources[0], &s.surface) - mean(&s.sources[1], &s.surface)).abs()
            });
            differences.sum::<f32>() / 40.0
        };
        let (same, other) = (spread(&exact(false)), spread(&exact(true)));
        println!("{same} {other}");
        assert!(same < 0.9 * other, "{same} {other}");
    }

    /// Mean difference in colour between the target and the source at the same point, and at another point of the object.
    fn differences(options: &ViewSampleOptions) -> [f32; 2] {
        let textures = Backgrounds::procedural();
        let (mut off, mut elsewhere) = (vec![], vec![]);
        for number in 0..8 {
            let s = make_sample(&textures, options, 96, 1, 1, number);
            let projection = s.sources[0].project(&s.surface);
            for (i, (place, cosine)) in projection.pixels.iter().zip(&projection.cosines).enumerate() {
                if *cosine > 0.3 {
                    let at = s.surface.pixels[i] as usize;
                    let (x, y) = (place[0] as usize, place[1] as usize);
                    off.push((s.target.data[at] - s.sources[0].patch.data[y * 96 + x]).abs());
                    // Another of the object's points: the same light, another position.
                    let other = projection.pixels[(i + 401) % projection.pixels.len()];
                    let (x, y) = (other[0] as usize, other[1] as usize);
                    elsewhere.push((s.target.data[at] - s.sources[0].patch.data[y * 96 + x]).abs());
                }
            }
        }
        let mean = |all: &[f32]| all.iter().sum::<f32>() / all.len() as f32;
        [mean(&off), mean(&elsewhere)]
    }
}
