//! Simulated photographs of an object on the board, with exact ground truth: for tests, and to try ways of taking photographs.
//!
//! Rendered are the printed board or a patterned cloth on a table, and the object with a shadow; the lamp changes from photograph
//! to photograph. Then lens distortion, blur, motion and noise are applied; the caller may store the images as JPEG.

use rayon::prelude::*;
use sixfold_board::Board;
use sixfold_geometry::nalgebra::{Rotation3, UnitQuaternion};
use sixfold_geometry::random::{normal, stream, uniform};
use sixfold_geometry::{BrownConrady, Camera, DepthImage, Image, Mask, Mat3, Pose, RgbImage, Vec2, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::{DepthSensor, Light, Material, SceneObject, VisibilityBuffer, shade, simulate_depth};

pub use crate::ground::patterned;
use crate::view::bilinear_rgb;

/// How much more than the camera's image is rendered on each side, as a fraction of its size.
const MARGIN: f64 = 0.05;

/// Options of the simulated photographs.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulationOptions {
    /// Number of photographs, in two circles of different height.
    pub photographs: usize,
    /// The camera, with its distortion.
    pub camera: Camera,
    /// Minimum and maximum distance from the object, metres.
    pub distance: [f64; 2],
    /// Standard deviation of blur, pixels.
    pub blur: f64,
    /// Longest motion while the shutter is open, pixels.
    pub motion: f64,
    /// Standard deviation of noise, grey levels.
    pub noise: f64,
    /// Total rotation of object and board about the vertical axis, degrees: 360 for all sides.
    pub around: f64,
}

impl Default for SimulationOptions {
    fn default() -> Self {
        let distortion = Some(BrownConrady { k1: 0.08, k2: -0.15, p1: 0.0006, p2: -0.0004, k3: 0.0 });
        let camera =
            Camera { fx: 980.0, fy: 978.5, cx: 513.2, cy: 380.9, width: 1024, height: 768, distortion };
        SimulationOptions {
            photographs: 20,
            camera,
            distance: [0.42, 0.55],
            blur: 0.7,
            motion: 2.0,
            noise: 2.0,
            around: 360.0,
        }
    }
}

/// A capture with known ground truth.
pub struct SimulatedCapture<'a> {
    /// The camera's true poses.
    pub camera_from_board: Vec<Pose>,
    /// The object's pose on the board.
    pub board_from_object: Pose,
    scene: Scene<'a>,
    options: &'a SimulationOptions,
    seed: u64,
}

impl<'a> SimulatedCapture<'a> {
    /// An object that stands upright (its z axis up) on a board. `ground` is the texture of the table. The same seed gives the same
    /// images.
    pub fn new(
        mesh: &'a Mesh,
        board: &Board,
        ground: &'a RgbImage,
        options: &'a SimulationOptions,
        seed: u64,
    ) -> SimulatedCapture<'a> {
        let [low, high] = board.extent();
        let sheet = quad(low, high, 0.0, 1.0, &board.image(6.0));
        SimulatedCapture::on_sheet(mesh, sheet, ground, options, seed)
    }

    /// An object that stands on a square cloth instead of a board: `cloth` covers `side` metres, for example [`patterned`]. The
    /// same seed gives the same images; poses are those of [`SimulatedCapture::new`].
    pub fn without_board(
        mesh: &'a Mesh,
        (cloth, side): (&RgbImage, f64),
        ground: &'a RgbImage,
        options: &'a SimulationOptions,
        seed: u64,
    ) -> SimulatedCapture<'a> {
        let half = Vec2::repeat(0.5 * side);
        SimulatedCapture::on_sheet(mesh, quad(-half, half, 0.0, 1.0, cloth), ground, options, seed)
    }

    fn on_sheet(
        mesh: &'a Mesh,
        sheet: Mesh,
        ground: &'a RgbImage,
        options: &'a SimulationOptions,
        seed: u64,
    ) -> SimulatedCapture<'a> {
        let (low, high) = mesh.bounding_box();
        let mut random = stream(seed, 0);
        let angle = f64::from(uniform(&mut random, [0.0, std::f32::consts::TAU]));
        let rotation = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), angle);
        let base_centre = Vec3::new(0.5 * (low.x + high.x), 0.5 * (low.y + high.y), low.z);
        let board_from_object = Pose::new(rotation, -(rotation * base_centre));
        let target = Vec3::new(0.0, 0.0, 0.4 * (high.z - low.z));
        let pose = |i: usize| {
            let mut random = stream(seed, 1 + i as u64);
            let rise = if i % 3 == 2 { [52.0, 66.0] } else { [28.0, 42.0] };
            let jitter = f64::from(uniform(&mut random, [-0.3, 0.3]));
            let azimuth = options.around * (i as f64 + jitter) / options.photographs as f64;
            let elevation = f64::from(uniform(&mut random, rise));
            let [near, far] = options.distance;
            let distance = f64::from(uniform(&mut random, [near as f32, far as f32]));
            let roll = f64::from(uniform(&mut random, [-8.0, 8.0]));
            looking_at(&target, azimuth, elevation, distance, roll)
        };
        let camera_from_board = (0..options.photographs).map(pose).collect();
        let scene = Scene::new(mesh, sheet, ground, &board_from_object);
        SimulatedCapture { camera_from_board, board_from_object, scene, options, seed }
    }

    /// A photograph as the camera stores it; `None` beyond the last.
    pub fn photograph(&self, number: usize) -> Option<RgbImage> {
        let pose = self.camera_from_board.get(number)?;
        Some(self.scene.photograph(pose, self.options, stream(self.seed, 1000 + number as u64)))
    }

    /// Depth from the same camera pose, metres, without lens distortion and noise; `None` beyond the last.
    pub fn depth(&self, number: usize) -> Option<DepthImage> {
        let pose = self.camera_from_board.get(number)?;
        let mut buffer = VisibilityBuffer::new(&self.options.camera.without_distortion());
        buffer.render(&self.scene.objects(pose), &Default::default());
        Some(buffer.depth())
    }

    /// Depth as a sensor measures it from the same camera pose, metres, for the pixels of the photograph with its lens distortion; 0
    /// where nothing was measured. `None` beyond the last.
    pub fn measured_depth(&self, number: usize, sensor: &DepthSensor) -> Option<DepthImage> {
        let pose = self.camera_from_board.get(number)?;
        let (lens, objects) = (&self.options.camera, self.scene.objects(pose));
        let mut buffer = VisibilityBuffer::new(&lens.without_distortion());
        buffer.render(&objects, &Default::default());
        let seed = self.seed.wrapping_add(2000 + number as u64);
        let noisy = simulate_depth(&buffer.depth(), &buffer.normals(&objects), sensor, seed);
        let inside = |p: f64, size: usize| (p > -0.5 && p < size as f64 - 0.5).then(|| p.round() as usize);
        Some(Image::from_fn(lens.width, lens.height, |x, y| {
            let source = lens.undistort_point(&Vec2::new(x as f64, y as f64));
            source
                .and_then(|p| Some(noisy[(inside(p.x, lens.width)?, inside(p.y, lens.height)?)]))
                .unwrap_or(0.0)
        }))
    }

    /// The object's mask in a photograph, without lens distortion; `None` beyond the last.
    pub fn mask(&self, number: usize) -> Option<Mask> {
        let camera_from_object = compose(self.camera_from_board.get(number)?, &self.board_from_object);
        let mut buffer = VisibilityBuffer::new(&self.options.camera);
        buffer.render(&[SceneObject { mesh: self.scene.object, camera_from_object }], &Default::default());
        Some(buffer.mask(0))
    }
}

fn compose(a: &Pose, b: &Pose) -> Pose {
    Pose::new(a.rotation() * b.rotation(), a.transform_point(&b.translation()))
}

/// The pose of a camera that looks at a point of the board's frame; angles in degrees.
pub(crate) fn looking_at(target: &Vec3, azimuth: f64, elevation: f64, distance: f64, roll: f64) -> Pose {
    let (a, e) = (azimuth.to_radians(), elevation.to_radians());
    let eye = target + distance * Vec3::new(e.cos() * a.cos(), e.cos() * a.sin(), e.sin());
    let forward = (target - eye).normalize();
    let right = forward.cross(&Vec3::z()).normalize();
    let down = forward.cross(&right);
    let rows = Mat3::from_rows(&[right.transpose(), down.transpose(), forward.transpose()]);
    let upright = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rows));
    let rotation = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), roll.to_radians()) * upright;
    Pose::new(rotation, -(rotation * eye))
}

/// The rendered scene.
struct Scene<'a> {
    object: &'a Mesh,
    sheet: Mesh,
    table: Mesh,
    board_from_object: Pose,
    ground: &'a RgbImage,
}

fn quad(low: Vec2, high: Vec2, z: f64, repeat: f32, texture: &RgbImage) -> Mesh {
    let corner = |x: f64, y: f64| Vec3::new(x, y, z);
    let vertices =
        vec![corner(low.x, low.y), corner(high.x, low.y), corner(high.x, high.y), corner(low.x, high.y)];
    let texcoords = vec![[0.0, 0.0], [repeat, 0.0], [repeat, repeat], [0.0, repeat]];
    Mesh::new(vertices, vec![[0, 1, 2], [0, 2, 3]])
        .and_then(|m| m.with_texture(texcoords, texture.clone()))
        .unwrap_or_else(|_| unreachable!("four vertices and two faces are a mesh"))
}

impl<'a> Scene<'a> {
    fn new(object: &'a Mesh, sheet: Mesh, ground: &'a RgbImage, board_from_object: &Pose) -> Scene<'a> {
        let reach = Vec2::repeat(1.2);
        let table = quad(-reach, reach, -0.001, 1.0, ground);
        Scene { object, sheet, table, board_from_object: *board_from_object, ground }
    }

    /// All that is rendered, the object first.
    fn objects(&self, camera_from_board: &Pose) -> [SceneObject<'_>; 3] {
        let camera_from_object = compose(camera_from_board, &self.board_from_object);
        [
            SceneObject { mesh: self.object, camera_from_object },
            SceneObject { mesh: &self.sheet, camera_from_object: *camera_from_board },
            SceneObject { mesh: &self.table, camera_from_object: *camera_from_board },
        ]
    }

    fn photograph(
        &self,
        camera_from_board: &Pose,
        options: &SimulationOptions,
        mut random: sixfold_geometry::random::Random,
    ) -> RgbImage {
        // Wider than the camera's image, so that the distorted image is filled to its borders, and with twice the resolution.
        let lens = &options.camera;
        let (width, height) = (lens.width as f64, lens.height as f64);
        let pinhole = Camera {
            fx: 2.0 * lens.fx,
            fy: 2.0 * lens.fy,
            cx: 2.0 * (lens.cx + MARGIN * width) + 0.5,
            cy: 2.0 * (lens.cy + MARGIN * height) + 0.5,
            width: (2.0 * (1.0 + 2.0 * MARGIN) * width) as usize,
            height: (2.0 * (1.0 + 2.0 * MARGIN) * height) as usize,
            distortion: None,
        };
        let sun = Vec3::new(
            f64::from(uniform(&mut random, [-0.7, 0.7])),
            f64::from(uniform(&mut random, [-0.7, 0.7])),
            -1.0,
        );
        let strength = uniform(&mut random, [0.45, 0.75]);
        let warm = uniform(&mut random, [-0.06, 0.06]);
        let color = [strength * (1.0 + warm), strength, strength * (1.0 - warm)];
        let lights = [
            Light::Ambient { color: [uniform(&mut random, [0.25, 0.4]); 3] },
            Light::Directional { direction: camera_from_board.transform_direction(&sun), color },
        ];
        let objects = self.objects(camera_from_board);
        let mut buffer = VisibilityBuffer::new(&pinhole);
        buffer.render(&objects, &Default::default());
        let far = Image::from_fn(pinhole.width, pinhole.height, |x, y| {
            self.ground[(x * self.ground.width() / pinhole.width, y * self.ground.height() / pinhole.height)]
        });
        let mut sharp = shade(&buffer, &objects, &lights, &Material::default(), Some(&far));
        let depth = buffer.depth();
        let shadow = self.shadow(&sun);
        let board_from_camera = camera_from_board.inverse();
        let (w, object) = (pinhole.width, buffer.mask(0));
        sharp.as_mut_slice().par_chunks_mut(w).enumerate().for_each(|(y, row)| {
            for (x, pixel) in row.iter_mut().enumerate() {
                if object[(x, y)] || depth[(x, y)] <= 0.0 {
                    continue;
                }
                let point = pinhole.unproject(&Vec2::new(x as f64, y as f64), f64::from(depth[(x, y)]));
                let dark = shadow.at(&board_from_camera.transform_point(&point));
                *pixel = pixel.map(|c| (f64::from(c) * (1.0 - 0.55 * dark)) as u8);
            }
        });
        let step = motion_step(options.motion, &mut random);
        let soft = blurred(&sharp, 2.0 * options.blur, step);
        exposed(&soft, lens, options.noise, random)
    }

    /// The part of the board in the object's shadow.
    fn shadow(&self, sun: &Vec3) -> Shadow {
        let flat = self.object.vertices().iter().map(|v| {
            let p = self.board_from_object.transform_point(v);
            let along = p.z / -sun.z;
            Vec3::new(p.x + sun.x * along, p.y + sun.y * along, 0.0)
        });
        let mesh = Mesh::new(flat.collect(), self.object.faces().to_vec());
        // Seen from far above: a pixel is 2 mm.
        let (size, height) = (400, 100.0);
        let centre = (size as f64 - 1.0) / 2.0;
        let focal = height / 0.002;
        let camera = Camera {
            fx: focal,
            fy: focal,
            cx: centre,
            cy: centre,
            width: size,
            height: size,
            distortion: None,
        };
        let mut buffer = VisibilityBuffer::new(&camera);
        if let Ok(mesh) = &mesh {
            let camera_from_object = Pose::from_translation(Vec3::new(0.0, 0.0, height));
            buffer.render(&[SceneObject { mesh, camera_from_object }], &Default::default());
        }
        let hard = buffer.mask(0).map(|m| f32::from(u8::from(*m)));
        let soft = crate::silhouette::box_mean(&crate::silhouette::box_mean(&hard, 2), 2);
        Shadow { soft, centre }
    }
}

struct Shadow {
    soft: Image<f32>,
    centre: f64,
}

impl Shadow {
    fn at(&self, point: &Vec3) -> f64 {
        let (x, y) = (point.x / 0.002 + self.centre, point.y / 0.002 + self.centre);
        let inside = x >= 0.0 && y >= 0.0 && x < self.soft.width() as f64 && y < self.soft.height() as f64;
        if inside { f64::from(crate::view::bilinear(&self.soft, x, y)) } else { 0.0 }
    }
}

/// Half the motion in the finer image, pixels.
fn motion_step(most: f64, random: &mut sixfold_geometry::random::Random) -> Vec2 {
    let length = most * f64::from(uniform(random, [0.0, 1.0]));
    let angle = f64::from(uniform(random, [0.0, std::f32::consts::TAU]));
    Vec2::new(length * angle.cos(), length * angle.sin())
}

/// Blurred by a Gaussian (three box means) and along the motion.
fn blurred(image: &RgbImage, deviation: f64, motion: Vec2) -> [Image<f32>; 3] {
    let radius = (((4.0 * deviation * deviation + 1.0).sqrt() - 1.0) / 2.0).round() as usize;
    [0, 1, 2].map(|c| {
        let mut channel = image.map(|p| f32::from(p[c]));
        for _ in 0..3 {
            if radius > 0 {
                channel = crate::silhouette::box_mean(&channel, radius);
            }
        }
        let steps = 2.0 * motion.norm().max(motion.amax());
        if steps < 1.0 {
            return channel;
        }
        let count = steps.ceil() as usize + 1;
        let (w, h) = channel.size();
        Image::from_fn(w, h, |x, y| {
            let sum: f32 = (0..count)
                .map(|k| {
                    let p = motion * (2.0 * k as f64 / (count - 1) as f64 - 1.0);
                    crate::view::bilinear(&channel, x as f64 + p.x, y as f64 + p.y)
                })
                .sum();
            sum / count as f32
        })
    })
}

/// The image with lens distortion and noise.
fn exposed(
    soft: &[Image<f32>; 3],
    lens: &Camera,
    noise: f64,
    mut random: sixfold_geometry::random::Random,
) -> RgbImage {
    let (width, height) = (lens.width, lens.height);
    let (dx, dy) = (MARGIN * width as f64, MARGIN * height as f64);
    let rows: Vec<[f32; 3]> = (0..height)
        .into_par_iter()
        .flat_map_iter(|y| {
            (0..width).map(move |x| {
                let stored = Vec2::new(x as f64, y as f64);
                let Some(p) = lens.undistort_point(&stored) else { return [0.0; 3] };
                let (u, v) = (2.0 * (p.x + dx) + 0.5, 2.0 * (p.y + dy) + 0.5);
                [0, 1, 2].map(|c: usize| crate::view::bilinear(&soft[c], u, v))
            })
        })
        .collect();
    let mut pixels = vec![];
    for row in rows {
        let shared = noise * f64::from(normal(&mut random));
        pixels.push(row.map(|c| {
            let own = 0.5 * noise * f64::from(normal(&mut random));
            (f64::from(c) + shared + own).round().clamp(0.0, 255.0) as u8
        }));
    }
    Image::from_vec(width, height, pixels).unwrap_or_else(|_| Image::filled(width, height, [0; 3]))
}

/// The mean colour around a pixel, for grounds made of small photographs.
pub fn ground_of(photograph: &RgbImage, side: usize) -> RgbImage {
    let (w, h) = photograph.size();
    Image::from_fn(side, side, |x, y| {
        let (u, v) = (x as f64 * w as f64 / side as f64, y as f64 * h as f64 / side as f64);
        bilinear_rgb(photograph, u, v).map(|c| c.round() as u8)
    })
}
