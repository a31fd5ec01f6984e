//! Objects at rest on a table under lamps, and images of them from a colour and depth camera: scenes for datasets.
//!
//! A scene is a deterministic function of its options and its number, to the pixel.

use std::f64::consts::TAU;

use rand::seq::SliceRandom;
use rand::{Rng, RngExt};
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::random::{Random, stream};
use sixfold_geometry::{Camera, DepthImage, Pose, RgbImage, Vec3};
use sixfold_mesh::{Mesh, MeshError};
use sixfold_render::{
    DepthSensor, Light, Material, RenderOptions, SceneObject, VisibilityBuffer, shade, simulate_depth,
};

use crate::parts::ConvexParts;
use crate::pile::{PileOptions, drop_objects};
use crate::view::ViewPoint;

/// Attempts to drop the objects of a scene if none comes to rest; after that it stays empty.
const TRIES: u64 = 5;
/// Largest offset of the point at which cameras are aimed, metres, and largest roll ([`ROLL`]), radians.
const AIM: f64 = 0.1;
const ROLL: f64 = 0.12;

/// Options of the scenes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TabletopOptions {
    /// Fewest and most objects.
    pub objects: [usize; 2],
    /// How they are dropped.
    pub pile: PileOptions,
    /// Smallest and largest distance of the camera, metres.
    pub distance: [f64; 2],
    /// Lowest and highest elevation of the camera above the table, degrees.
    pub elevation_degrees: [f64; 2],
    /// Seed of everything random.
    pub seed: u64,
}

/// Objects at rest on a table.
pub struct Tabletop {
    /// Index of each object at rest and its world_from_object, metres; the table is z = 0.
    pub resting: Vec<(usize, Pose)>,
    /// Objects that were dropped; some may not have come to rest within reach.
    pub dropped: usize,
    options: TabletopOptions,
    table: Mesh,
    lights: Lights,
    random: Random,
}

/// Images of one camera.
pub struct TabletopImage {
    /// Depth as measured by the sensor, metres.
    pub depth: DepthImage,
    /// Colour under the scene's lamps; `None` unless it was requested.
    pub rgb: Option<RgbImage>,
    /// The poses of [`Tabletop::resting`] in the camera's frame.
    pub camera_from_object: Vec<Pose>,
}

impl Tabletop {
    /// Selects some of the objects, given as convex parts, and drops them until at least one of them rests.
    ///
    /// # Errors
    /// If the table's mesh cannot be made.
    pub fn new(
        objects: &[&ConvexParts],
        options: &TabletopOptions,
        number: u32,
    ) -> Result<Tabletop, MeshError> {
        let mut random = stream(options.seed, 3 << 40 | u64::from(number));
        let (resting, dropped) = settle(objects, options, number, &mut random);
        let (table, lights) = (table(&mut random)?, Lights::random(&mut random));
        Ok(Tabletop { resting, dropped, options: *options, table, lights, random })
    }

    /// The next camera's camera_from_world: it is aimed near the centre of the table.
    pub fn next_camera(&mut self) -> Pose {
        let (options, random) = (&self.options, &mut self.random);
        let target = Vec3::from_fn(|axis, _| match axis {
            2 => between(random, 0.0, 0.5 * AIM),
            _ => between(random, -AIM, AIM),
        });
        let [low, high] = options.elevation_degrees;
        let view = ViewPoint {
            azimuth: between(random, 0.0, TAU),
            elevation: between(random, low, high).to_radians(),
            distance: between(random, options.distance[0], options.distance[1]),
            target,
        };
        let roll = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), between(random, -ROLL, ROLL));
        (view.world_from_camera() * Pose::new(roll, Vec3::zeros())).inverse()
    }

    /// The images of a camera. `meshes` are those of all objects from which the scene was made; `noise` is the seed of the sensor's
    /// noise (an ideal sensor has none).
    pub fn image(
        &self,
        meshes: &[&Mesh],
        camera: &Camera,
        camera_from_world: &Pose,
        sensor: Option<(&DepthSensor, u64)>,
        colour: bool,
    ) -> TabletopImage {
        let camera_from_object: Vec<Pose> = self
            .resting
            .iter()
            .map(|(_, world_from_object)| *camera_from_world * *world_from_object)
            .collect();
        let objects: Vec<SceneObject<'_>> = self
            .resting
            .iter()
            .zip(&camera_from_object)
            .map(|((object, _), pose)| (meshes[*object], *pose))
            .chain([(&self.table, *camera_from_world)])
            .map(|(mesh, camera_from_object)| SceneObject { mesh, camera_from_object })
            .collect();
        let mut frame = VisibilityBuffer::new(camera);
        frame.render(&objects, &RenderOptions::default());
        let ideal = frame.depth();
        let depth = match sensor {
            None => ideal,
            Some((sensor, noise)) => simulate_depth(&ideal, &frame.normals(&objects), sensor, noise),
        };
        let lights = self.lights.seen_from(camera_from_world);
        let rgb = colour.then(|| shade(&frame, &objects, &lights, &Material::default(), None));
        TabletopImage { depth, rgb, camera_from_object }
    }
}

/// Selects objects and drops them until at least one of them rests: their indices and poses, and the number dropped.
fn settle(
    objects: &[&ConvexParts],
    options: &TabletopOptions,
    number: u32,
    random: &mut Random,
) -> (Vec<(usize, Pose)>, usize) {
    let count = random.random_range(options.objects[0]..=options.objects[1]);
    let mut chosen: Vec<usize> = vec![];
    while chosen.len() < count {
        let mut round: Vec<usize> = (0..objects.len()).collect();
        round.shuffle(random);
        chosen.extend(round.into_iter().take(count - chosen.len()));
    }
    let parts: Vec<&ConvexParts> = chosen.iter().map(|&object| objects[object]).collect();
    // Another random stream than that of the objects' shapes, so that the two are independent.
    let seed = options.seed ^ 0x7069_6c65;
    let mut resting: Vec<(usize, Pose)> = vec![];
    for attempt in 0..TRIES {
        let poses = drop_objects(&parts, &options.pile, seed, attempt << 32 | u64::from(number));
        resting = chosen.iter().zip(poses).filter_map(|(object, pose)| Some((*object, pose?))).collect();
        if !resting.is_empty() {
            break;
        }
    }
    (resting, count)
}

/// A square table top at z = 0 with sides of 1 to 3 m in a dull colour.
fn table(random: &mut impl Rng) -> Result<Mesh, MeshError> {
    let half = between(random, 0.5, 1.5);
    let corners = [(-half, -half), (half, -half), (half, half), (-half, half)];
    let grey = between(random, 70.0, 190.0);
    let color = [0; 3].map(|_: u8| (grey + between(random, -25.0, 25.0)) as u8);
    let mesh = Mesh::new(corners.map(|(x, y)| Vec3::new(x, y, 0.0)).to_vec(), vec![[0, 1, 2], [0, 2, 3]])?;
    mesh.with_colors(vec![color; 4])
}

/// Directions of the lights in a scene, world frame.
struct Lights {
    direction: Vec3,
    ambient: f32,
    lamp: f32,
}

impl Lights {
    fn random(random: &mut impl Rng) -> Self {
        let angle = between(random, 0.0, TAU);
        let direction = Vec3::new(0.8 * angle.cos(), 0.8 * angle.sin(), -between(random, 0.6, 1.6));
        let ambient = between(random, 0.25, 0.45) as f32;
        Lights { direction, ambient, lamp: 1.05 - ambient }
    }

    fn seen_from(&self, camera_from_world: &Pose) -> [Light; 2] {
        let direction = camera_from_world.transform_direction(&self.direction);
        [Light::Ambient { color: [self.ambient; 3] }, Light::Directional { direction, color: [self.lamp; 3] }]
    }
}

fn between(random: &mut impl Rng, low: f64, high: f64) -> f64 {
    low + (high - low) * random.random::<f64>()
}
