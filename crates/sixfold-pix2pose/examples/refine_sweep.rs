//! Options of the outline alignment one by one on estimated poses: DATASET TARGETS.json WEIGHTS [passes: only how often is looked].
//!
//! Prints the recall of ADD(-S) below a tenth of the diameter, and the median error along the view axis.
use rayon::prelude::*;
use sixfold_align::outline::outline_mesh;
use sixfold_bop::{
    BopDataset, ModelPoints, Models, Placement, VISIBILITY_DELTA, add, adi, ground_truth_visibility,
};
use sixfold_geometry::{Camera, Pose, Rect, RgbImage};
use sixfold_pix2pose::aligned::{AlignOptions, AlignedObject, estimate_aligned};
use sixfold_pix2pose::estimate::{Found, Pix2PoseOptions, estimate};
use sixfold_pix2pose::model::Pix2PoseModel;
use sixfold_pix2pose::refine::{OutlineRefinementOptions, refine};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

struct Case {
    object: u32,
    image: Arc<RgbImage>,
    camera: Camera,
    truth: Pose,
    region: Rect,
    found: Found,
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let dataset = BopDataset::open(Path::new(&arguments[0]), "test")?;
    let targets = dataset.targets(Some(Path::new(&arguments[1])))?;
    let model = Pix2PoseModel::load(Path::new(&arguments[2]))?;
    let infos = dataset.models_info(Models::Rendering)?.unwrap_or_default();
    let mut meshes = BTreeMap::new();
    for object in model.objects() {
        let mesh = dataset.model(object.id, Models::Rendering)?;
        let points = mesh.vertices().iter().step_by(20).copied().collect::<Vec<_>>();
        let outline = outline_mesh(&mesh);
        let points = ModelPoints::new(&points).ok_or("a model without vertices")?;
        meshes.insert(object.id, (mesh, outline, points));
    }
    let mut images: BTreeMap<(u32, u32), Vec<u32>> = BTreeMap::new();
    for target in &targets {
        images.entry((target.scene_id, target.im_id)).or_default().extend(target.object.map(|o| o.obj_id));
    }
    let mut cases = vec![];
    for ((scene_id, im_id), ids) in &images {
        let scene = dataset.scene(*scene_id)?;
        let frame = scene.image(*im_id)?;
        let camera = scene.camera(*im_id)?;
        let Some(image) = scene.rgb(*im_id)?.map(Arc::new) else { continue };
        let known: Vec<_> = frame.ground_truth.iter().filter(|g| meshes.contains_key(&g.obj_id)).collect();
        let placed: Vec<_> = known.iter().map(|g| (&meshes[&g.obj_id].0, g.camera_from_object)).collect();
        let visible = ground_truth_visibility(&placed, &camera, None, VISIBILITY_DELTA);
        for (truth, visible) in known.iter().zip(visible) {
            let (true, Some(region)) = (ids.contains(&truth.obj_id), visible.info.bbox_visib) else {
                continue;
            };
            let options = Pix2PoseOptions::default();
            if let Some(found) = estimate(&model, &image, &camera, truth.obj_id, &region, &options)? {
                let (object, truth, image) = (truth.obj_id, truth.camera_from_object, image.clone());
                cases.push(Case { object, image, camera, truth, region, found });
            }
        }
    }
    let base = OutlineRefinementOptions::default();
    let with = |change: &dyn Fn(&mut OutlineRefinementOptions)| {
        let mut options = base.clone();
        change(&mut options);
        options
    };
    let mut variants = vec![("as it is".to_string(), base.clone())];
    for fraction in [0.0, 0.3, 0.7] {
        variants.push((format!("first pass {fraction}"), with(&|o| o.first_pass = fraction)));
    }
    for robust in [0.0, 0.7, 1.5] {
        variants.push((format!("robust {robust}"), with(&|o| o.robust = robust)));
    }
    for color in [0.0, 1.0, 3.0] {
        variants.push((format!("colour {color}"), with(&|o| o.color = color)));
    }
    for line in [0.15, 0.6] {
        variants.push((format!("line {line}"), with(&|o| o.line = line)));
    }
    for weight in [0.0, 2.0, 15.0] {
        variants.push((format!("correspondences {weight}"), with(&|o| o.correspondences = weight)));
    }
    for weight in [5.0, 10.0, 90.0] {
        variants.push((format!("shape {weight}"), with(&|o| o.shape = weight)));
    }
    variants.push(("more steps".into(), with(&|o| o.iterations = 10)));
    let error = |case: &Case, pose: &Pose| {
        let points = &meshes[&case.object].2;
        let info = &infos.0[&case.object];
        let (found, truth) = (Placement::from(*pose), Placement::from(case.truth));
        let distance =
            if info.is_symmetric() { adi(points, found, truth) } else { add(points, found, truth) };
        distance / info.diameter
    };
    let print = |name: &str, errors: &[(f64, f64)]| {
        let recall = errors.iter().filter(|e| e.0 < 0.1).count() as f64 / errors.len() as f64;
        let mean: f64 = errors.iter().map(|e| 1.0 - (e.0 / 0.2).min(1.0)).sum::<f64>() / errors.len() as f64;
        let mut signed: Vec<f64> = errors.iter().map(|e| e.1).collect();
        signed.sort_by(f64::total_cmp);
        let mut depths: Vec<f64> = errors.iter().map(|e| e.1.abs()).collect();
        depths.sort_by(f64::total_cmp);
        println!(
            "{name:<28} recall {recall:.3}  area to 0.2 d {mean:.3}  |dz| median {:.1} mm, dz {:.1} mm",
            depths[depths.len() / 2],
            signed[signed.len() / 2]
        );
    };
    let measured = |case: &Case, pose: &Pose| {
        (error(case, pose), 1e3 * (pose.translation().z - case.truth.translation().z))
    };
    let before: Vec<_> =
        cases.iter().map(|c| measured(c, &c.found.hypotheses[0].camera_from_object)).collect();
    println!("{} cases", cases.len());
    print("PnP", &before);
    for (passes, shape, line) in
        [(1, 30.0, 0.3), (2, 30.0, 0.3), (3, 30.0, 0.3), (2, 10.0, 0.3), (3, 10.0, 0.3), (2, 15.0, 0.5)]
    {
        let options = AlignOptions {
            passes,
            refine: OutlineRefinementOptions { shape, line, ..base.clone() },
            ..AlignOptions::default()
        };
        let errors: Vec<_> = cases
            .par_iter()
            .map(|c| {
                let outline = &meshes[&c.object].1;
                let object = AlignedObject { id: c.object, outline, refiner: None };
                let found = estimate_aligned(&model, &c.image, &c.camera, object, &c.region, &options);
                let pose = found.ok().flatten().map_or(Pose::identity(), |a| a.camera_from_object);
                measured(c, &pose)
            })
            .collect();
        print(&format!("passes {passes} shape {shape} line {line}"), &errors);
    }
    if arguments.len() > 3 {
        return Ok(());
    }
    for (name, options) in &variants {
        let errors: Vec<_> = cases
            .par_iter()
            .map(|c| {
                let refined = refine(&c.image, &c.camera, &meshes[&c.object].1, &c.found, options);
                measured(c, &refined.camera_from_object)
            })
            .collect();
        print(name, &errors);
    }
    Ok(())
}
