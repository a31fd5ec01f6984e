//! Samples of a box whose colours are its coordinates, so that images can be compared with targets.

use super::targets::targets;
use super::*;
use sixfold_data::{PosedImage, PosedImageError, TrainingObject, colors};
use sixfold_geometry::{Camera, Mask, Pose, RgbImage, Vec2, Vec3};
use sixfold_mesh::{ContinuousSymmetry, Mesh, ModelInfo};
use sixfold_render::{BoundingBoxScale, Light, Material};
use sixfold_synth::augment::{Backgrounds, ColorAugmentation};
use std::sync::Arc;

const GREY: [u8; 3] = [128; 3];

fn camera() -> Camera {
    Camera::new(600.0, 590.0, 155.0, 118.0, 320, 240).unwrap()
}

/// A box of 12 x 8 x 5 cm, not centred on its origin, each side a fine grid. Red, green and blue are x, y and z.
fn colored_box() -> Mesh {
    const N: usize = 24;
    let (centre, half) = (Vec3::new(0.01, -0.02, 0.03), Vec3::new(0.06, 0.04, 0.025));
    let (mut vertices, mut faces) = (Vec::new(), Vec::new());
    for axis in 0..3 {
        for side in [-1.0, 1.0] {
            let first = vertices.len() as u32;
            for i in 0..=N {
                for j in 0..=N {
                    let mut p = Vec3::zeros();
                    p[axis] = side;
                    p[(axis + 1) % 3] = 2.0 * i as f64 / N as f64 - 1.0;
                    p[(axis + 2) % 3] = 2.0 * j as f64 / N as f64 - 1.0;
                    vertices.push(centre + p.component_mul(&half));
                }
            }
            let at = |i: usize, j: usize| first + (i * (N + 1) + j) as u32;
            for i in 0..N {
                for j in 0..N {
                    faces.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
                    faces.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
                }
            }
        }
    }
    let colors = vertices
        .iter()
        .map(|v| {
            let n = (v - centre).component_div(&half);
            std::array::from_fn(|c| ((0.5 + 0.5 * n[c]) * 255.0).round() as u8)
        })
        .collect();
    Mesh::new(vertices, faces).unwrap().with_colors(colors).unwrap()
}

fn object(id: u32, mesh: Mesh) -> TrainingObject {
    let info = ModelInfo::of_mesh(&mesh);
    TrainingObject::new(id, mesh, info)
}

fn posed(
    id: u32,
    image: &Arc<RgbImage>,
    camera: Camera,
    pose: Pose,
    mask: &Mask,
) -> Result<PosedImage, PosedImageError> {
    PosedImage::new("photograph", id, image.clone(), camera, pose)?.with_mask(mask)
}

/// A "photograph" of the box on grey: its colours are its coordinates, because the light is uniform and white.
fn photograph(id: u32, pose: Pose) -> PosedImage {
    let lights = [Light::Ambient { color: [1.0; 3] }];
    let (mut image, silhouette) = colors(&colored_box(), &camera(), &pose, &lights, &Material::default());
    let mask = Mask::from_fn(320, 240, |x, y| silhouette.data[y * 320 + x] > 0.5);
    for (pixel, inside) in image.as_mut_slice().iter_mut().zip(mask.as_slice()) {
        if !inside {
            *pixel = GREY;
        }
    }
    posed(id, &Arc::new(image), camera(), pose, &mask).unwrap()
}

fn poses() -> Vec<Pose> {
    let pose = |turn: [f64; 3], place: [f64; 3]| {
        Pose::exp(&[0.0, 0.0, 0.0, turn[0], turn[1], turn[2]].into()).with_translation(place.into())
    };
    vec![
        pose([2.0, 0.3, 0.2], [0.02, 0.02, 0.6]),
        pose([0.4, 1.6, -0.9], [-0.05, -0.03, 0.7]),
        // Partly outside the photograph.
        pose([-1.0, 0.3, 0.7], [0.15, 0.05, 0.6]),
    ]
}

/// Options with geometric augmentation only.
fn plain() -> SampleOptions {
    SampleOptions {
        target_size: Some(64),
        color: ColorAugmentation::none(),
        render_color: ColorAugmentation::none(),
        occlusion_probability: 0.0,
        cut_probability: 0.0,
        second_stage_fraction: 0.0,
        rotation: std::f32::consts::PI,
        border_blur: [0.0; 2],
        paste_gain: [1.0; 2],
        ..SampleOptions::default()
    }
}

fn grey_background() -> Backgrounds {
    Backgrounds::from_images(vec![Arc::new(RgbImage::filled(64, 64, GREY))]).unwrap()
}

fn source(options: SampleOptions) -> SampleSource {
    let real = poses().into_iter().map(|p| photograph(7, p)).collect();
    SampleSource::new(vec![object(7, colored_box())], real, grey_background(), options).unwrap()
}

/// The mean input colour over the block of a target pixel.
fn block_color(sample: &Sample, size: usize, target: usize, u: usize, v: usize) -> [f32; 3] {
    let n = size / target;
    std::array::from_fn(|c| {
        let mut sum = 0.0;
        for y in v * n..(v + 1) * n {
            for x in u * n..(u + 1) * n {
                sum += sample.rgb[c * size * size + y * size + x];
            }
        }
        sum / (n * n) as f32
    })
}

/// Target pixels that are visible together with all their neighbours up to `margin`.
fn inner(sample: &Sample, target: usize, margin: usize) -> Vec<(usize, usize)> {
    let mut pixels = Vec::new();
    for v in margin..target - margin {
        for u in margin..target - margin {
            let all = (v - margin..=v + margin)
                .all(|y| (u - margin..=u + margin).all(|x| sample.visible[y * target + x] > 0.5));
            if all {
                pixels.push((u, v));
            }
        }
    }
    pixels
}

#[test]
fn rotated_crops_match_their_target_coordinates() {
    let source = source(SampleOptions { render_fraction: 0.0, ..plain() });
    let (mut count, mut worst, mut sum) = (0, 0.0f32, 0.0);
    for number in 0..60 {
        let sample = source.sample(0, 3, number);
        for (u, v) in inner(&sample, 64, 1) {
            let color = block_color(&sample, 128, 64, u, v);
            for (c, color) in color.iter().enumerate() {
                let expected = 0.5 + 0.5 * sample.coordinates[c * 4096 + v * 64 + u];
                let error = (color - expected).abs();
                worst = worst.max(error);
                sum += error;
                count += 1;
            }
        }
    }
    let mean = sum / count as f32;
    assert!(count > 60 * 3 * 300, "{count}");
    // A shift of half a target pixel would be about 0.01.
    assert!(mean < 0.004, "mean {mean}, worst {worst}");
}

#[test]
fn renders_and_their_targets_cover_the_same_pixels() {
    let source = source(SampleOptions { render_fraction: 1.0, centre_jitter: 0.3, ..plain() });
    for number in 0..40 {
        let sample = source.sample(0, 5, number);
        let (mut wrong, mut all) = (0, 0);
        for v in 1..63 {
            for u in 1..63 {
                let inside = sample.object[v * 64 + u] > 0.5;
                // Only away from the silhouette's border.
                let even = (v - 1..=v + 1)
                    .all(|y| (u - 1..=u + 1).all(|x| (sample.object[y * 64 + x] > 0.5) == inside));
                if even {
                    let color = block_color(&sample, 128, 64, u, v);
                    let is_grey = color.iter().all(|c| (c - 128.0 / 255.0).abs() < 1e-3);
                    wrong += usize::from(is_grey == inside);
                    all += 1;
                }
            }
        }
        assert!(wrong * 500 < all, "sample {number}: {wrong} of {all}");
        let area: f32 = sample.object.iter().sum();
        assert!(area > 300.0, "{area}");
        let visible: f32 = sample.visible.iter().sum();
        assert!(visible <= area && visible > 0.97 * area, "{visible} of {area}");
    }
}

#[test]
fn render_colors_follow_the_coordinates() {
    let source = source(SampleOptions { render_fraction: 1.0, ..plain() });
    // Correlation of each colour with its coordinate, over all samples: the light varies, but the order of colours does not.
    let mut sums = [[0.0f64; 5]; 3];
    let mut count = 0.0;
    for number in 0..40 {
        let sample = source.sample(0, 6, number);
        for (u, v) in inner(&sample, 64, 1) {
            let color = block_color(&sample, 128, 64, u, v);
            count += 1.0;
            for (c, sums) in sums.iter_mut().enumerate() {
                let (a, b) = (f64::from(color[c]), f64::from(sample.coordinates[c * 4096 + v * 64 + u]));
                for (s, value) in sums.iter_mut().zip([a, b, a * a, b * b, a * b]) {
                    *s += value;
                }
            }
        }
    }
    for [a, b, aa, bb, ab] in sums.map(|s| s.map(|v| v / count)) {
        let correlation = (ab - a * b) / ((aa - a * a) * (bb - b * b)).sqrt();
        assert!(correlation > 0.75, "{correlation}");
    }
}

#[test]
fn a_coordinate_projects_to_its_pixel_and_is_on_the_surface() {
    let mesh = colored_box();
    let (low, high) = mesh.bounding_box();
    let scale = BoundingBoxScale::of_corners(&low, &high);
    for pose in poses() {
        let (coordinates, silhouette) = targets(&mesh, &scale, &camera(), &pose);
        let pixels = 320 * 240;
        let mut seen = 0;
        for i in (0..pixels).filter(|i| silhouette.data[*i] > 0.5) {
            let n = Vec3::from_fn(|c, _| f64::from(coordinates[c * pixels + i]));
            assert!((n.amax() - 1.0).abs() < 1e-4, "{n:?} is not on a side of the box");
            let pixel = camera().project(&pose.transform_point(&scale.restore(&n))).unwrap();
            let expected = Vec2::new((i % 320) as f64, (i / 320) as f64);
            // Coordinates are clipped to -1..1, which moves points at the border slightly.
            assert!((pixel - expected).norm() < 0.02, "{pixel:?} {expected:?}");
            seen += 1;
        }
        assert!(seen > 1000);
        let outside = (0..pixels).filter(|i| silhouette.data[*i] < 0.5);
        assert!(outside.flat_map(|i| (0..3).map(move |c| c * pixels + i)).all(|i| coordinates[i] == 0.0));
    }
}

#[test]
fn occluders_change_what_is_visible_and_nothing_else() {
    let free = source(plain());
    let hidden = source(SampleOptions { occlusion_probability: 1.0, occlusion: [0.2, 0.5], ..plain() });
    let mut fraction = 0.0;
    for number in 0..60 {
        let (a, b) = (free.sample(0, 9, number), hidden.sample(0, 9, number));
        assert!(a.coordinates == b.coordinates && a.object == b.object);
        assert!(a.visible.iter().zip(&b.visible).all(|(a, b)| b <= a));
        fraction += b.visible.iter().sum::<f32>() / a.visible.iter().sum::<f32>() / 60.0;
    }
    // The mean visible fraction when between 0.2 and 0.5 are hidden.
    assert!((fraction - 0.65).abs() < 0.06, "{fraction}");
}

#[test]
fn a_truncated_object_fills_the_crop_like_a_whole_one() {
    let still = SampleOptions { centre_jitter: 0.0, size_jitter: 0.0, ..plain() };
    let whole = source(SampleOptions { render_fraction: 1.0, visible_box_probability: 1.0, ..still.clone() });
    let cut = source(SampleOptions {
        render_fraction: 1.0,
        visible_box_probability: 1.0,
        cut_probability: 1.0,
        cut: [0.3, 0.3],
        ..still
    });
    let longest = |sample: &Sample| {
        let seen = |at: &dyn Fn(usize, usize) -> usize| {
            let lines = (0..64).filter(|a| (0..64).any(|b| sample.visible[at(*a, b)] > 0.5));
            let (first, last) = lines.fold((64, 0), |(f, l), a| (a.min(f), a.max(l)));
            last + 1 - first
        };
        seen(&|a, b| 64 * a + b).max(seen(&|a, b| 64 * b + a)) as f32
    };
    let (mut shown, mut filled, mut fills) = (0.0, 0.0, 0.0);
    for number in 0..60 {
        let (a, b) = (whole.sample(0, 9, number), cut.sample(0, 9, number));
        shown += b.visible.iter().sum::<f32>() / b.object.iter().sum::<f32>() / 60.0;
        fills += longest(&a) / 60.0;
        filled += longest(&b) / 60.0;
        // The occluder changes neither the coordinates nor the visible part.
        for (u, v) in inner(&b, 64, 1) {
            assert!(b.object[v * 64 + u] > 0.5 && b.coordinates[v * 64 + u] != 0.0);
        }
    }
    // Three tenths of the box contain about as much of the object, as far as the crop still shows it.
    assert!((0.62..0.85).contains(&shown), "{shown}");
    assert!((filled / fills - 1.0).abs() < 0.1, "{filled} of {fills}");
}

#[test]
fn the_second_stage_is_grey_outside_a_mask() {
    let source =
        source(SampleOptions { second_stage_fraction: 1.0, color: ColorAugmentation::none(), ..plain() });
    let (mut kept, mut visible, mut outside, mut empty) = (0.0, 0.0, 0.0, 0.0);
    for number in 0..60 {
        let sample = source.sample(0, 9, number);
        for v in 0..64 {
            for u in 0..64 {
                let is_grey = block_color(&sample, 128, 64, u, v).iter().all(|c| (c - 0.5).abs() < 3e-3);
                if sample.visible[v * 64 + u] > 0.5 {
                    visible += 1.0;
                    kept += f64::from(!is_grey);
                } else {
                    empty += 1.0;
                    outside += f64::from(is_grey);
                }
            }
        }
    }
    assert!(kept / visible > 0.7 && kept / visible < 0.97, "{}", kept / visible);
    assert!(outside / empty > 0.9, "{}", outside / empty);
}

#[test]
fn same_numbers_same_bytes_on_any_thread() {
    let options = SampleOptions { target_size: Some(32), size: 64, ..SampleOptions::default() };
    let make = || {
        let real = poses().into_iter().map(|p| photograph(7, p)).collect();
        let objects = vec![object(7, colored_box()), object(8, colored_box().scaled(0.7))];
        SampleSource::new(objects, real, Backgrounds::procedural(), options.clone()).unwrap()
    };
    let (first, second) = (make(), make());
    let expected: Vec<Sample> = (0..24).map(|n| first.sample(n as usize % 2, 4, n)).collect();
    let found: Vec<Vec<Sample>> = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..3)
            .map(|k| {
                let second = &second;
                scope.spawn(move || {
                    (0..8).map(|i| 3 * i + k).map(|n| second.sample(n as usize % 2, 4, n)).collect()
                })
            })
            .collect();
        threads.into_iter().map(|t| t.join().unwrap()).collect()
    });
    for (n, sample) in expected.iter().enumerate() {
        assert!(found[n % 3][n / 3] == *sample, "sample {n}");
        assert_eq!((sample.rgb.len(), sample.coordinates.len()), (3 * 64 * 64, 3 * 32 * 32));
        assert!(sample.rgb.iter().all(|v| (0.0..=1.0).contains(v)));
        assert!(sample.coordinates.iter().all(|v| (-1.0..=1.0).contains(v)));
    }
    assert!(first.sample(0, 4, 0) != first.sample(0, 5, 0));
    assert!(first.sample(0, 4, 0).rgb != first.sample(1, 4, 0).rgb);
}

#[test]
fn both_stages_in_blocks_or_mixed() {
    let second_stages = |options: SampleOptions| -> Vec<bool> {
        let mut random = sixfold_geometry::random::stream(1, 1);
        (0..200).map(|n| options.is_second_stage(n, &mut random)).collect()
    };
    let blocks = second_stages(SampleOptions { second_stage_block: Some(50), ..SampleOptions::default() });
    assert!((0..200).all(|n| blocks[n] == (n / 50 % 2 == 1)));
    let mixed = second_stages(SampleOptions::default());
    assert!((70..130).contains(&mixed.iter().filter(|s| **s).count()));
    let none = second_stages(SampleOptions { second_stage_fraction: 0.0, ..SampleOptions::default() });
    assert!(none.iter().all(|s| !s));
}

#[test]
fn a_continuous_symmetry_has_one_target() {
    let pose = poses()[0];
    let mut turning = object(7, colored_box());
    let symmetry = ContinuousSymmetry { axis: Vec3::z(), offset: Vec3::new(0.01, -0.02, 0.0) };
    turning.info.symmetries_continuous.push(symmetry);
    let info = turning.info.clone();
    let options = SampleOptions { render_fraction: 0.0, centre_jitter: 0.0, size_jitter: 0.0, ..plain() };
    let options = SampleOptions { visible_box_probability: 1.0, rotation: 0.0, ..options };
    let make = |pose| {
        // The same photograph and mask, the pose rotated about the axis.
        let crop = photograph(7, poses()[0]);
        let silhouette =
            crop.visible(&sixfold_synth::augment::AffineMap { x: [1.0, 0.0, 0.0], y: [0.0, 1.0, 0.0] }, 320);
        let mask = Mask::from_fn(320, 240, |x, y| silhouette.data[y * 320 + x] > 0.5);
        let crop = posed(7, crop.image(), camera(), pose, &mask).unwrap();
        SampleSource::new(vec![turning.clone()], vec![crop], grey_background(), options.clone()).unwrap()
    };
    let expected = make(pose).sample(0, 1, 1);
    for turn in info.symmetry_poses(0.5).into_iter().skip(1) {
        let found = make(pose * turn).sample(0, 1, 1);
        let off = found
            .coordinates
            .iter()
            .zip(&expected.coordinates)
            .filter(|(a, b)| (*a - *b).abs() > 1e-4)
            .count();
        assert!(off < 30, "{off}");
    }
}

fn error_of(objects: Vec<TrainingObject>, real: Vec<PosedImage>, options: SampleOptions) -> String {
    SampleSource::new(objects, real, Backgrounds::procedural(), options).unwrap_err().to_string()
}

#[test]
fn errors_explain_why_training_is_impossible() {
    let gray = |mesh: &Mesh| Mesh::new(mesh.vertices().to_vec(), mesh.faces().to_vec()).unwrap();
    let mesh = colored_box();
    let default = SampleOptions::default;
    assert!(error_of(vec![], vec![], default()).contains("at least one mesh"));
    let message = error_of(vec![object(3, gray(&mesh))], vec![], default());
    assert!(message.contains("object 3") && message.contains("neither colours nor texture"), "{message}");
    let points = Mesh::new(mesh.vertices().to_vec(), vec![]).unwrap();
    assert!(error_of(vec![object(3, points)], vec![], default()).contains("no faces"));
    let mut flat = object(3, mesh.clone());
    flat.scale.half_size.y = 0.0;
    assert!(error_of(vec![flat], vec![], default()).contains("object 3, scale"));
    let message = error_of(vec![object(3, mesh.clone())], vec![photograph(7, poses()[0])], default());
    assert!(message.contains("object 7") && message.contains("(3)"), "{message}");
    for (options, field) in [
        (SampleOptions { size: 4, ..default() }, "size"),
        (SampleOptions { target_size: Some(0), ..default() }, "target_size"),
        (SampleOptions { occlusion: [0.5, 0.2], ..default() }, "occlusion"),
        (SampleOptions { cut: [0.1, 0.95], ..default() }, "cut"),
        (SampleOptions { cut_probability: 1.5, ..default() }, "cut_probability"),
        (SampleOptions { render_fraction: f32::NAN, ..default() }, "render_fraction"),
        (SampleOptions { crop_factor: 0.0, ..default() }, "crop_factor"),
        (SampleOptions { distance: Some([0.0, 1.0]), ..default() }, "distance"),
    ] {
        let message = error_of(vec![object(3, mesh.clone())], vec![], options);
        assert!(message.contains(field), "{message}");
    }
    // A mesh without colours is usable with random colours, or with photographs.
    let options = SampleOptions { random_color_probability: 1.0, size: 32, ..default() };
    let source =
        SampleSource::new(vec![object(3, gray(&mesh))], vec![], Backgrounds::procedural(), options).unwrap();
    assert!(source.sample(0, 1, 1).object.iter().sum::<f32>() > 50.0);
    let source = SampleSource::new(
        vec![object(7, gray(&mesh))],
        vec![photograph(7, poses()[0])],
        Backgrounds::procedural(),
        SampleOptions { size: 32, ..default() },
    );
    assert!(source.unwrap().sample(0, 1, 1).object.iter().sum::<f32>() > 50.0);
}

#[test]
fn photographs_that_do_not_fit_are_refused() {
    let image = Arc::new(RgbImage::filled(320, 240, GREY));
    let full = Mask::filled(320, 240, true);
    let pose = poses()[0];
    let message = |image: &Arc<RgbImage>, camera: Camera, pose: Pose, mask: &Mask| {
        posed(5, image, camera, pose, mask).unwrap_err().to_string()
    };
    let empty = posed(7, &image, camera(), pose, &Mask::filled(320, 240, false)).unwrap();
    let text = error_of(vec![object(7, colored_box())], vec![empty], SampleOptions::default());
    assert!(text.contains("0 pixels of the object, expected at least 64"), "{text}");
    let small = Arc::new(RgbImage::filled(32, 24, GREY));
    let text = message(&small, camera(), pose, &full);
    assert!(text.contains("image is 32x24") && text.contains("320x240"), "{text}");
    assert!(message(&image, camera(), pose, &Mask::filled(3, 3, true)).contains("the mask is 3x3"));
    let behind = Pose::from_translation(Vec3::new(0.0, 0.0, -0.6));
    assert!(message(&image, camera(), behind, &full).contains("outside the image"));
    let aside = Pose::from_translation(Vec3::new(9.0, 0.0, 0.6));
    assert!(message(&image, camera(), aside, &full).contains("[9.000, 0.000, 0.600]"));
    let broken = Camera { fx: 0.0, ..camera() };
    assert!(message(&image, broken, pose, &full).contains("fx"));
}

#[test]
fn a_texture_is_rendered_also_on_a_simplified_mesh() {
    let mesh = colored_box();
    let corners = vec![[0.5f32, 0.5]; mesh.vertices().len()];
    let textured = mesh.with_texture(corners, RgbImage::filled(4, 4, [200, 0, 0])).unwrap();
    let options = SampleOptions { faces: 500, ..plain() };
    let source = SampleSource::new(vec![object(7, textured)], vec![], grey_background(), options).unwrap();
    let sample = source.sample(0, 2, 2);
    let pixels = inner(&sample, 64, 2);
    assert!(pixels.len() > 200);
    for (u, v) in pixels {
        let [red, green, blue] = block_color(&sample, 128, 64, u, v);
        assert!(red > 0.2 && green < 0.35 && (green - blue).abs() < 0.1, "{red} {green} {blue}");
    }
}

#[test]
fn published_samples_are_photographs_on_backgrounds_with_alternating_stages() {
    let published = SampleOptions::published(50);
    assert_eq!(published.color, sixfold_synth::augment::ColorAugmentation::table_3_2());
    assert_eq!((published.second_stage_block, published.render_fraction), (Some(50), 0.0));
    assert_eq!((published.keep_background_probability, published.cut_probability), (0.0, 0.0));
    assert!((published.rotation.to_degrees() - 45.0).abs() < 1e-4);
    assert!(published.check().is_ok());
    // Only the object, its surroundings and occluders, which are parts of the uniform background and therefore grey.
    let even = SampleOptions {
        size: 64,
        target_size: Some(64),
        second_stage_fraction: 0.0,
        rotation: 0.0,
        border_blur: [0.0, 0.0],
        occlusion: [0.3, 0.5],
        color: sixfold_synth::augment::ColorAugmentation::none(),
        ..published
    };
    let crops = vec![photograph(7, poses()[0])];
    let source = SampleSource::new(vec![object(7, colored_box())], crops, grey_background(), even).unwrap();
    for number in 0..8 {
        let s = source.sample(0, 3, number);
        let pixels = s.object.len();
        let hidden: Vec<usize> = (0..pixels).filter(|i| s.object[*i] > 0.5 && s.visible[*i] < 0.5).collect();
        let fraction = hidden.len() as f32 / s.object.iter().sum::<f32>();
        assert!((0.2..0.6).contains(&fraction), "{number}: {fraction}");
        let grey = |i: &usize| (0..3).all(|c| (s.rgb[c * pixels + i] - s.rgb[c * pixels]).abs() < 0.03);
        let wrong = hidden.iter().filter(|i| !grey(i)).count();
        // Pixels along the occluder's border mix both.
        assert!(wrong * 5 < hidden.len(), "{number}: {wrong} of {}", hidden.len());
    }
}
