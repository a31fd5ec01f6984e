//! Shared parts of the tests: running the binary, a small object without symmetry, and its depth images.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use sixfold_bop::{GroundTruth, NewImage, SceneWriter, Target, TargetObject, write_camera, write_targets};
use sixfold_geometry::nalgebra::{Matrix4, UnitQuaternion};
use sixfold_geometry::{Camera, DepthImage, Pose, RgbImage, Vec3};
use sixfold_mesh::{Mesh, ModelInfo, ModelsInfo, PlyFormat, Unit, write_ply};
use sixfold_render::{Light, Material, RenderOptions, SceneObject, VisibilityBuffer, shade};
use tempfile::TempDir;

pub const WIDTH: usize = 320;
pub const HEIGHT: usize = 240;
/// Metres per unit of the depth images written here.
pub const DEPTH_SCALE: f64 = 1e-4;

/// The result of a run.
#[derive(Debug)]
pub struct Run {
    pub code: i32,
    pub stdout: String,
    pub stderr: String,
}

impl Run {
    pub fn expect(self, code: i32) -> Run {
        assert_eq!(self.code, code, "stdout:\n{}\nstderr:\n{}", self.stdout, self.stderr);
        self
    }

    pub fn json(&self) -> Value {
        serde_json::from_str(&self.stdout).unwrap_or_else(|e| panic!("{e}: {}", self.stdout))
    }
}

/// The cache folder of the runs in a folder.
const CACHE: &str = "cache-of-tests";

/// The only file with this name in the cache of the runs in `dir`.
pub fn cached(dir: &Path, name: &str) -> PathBuf {
    let folders = std::fs::read_dir(dir.join(CACHE)).unwrap().map(|entry| entry.unwrap().path());
    let files: Vec<PathBuf> = folders.map(|folder| folder.join(name)).filter(|file| file.is_file()).collect();
    assert_eq!(files.len(), 1, "{name}: {files:?}");
    files[0].clone()
}

/// Runs the tested program in `dir` with arguments separated by spaces.
pub fn sixfold(dir: &Path, arguments: &str) -> Run {
    let output = Command::new(crate::PROGRAM)
        .args(arguments.split_whitespace())
        .current_dir(dir)
        .env_remove("SIXFOLD_STORE")
        .env("SIXFOLD_CACHE", dir.join(CACHE))
        .output()
        .unwrap();
    let run = Run {
        code: output.status.code().unwrap_or(-1),
        stdout: String::from_utf8(output.stdout).unwrap(),
        stderr: String::from_utf8(output.stderr).unwrap(),
    };
    assert!(!run.stderr.contains("panicked"), "{arguments}\n{}", run.stderr);
    run
}

/// Runs a command that has to fail with exit status 2 and a message that contains all of `words` in one line.
pub fn fails(dir: &Path, arguments: &str, words: &[&str]) {
    let run = sixfold(dir, arguments).expect(2);
    let good = run.stderr.lines().any(|line| words.iter().all(|w| line.contains(w)));
    assert!(good, "{arguments}: expected a line with {words:?}, found:\n{}", run.stderr);
}

pub fn camera() -> Camera {
    Camera::new(300.0, 300.0, 159.5, 119.5, WIDTH, HEIGHT).unwrap()
}

fn cuboid(low: [f64; 3], high: [f64; 3]) -> Mesh {
    let vertices = (0..8)
        .map(|i| {
            let at = |axis: usize| if i >> axis & 1 == 0 { low[axis] } else { high[axis] };
            Vec3::new(at(0), at(1), at(2))
        })
        .collect();
    let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let faces = sides.iter().flat_map(|s| [[s[0], s[1], s[2]], [s[0], s[2], s[3]]]).collect();
    Mesh::new(vertices, faces).unwrap()
}

/// A ramp: the upper end of a cuboid cut off at a slant.
fn wedge(low: [f64; 3], high: [f64; 3]) -> Mesh {
    let [x0, y0, z0] = low;
    let [x1, y1, z1] = high;
    let vertices = [[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0], [x0, y0, z1], [x0, y1, z1]];
    let faces = vec![[0, 2, 1], [0, 3, 2], [0, 1, 4], [3, 5, 2], [1, 2, 5], [1, 5, 4], [0, 4, 5], [0, 5, 3]];
    Mesh::new(vertices.map(Vec3::from).to_vec(), faces).unwrap()
}

/// 12 x 8 x 11 cm, standing on its origin's plane, no symmetry; metres.
pub fn part() -> Mesh {
    Mesh::merged(&[
        cuboid([-0.06, -0.04, 0.0], [0.06, 0.04, 0.03]),
        cuboid([-0.06, -0.04, 0.03], [-0.02, 0.01, 0.11]),
        wedge([-0.02, -0.02, 0.03], [0.05, 0.03, 0.07]),
    ])
    .unwrap()
}

/// Another object: a bumpy round body 10 cm wide, no symmetry.
pub fn other_part() -> Mesh {
    const ROWS: u32 = 24;
    const COLUMNS: u32 = 36;
    let mut vertices = vec![];
    for row in 0..=ROWS {
        let theta = std::f64::consts::PI * f64::from(row) / f64::from(ROWS);
        for column in 0..COLUMNS {
            let phi = std::f64::consts::TAU * f64::from(column) / f64::from(COLUMNS);
            let n = Vec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos());
            let radius = 0.045 * (1.0 + 0.3 * n.x * n.z + 0.35 * n.x * n.y * n.y + 0.25 * n.y * (1.0 + n.z));
            vertices.push(n * radius + Vec3::new(0.0, 0.0, 0.04));
        }
    }
    let at = |row: u32, column: u32| row * COLUMNS + column % COLUMNS;
    let faces = (0..ROWS)
        .flat_map(|r| (0..COLUMNS).map(move |c| (r, c)))
        .flat_map(|(r, c)| {
            [[at(r, c), at(r + 1, c), at(r + 1, c + 1)], [at(r, c), at(r + 1, c + 1), at(r, c + 1)]]
        })
        .collect();
    Mesh::new(vertices, faces).unwrap()
}

/// A pose on the table: `x` and `y` metres from its centre, rotated by `yaw`; the camera looks down at it from
/// 0.6 m.
pub fn on_table(x: f64, y: f64, yaw: f64) -> Pose {
    let table = UnitQuaternion::from_axis_angle(&Vec3::x_axis(), 140f64.to_radians());
    let turn = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), yaw);
    Pose::new(table, Vec3::new(0.0, 0.02, 0.6)) * Pose::new(turn, Vec3::new(x, y, 0.0))
}

fn table() -> Mesh {
    let corners = [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]];
    let vertices = corners.map(|[x, y]| Vec3::new(x, y, 0.0)).to_vec();
    Mesh::new(vertices, vec![[0, 1, 2], [0, 2, 3]]).unwrap()
}

/// Depth of objects on a table.
pub fn depth_of(objects: &[(&Mesh, Pose)]) -> DepthImage {
    let table = table();
    let objects: Vec<SceneObject<'_>> = objects
        .iter()
        .copied()
        .chain([(&table, on_table(0.0, 0.0, 0.0))])
        .map(|(mesh, camera_from_object)| SceneObject { mesh, camera_from_object })
        .collect();
    let mut frame = VisibilityBuffer::new(&camera());
    frame.render(&objects, &RenderOptions::default());
    frame.depth()
}

/// A colour image of objects on a table: all of one material, under one lamp.
pub fn picture_of(objects: &[(&Mesh, Pose)]) -> RgbImage {
    let table = table();
    let objects: Vec<SceneObject<'_>> = objects
        .iter()
        .copied()
        .chain([(&table, on_table(0.0, 0.0, 0.0))])
        .map(|(mesh, camera_from_object)| SceneObject { mesh, camera_from_object })
        .collect();
    let mut frame = VisibilityBuffer::new(&camera());
    frame.render(&objects, &RenderOptions::default());
    shade(&frame, &objects, &Light::default_set(), &Material::default(), None)
}

/// A folder with `depth.png`, `rgb.png`, `camera.json` and the object `part.ply` in millimetres.
pub struct OneImage {
    pub dir: TempDir,
    pub truth: Pose,
}

impl OneImage {
    /// Arguments of `estimate` on this folder.
    pub const ARGUMENTS: &str =
        "estimate --depth depth.png --rgb rgb.png --camera camera.json --object part.ply --unit mm";

    pub fn new() -> OneImage {
        let dir = tempfile::tempdir().unwrap();
        let truth = on_table(0.03, -0.02, 0.7);
        let part = part();
        write_ply(dir.path().join("part.ply"), &part, Unit::Millimetre, PlyFormat::BinaryLittleEndian)
            .unwrap();
        sixfold_io::write_depth(&dir.path().join("depth.png"), &depth_of(&[(&part, truth)]), DEPTH_SCALE)
            .unwrap();
        let grey = sixfold_geometry::RgbImage::filled(WIDTH, HEIGHT, [90; 3]);
        sixfold_io::write_rgb(&dir.path().join("rgb.png"), &grey).unwrap();
        write_camera(dir.path(), &camera(), DEPTH_SCALE).unwrap();
        OneImage { dir, truth }
    }

    pub fn path(&self) -> &Path {
        self.dir.path()
    }
}

/// A pose from JSON's rows.
pub fn pose_of(value: &Value) -> Pose {
    let numbers: Vec<f64> = value
        .as_array()
        .unwrap()
        .iter()
        .flat_map(|row| row.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()))
        .collect();
    assert_eq!(numbers.len(), 16);
    Pose::from_matrix(&Matrix4::from_row_slice(&numbers)).unwrap()
}

/// Asserts that two poses differ by at most 5 mm and 3 degrees.
pub fn assert_near(found: &Pose, truth: &Pose) {
    let (millimetres, degrees) =
        (1000.0 * found.distance_to(truth), found.rotation_angle_to(truth).to_degrees());
    assert!(millimetres < 5.0 && degrees < 3.0, "{millimetres:.1} mm, {degrees:.1} degrees off");
}

/// A BOP dataset `tiny` of one scene with three images and two objects.
pub struct Tiny {
    pub dir: TempDir,
    pub truth: Vec<(u32, Vec<GroundTruth>)>,
}

impl Tiny {
    pub fn new(with_depth: bool) -> Tiny {
        Tiny::with(with_depth, false)
    }

    /// With colour images and depth.
    #[allow(dead_code)]
    pub fn coloured() -> Tiny {
        Tiny::with(true, true)
    }

    fn with(with_depth: bool, with_colour: bool) -> Tiny {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path().join("tiny");
        let meshes = [part(), other_part()];
        std::fs::create_dir_all(root.join("models")).unwrap();
        let mut infos = ModelsInfo::default();
        for (id, mesh) in (1..).zip(&meshes) {
            let file = root.join(format!("models/obj_{id:06}.ply"));
            write_ply(file, mesh, Unit::Millimetre, PlyFormat::BinaryLittleEndian).unwrap();
            infos.0.insert(id, ModelInfo::of_mesh(mesh));
        }
        infos.write(root.join("models/models_info.json")).unwrap();
        let camera = camera();
        let mut writer = SceneWriter::new(&root, "test", 7);
        let mut truth = vec![];
        let mut targets = vec![];
        for (i, im_id) in [0, 4, 11].into_iter().enumerate() {
            let turn = 0.9 * i as f64;
            let poses = [on_table(-0.08, 0.01, turn), on_table(0.09, -0.03, 2.0 - turn)];
            let posed: Vec<(&Mesh, Pose)> = meshes.iter().zip(poses).collect();
            let depth = depth_of(&posed);
            let colour = with_colour.then(|| picture_of(&posed));
            let here: Vec<GroundTruth> =
                (1..).zip(poses).map(|(id, pose)| GroundTruth::new(id, pose)).collect();
            writer
                .add(&NewImage {
                    depth: with_depth.then_some(&depth),
                    rgb: colour.as_ref(),
                    depth_scale: DEPTH_SCALE,
                    ground_truth: &here,
                    ..NewImage::new(im_id, &camera)
                })
                .unwrap();
            for g in &here {
                let object = Some(TargetObject { obj_id: g.obj_id, inst_count: 1 });
                targets.push(Target { scene_id: 7, im_id, object });
            }
            truth.push((im_id, here));
        }
        writer.finish().unwrap();
        write_camera(&root, &camera, DEPTH_SCALE).unwrap();
        write_targets(&root.join("test_targets_bop19.json"), &targets).unwrap();
        Tiny { dir, truth }
    }

    pub fn path(&self) -> &Path {
        self.dir.path()
    }

    pub fn file(&self, name: &str) -> PathBuf {
        self.dir.path().join("tiny").join(name)
    }

    /// Writes the ground truth as results.
    pub fn write_truth_as_results(&self, file: &str) {
        let estimates: Vec<sixfold_bop::Estimate> = self
            .truth
            .iter()
            .flat_map(|(im_id, here)| {
                here.iter()
                    .map(|g| sixfold_bop::Estimate::new(7, *im_id, g.obj_id, 0.9, g.camera_from_object))
            })
            .collect();
        sixfold_bop::write_results(&self.path().join(file), &estimates).unwrap();
    }

    /// The true pose.
    pub fn truth_of(&self, im_id: u32, obj_id: u32) -> Pose {
        let here = &self.truth.iter().find(|(id, _)| *id == im_id).unwrap().1;
        here.iter().find(|g| g.obj_id == obj_id).unwrap().camera_from_object
    }
}

/// Replaces text in a file; the text must exist.
pub fn replace(file: &Path, from: &str, to: &str) {
    let text = std::fs::read_to_string(file).unwrap();
    assert!(text.contains(from), "{from:?} is not in {}: {text}", file.display());
    std::fs::write(file, text.replacen(from, to, 1)).unwrap();
}

/// Truncates a file to this fraction of its length.
pub fn truncate(file: &Path, fraction: f64) {
    let bytes = std::fs::read(file).unwrap();
    std::fs::write(file, &bytes[..(fraction * bytes.len() as f64) as usize]).unwrap();
}

/// Lists the images of a dataset as photographs of object 1 with poses, depth and masks: `photographs.json` beside it, for `sixfold
/// teach`.
#[allow(dead_code)]
pub fn write_posed_photographs(tiny: &Tiny) {
    let entries: Vec<Value> = tiny
        .truth
        .iter()
        .map(|(im_id, _)| {
            let pose = tiny.truth_of(*im_id, 1);
            let (r, t) = (pose.rotation_matrix(), pose.translation() * 1000.0);
            let rows: Vec<f64> = (0..9).map(|i| r[(i / 3, i % 3)]).collect();
            let alone = sixfold_render::render_depth(&part(), &pose, &camera());
            let mask = format!("{im_id}-mask.png");
            sixfold_io::write_mask(&tiny.path().join(&mask), &alone.map(|&z| z > 0.0)).unwrap();
            serde_json::json!({
                "image": format!("tiny/test/000007/rgb/{im_id:06}.png"), "camera": "tiny/camera.json", "mask": mask,
                "depth": format!("tiny/test/000007/depth/{im_id:06}.png"), "depth_scale": 1000.0 * DEPTH_SCALE,
                "cam_R_m2c": rows, "cam_t_m2c": [t.x, t.y, t.z],
            })
        })
        .collect();
    let file = serde_json::json!({ "photographs": entries });
    std::fs::write(tiny.path().join("photographs.json"), file.to_string()).unwrap();
}
