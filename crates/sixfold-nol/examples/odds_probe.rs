//! Draws crops, odds and outlines of one frame: `odds_probe DATASET SPLIT SCENE FRAME OUT.png`
use sixfold_augment::Coverage;
use sixfold_bop::{BopDataset, Models, ground_truth_visibility, write_rgb};
use sixfold_geometry::{Pose, RgbImage};
use sixfold_mesh::Mesh;
use sixfold_nol::{Photograph, SourceView};
use sixfold_outline::{Outline, color_odds, outline_mesh};
use std::sync::Arc;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let a: Vec<String> = std::env::args().skip(1).collect();
    let dataset = BopDataset::open(std::path::Path::new(&a[0]), &a[1])?;
    let scene = dataset.scene(a[2].parse()?)?;
    let im_id: u32 = a[3].parse()?;
    let image = Arc::new(scene.rgb(im_id)?.expect("rgb"));
    let camera = scene.camera(im_id)?;
    let truth = &scene.image(im_id)?.ground_truth;
    let meshes: Vec<Mesh> =
        truth.iter().map(|g| dataset.model(g.obj_id, Models::Rendering).expect("model")).collect();
    let placed: Vec<(&Mesh, Pose)> =
        truth.iter().zip(&meshes).map(|(g, m)| (m, g.camera_from_object)).collect();
    let visible = ground_truth_visibility(&placed, &camera, None, 0.015);
    let side = 192;
    let mut sheet = RgbImage::filled(side * truth.len(), side * 3, [0, 0, 0]);
    for (n, ((g, mesh), v)) in truth.iter().zip(&meshes).zip(visible).enumerate() {
        let p = Photograph::new("x", image.clone(), camera, g.camera_from_object, Some(v.mask_visible))?;
        let view = SourceView::new(&p, mesh, side)?;
        let mut inside = Coverage::from_fn(side, side, |x, y| {
            let i = y * side + x;
            f32::from(u8::from(view.depth()[i] > 0.0 && view.visible.data[i] > 0.5))
        });
        inside.blur(0.03 * side as f32);
        let odds = color_odds(&view.patch, &inside.data);
        let rgb = view.patch.to_rgb();
        let simple = outline_mesh(mesh);
        let mut outline = Outline::new(&simple, &view.camera, odds.clone());
        let lines = outline.lines(6.0, &g.camera_from_object);
        for y in 0..side {
            for x in 0..side {
                let i = y * side + x;
                sheet[(n * side + x, y)] = rgb[(x, y)];
                let o = ((odds[i] / 6.0 + 0.5).clamp(0.0, 1.0) * 255.0) as u8;
                sheet[(n * side + x, side + y)] = [o, o, o];
                let m = if view.depth()[i] > 0.0 { 80 } else { 0 };
                sheet[(n * side + x, 2 * side + y)] = [m, m, m];
            }
        }
        let mut sum = 0.0;
        for line in &lines {
            let start = view.camera.project(&line.point).expect("in front");
            let end = start + line.normal * line.offset;
            sum += line.offset;
            for (q, c) in [(start, [255, 255, 0]), (end, [255, 0, 0])] {
                let (x, y) = (q.x.round() as usize, q.y.round() as usize);
                if x < side && y < side {
                    sheet[(n * side + x, 2 * side + y)] = c;
                    if c[1] == 0 {
                        sheet[(n * side + x, y)] = c;
                    }
                }
            }
        }
        println!(
            "object {} lines {} mean offset {:.2}",
            g.obj_id,
            lines.len(),
            sum / lines.len().max(1) as f64
        );
    }
    write_rgb(std::path::Path::new(&a[4]), &sheet)?;
    Ok(())
}
