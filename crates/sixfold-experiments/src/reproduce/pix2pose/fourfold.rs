//! A synthetic object that looks the same from four sides, as a small BOP dataset. The symmetry pool of the
//! transformer loss is meant for such objects, which are rare in real datasets.

use std::path::Path;

use anyhow::{Context, Result};
use rand::RngExt;
use sixfold_bop::{
    GroundTruth, NewImage, SceneWriter, Target, TargetObject, VISIBILITY_DELTA, ground_truth_visibility,
    write_targets,
};
use sixfold_geometry::nalgebra::{Rotation3, UnitQuaternion};
use sixfold_geometry::random::{stream, uniform};
use sixfold_geometry::{Camera, Pose, RgbImage, Vec3};
use sixfold_mesh::{Mesh, ModelInfo, ModelsInfo, PlyFormat, Unit, write_ply};
use sixfold_render::{Light, Material, RenderOptions, SceneObject, VisibilityBuffer, shade};
use sixfold_synth::augment::Backgrounds;

use sixfold_shell::progress::{Progress, check_interrupt};

/// Id of the object.
pub(super) const OBJECT: u32 = 1;
/// Test images.
const IMAGES: u32 = 120;

/// Writes the dataset to `folder` unless it exists.
pub(super) fn write(folder: &Path, seed: u64) -> Result<()> {
    let targets_file = folder.join("test_targets_bop19.json");
    if targets_file.exists() {
        return Ok(());
    }
    let mesh = lantern()?;
    let quarter = |n: u32| {
        let angle = f64::from(n) * std::f64::consts::FRAC_PI_2;
        Pose::new(UnitQuaternion::from_axis_angle(&Vec3::z_axis(), angle), Vec3::zeros())
    };
    let info = ModelInfo { symmetries_discrete: (1..4).map(quarter).collect(), ..ModelInfo::of_mesh(&mesh) };
    let models = folder.join("models");
    std::fs::create_dir_all(&models).with_context(|| format!("folder {}", models.display()))?;
    write_ply(models.join("obj_000001.ply"), &mesh, Unit::Millimetre, PlyFormat::BinaryLittleEndian)?;
    ModelsInfo([(OBJECT, info)].into()).write(models.join("models_info.json"))?;
    let camera = Camera::new(570.0, 570.0, 159.5, 119.5, 320, 240)?;
    let mut writer = SceneWriter::new(folder, "test", 1);
    let mut targets = vec![];
    let mut progress = Progress::new("images of the object with four equal sides", IMAGES as usize);
    for im_id in 0..IMAGES {
        check_interrupt("run the same command again to continue")?;
        let mut random = stream(seed, im_id.into());
        let mut draw = |low: f32, high: f32| f64::from(uniform(&mut random, [low, high]));
        // From above, at any azimuth, with the object upright in the image within 30 degrees.
        let (azimuth, elevation, roll) = (draw(-3.2, 3.2), draw(0.1, 1.3), draw(-0.5, 0.5));
        let (x, y, z) = (draw(-0.08, 0.08), draw(-0.05, 0.05), draw(0.6, 1.0));
        let down = Rotation3::from_axis_angle(&Vec3::x_axis(), std::f64::consts::FRAC_PI_2 + elevation);
        let turn = Rotation3::from_axis_angle(&Vec3::z_axis(), azimuth);
        let upright = Rotation3::from_axis_angle(&Vec3::z_axis(), roll) * down * turn;
        let pose = Pose::new(UnitQuaternion::from_rotation_matrix(&upright), Vec3::new(x, y, z));
        let objects = [SceneObject { mesh: &mesh, camera_from_object: pose }];
        let mut frame = VisibilityBuffer::new(&camera);
        frame.render(&objects, &RenderOptions::default());
        let ambient = draw(0.3, 0.7) as f32;
        let lamp = draw(0.2, 0.6) as f32;
        let direction = Vec3::new(draw(-1.0, 1.0), draw(0.0, 1.0), draw(0.2, 1.0));
        let lights =
            [Light::Ambient { color: [ambient; 3] }, Light::Directional { direction, color: [lamp; 3] }];
        let background = Backgrounds::procedural().patch(camera.width, camera.height, &mut random).to_rgb();
        let picture = shade(&frame, &objects, &lights, &Material::default(), None);
        let mask = frame.mask(0);
        let mut noisy = |value: u8| (i32::from(value) + random.random_range(-4..=4)).clamp(0, 255) as u8;
        let image = RgbImage::from_fn(camera.width, camera.height, |u, v| {
            let pixel = if mask[(u, v)] { picture[(u, v)] } else { background[(u, v)] };
            pixel.map(&mut noisy)
        });
        let truth = [GroundTruth::new(OBJECT, pose)];
        let visible = ground_truth_visibility(&[(&mesh, pose)], &camera, None, VISIBILITY_DELTA);
        let infos: Vec<_> = visible.into_iter().map(|v| v.info).collect();
        writer.add(&NewImage {
            rgb: Some(&image),
            ground_truth: &truth,
            info: Some(&infos),
            ..NewImage::new(im_id, &camera)
        })?;
        targets.push(Target {
            scene_id: 1,
            im_id,
            object: Some(TargetObject { obj_id: OBJECT, inst_count: 1 }),
        });
        progress.step(im_id.to_string());
    }
    progress.finish();
    writer.finish()?;
    // Written last: its existence means that the dataset is complete.
    Ok(write_targets(&targets_file, &targets)?)
}

/// A square foot, a narrower square body with coloured bands, and a square roof.
fn lantern() -> Result<Mesh> {
    let (mut vertices, mut faces, mut colors) = (vec![], vec![], vec![]);
    // Half width and height, metres, and colour of each ring from below.
    let rings: [(f64, f64, [u8; 3]); 8] = [
        (0.045, -0.06, [60, 60, 70]),
        (0.045, -0.045, [60, 60, 70]),
        (0.03, -0.04, [200, 60, 40]),
        (0.03, -0.005, [220, 90, 40]),
        (0.03, 0.0, [230, 210, 120]),
        (0.03, 0.03, [240, 230, 190]),
        (0.05, 0.032, [40, 110, 80]),
        (0.008, 0.07, [30, 160, 110]),
    ];
    for (half, z, color) in rings {
        for (x, y) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
            vertices.push(Vec3::new(half * x, half * y, z));
            colors.push(color);
        }
    }
    for ring in 0..rings.len() as u32 - 1 {
        for side in 0..4 {
            let (a, b) = (4 * ring + side, 4 * ring + (side + 1) % 4);
            faces.extend([[a, b, b + 4], [a, b + 4, a + 4]]);
        }
    }
    let top = 4 * (rings.len() as u32 - 1);
    faces.extend([[0, 2, 1], [0, 3, 2], [top, top + 1, top + 2], [top, top + 2, top + 3]]);
    Ok(Mesh::new(vertices, faces)?.with_colors(colors)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_pix2pose::object::symmetry_deviation;

    #[test]
    fn the_object_has_four_equal_sides_and_no_other_symmetry() {
        let mesh = lantern().unwrap();
        let turn = |axis: Vec3| {
            symmetry_deviation(&mesh, &Pose::exp(&[0.0, 0.0, 0.0, axis.x, axis.y, axis.z].into()))
        };
        let quarter = std::f64::consts::FRAC_PI_2;
        assert!(turn(Vec3::z() * quarter) < 0.002);
        assert!(turn(Vec3::z() * 0.5 * quarter) > 0.004);
        assert!(turn(Vec3::x() * 2.0 * quarter) > 0.004);
    }
}
