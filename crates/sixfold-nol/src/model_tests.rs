//! Renderings with random weights: properties that hold before any training.

use std::sync::Arc;

use sixfold_data::PosedImage;
use sixfold_geometry::nalgebra::{UnitQuaternion, Vector3};
use sixfold_geometry::{Camera, Mask, Pose, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::{Light, Material, RenderOptions, SceneObject, VisibilityBuffer, shade};

use super::*;
use crate::network::{CompactConfig, IntegratorKind};

/// A box of 8 cm with a smooth pattern of colours.
fn printed_box() -> Mesh {
    let (mut vertices, mut colors, mut faces) = (vec![], vec![], vec![]);
    let cells = 16u32;
    for axis in 0..3 {
        for sign in [-1.0, 1.0] {
            let first = vertices.len() as u32;
            for j in 0..=cells {
                for i in 0..=cells {
                    let mut p = Vec3::zeros();
                    p[axis] = 0.04 * sign;
                    p[(axis + 1) % 3] = 0.08 * (f64::from(i) / f64::from(cells) - 0.5);
                    p[(axis + 2) % 3] = 0.08 * (f64::from(j) / f64::from(cells) - 0.5);
                    vertices.push(p);
                    let wave = |k: usize| (128.0 + 90.0 * (60.0 * p[k] + 40.0 * p[(k + 1) % 3]).sin()) as u8;
                    colors.push([wave(0), wave(1), wave(2)]);
                }
            }
            for j in 0..cells {
                for i in 0..cells {
                    let at = |i: u32, j: u32| first + j * (cells + 1) + i;
                    faces.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
                    faces.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
                }
            }
        }
    }
    Mesh::new(vertices, faces).unwrap().with_colors(colors).unwrap()
}

fn camera() -> Camera {
    Camera::new(500.0, 500.0, 159.5, 119.5, 320, 240).unwrap()
}

/// The box rotated by an angle about the image's vertical axis, tilted towards the camera, at half a metre.
fn pose(angle: f64) -> Pose {
    let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), angle);
    let tilt = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), 0.5);
    Pose::new(tilt * turn, Vec3::new(0.0, 0.0, 0.5))
}

/// The image of a camera without noise under uniform light.
fn photograph(mesh: &Mesh, angle: f64, mask: Option<Mask>) -> PosedImage {
    let (camera, pose) = (camera(), pose(angle));
    let mut frame = VisibilityBuffer::new(&camera);
    let objects = [SceneObject { mesh, camera_from_object: pose }];
    frame.render(&objects, &RenderOptions::default());
    let lights = [Light::Ambient { color: [1.0; 3] }];
    let image = shade(&frame, &objects, &lights, &Material::default(), None);
    let posed = PosedImage::new("drawn", 1, Arc::new(image), camera, pose).unwrap();
    match mask {
        Some(mask) => posed.with_mask(&mask).unwrap(),
        None => posed,
    }
}

fn model(integrator: IntegratorKind) -> NolModel {
    let parts = Parts { integrator, ..Parts::default() };
    let network = CompactConfig { parts }.init(3, &Device::flex()).unwrap();
    NolModel::new(Network::Compact(network), parts, ModelCard::new("", "test"))
}

/// Mean difference of colours to the truth over the visible pixels, and their fraction.
fn off(rendering: &Rendering, mesh: &Mesh, target: &TargetSurface, angle: f64) -> (f32, f32) {
    let truth = photograph(mesh, angle, None);
    let (mut sum, mut count) = (0.0, 0);
    for (i, pixel) in target.pixels.iter().enumerate().filter(|(i, _)| rendering.seen[*i]) {
        let (x, y) = (*pixel as usize % 320, *pixel as usize / 320);
        for c in 0..3 {
            sum += (rendering.colours[i][c] - f32::from(truth.image()[(x, y)][c]) / 255.0).abs();
            count += 1;
        }
    }
    (sum / count.max(1) as f32, count as f32 / (3 * target.pixels.len()) as f32)
}

#[test]
fn exact_poses_give_the_truth_whatever_the_weights() {
    let mesh = printed_box();
    let views = |angles: &[f64]| -> Vec<SourceView> {
        angles.iter().map(|a| SourceView::new(&photograph(&mesh, *a, None), &mesh, 128).unwrap()).collect()
    };
    let target = TargetSurface::new(&mesh, &camera(), &pose(0.3));
    for integrator in [IntegratorKind::Lstm, IntegratorKind::Average] {
        let model = model(integrator);
        let sources = views(&[0.0, 0.6, 0.9, -0.4]);
        let features = model.encode(&sources);
        let rendering = model.render(&target, &sources, &features);
        let (difference, seen) = off(&rendering, &mesh, &target, 0.3);
        assert!(difference < 0.03 && seen > 0.95, "{difference} {seen}");
        for i in (0..target.pixels.len()).filter(|i| rendering.seen[*i]) {
            let sum: f32 = rendering.weights[4 * i..4 * i + 4].iter().sum();
            assert!((sum - 1.0).abs() < 1e-4);
        }
        // The order of the sources does not matter.
        let permuted: Vec<SourceView> = [2, 0, 3, 1].map(|k: usize| sources[k].clone()).into();
        let again = model.render(&target, &permuted, &model.encode(&permuted));
        assert_eq!(again.channels, rendering.channels);
        assert!((0..target.pixels.len()).all(|i| again.weights[4 * i + 1] == rendering.weights[4 * i]));
        // With one source the rendering shows that source.
        let one = views(&[0.0]);
        let rendering = model.render(&target, &one, &model.encode(&one));
        let (difference, seen) = off(&rendering, &mesh, &target, 0.3);
        assert!(difference < 0.03 && (0.5..1.0).contains(&seen), "{difference} {seen}");
    }
}

#[test]
fn unseen_pixels_are_reported() {
    let mesh = printed_box();
    let model = model(IntegratorKind::Lstm);
    let target = TargetSurface::new(&mesh, &camera(), &pose(0.0));
    // From behind only the top is visible, and an empty mask leaves nothing.
    let behind = SourceView::new(&photograph(&mesh, std::f64::consts::PI, None), &mesh, 128).unwrap();
    let hidden =
        SourceView::new(&photograph(&mesh, 0.0, Some(Mask::filled(320, 240, false))), &mesh, 128).unwrap();
    let alone = |source: &SourceView| {
        let sources = std::slice::from_ref(source);
        model.render(&target, sources, &model.encode(sources))
    };
    let rendering = alone(&behind);
    let seen = rendering.seen.iter().filter(|s| **s).count();
    assert!(seen > 0 && seen < target.pixels.len() * 2 / 3, "{seen} of {}", target.pixels.len());
    let unseen = rendering.seen.iter().position(|s| !s).unwrap();
    assert_eq!((rendering.colours[unseen], rendering.weights[unseen]), ([0.5; 3], 0.0));
    let rendering = alone(&hidden);
    assert!(rendering.seen.iter().all(|s| !s));
    assert!(model.render(&target, &[], &[]).weights.is_empty());
}

#[test]
fn a_model_survives_its_file_and_other_files_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("nol.safetensors");
    let model = model(IntegratorKind::Lstm);
    model.save(&file).unwrap();
    let again = NolModel::load(&file).unwrap();
    let bytes = std::fs::read(&file).unwrap();
    assert_eq!(NolModel::from_bytes(&file, &bytes).unwrap().card(), again.card());
    assert_eq!(again.card().architecture, "nol-compact");
    assert!(folder.path().join("nol.md").exists());
    let missing = NolModel::load(&folder.path().join("none.safetensors")).unwrap_err().to_string();
    assert!(missing.contains("none.safetensors"), "{missing}");
    let error = NolModel::from_bytes(&file, &bytes[..bytes.len() / 2]).unwrap_err().to_string();
    assert!(error.contains("nol.safetensors"), "{error}");
}

#[test]
fn a_card_of_other_parts_or_of_another_network_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("nol.safetensors");
    let model = NolModel::shipped().unwrap();
    let refused = |change: fn(&mut ModelCard), field: &str| {
        let mut card = model.card.clone();
        change(&mut card);
        save_weights(&model.network, &card, &file).unwrap();
        let error = NolModel::load(&file).unwrap_err().to_string();
        assert!(error.contains("nol.safetensors") && error.contains(field), "{field}: {error}");
    };
    refused(|c| c.extra["parts"]["integrator"] = serde_json::json!(1e300), "`extra.parts`");
    refused(|c| c.extra["parts"]["decoder"] = serde_json::json!(u64::MAX), "`extra.parts`");
    refused(|c| c.extra = serde_json::Value::Null, "`extra.parts`");
    refused(|c| c.extra["parts"]["decoder"] = serde_json::json!(false), "differently configured");
    refused(|c| c.architecture = "nol".to_owned(), "`architecture`");
}
