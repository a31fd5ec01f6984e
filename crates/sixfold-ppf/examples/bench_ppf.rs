//! Our half of `benches/ppf_vs_opencv.py`: poses of a dataset's targets with time per image and object, and the clouds
//! the other side works on.
//!
//! `bench_ppf DATASET EVERY_NTH_IMAGE OUT_FOLDER`: writes `clouds/SCENE_IMAGE.f32` (points and normals off the table, six
//! numbers a row), `models/ID.f32` (our samples of the model) and `ours.json`.

use std::path::Path;
use std::time::Instant;

use serde_json::{Value, json};
use sixfold_align::{DepthOptions, DepthRegion};
use sixfold_bop::{BopDataset, ModelPoints, Models, Target, mssd};
use sixfold_geometry::{PointCloud, Pose};
use sixfold_ppf::estimate::estimate_timed;
use sixfold_ppf::{ModelOptions, ObjectModel, PpfOptions};

fn rows(pose: &Pose) -> Value {
    let m = pose.to_matrix();
    json!((0..4).map(|i| (0..4).map(|j| m[(i, j)]).collect::<Vec<_>>()).collect::<Vec<_>>())
}

fn write(path: &Path, cloud: &PointCloud) -> std::io::Result<()> {
    let numbers = cloud
        .points
        .iter()
        .zip(&cloud.normals)
        .flat_map(|(p, n)| p.iter().chain(n.iter()).copied().collect::<Vec<_>>());
    std::fs::write(path, numbers.flat_map(|v| (v as f32).to_le_bytes()).collect::<Vec<_>>())
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().collect();
    let [_, dataset, every, out] = &arguments[..] else {
        return Err("usage: bench_ppf DATASET EVERY_NTH_IMAGE OUT_FOLDER".into());
    };
    let dataset = BopDataset::open(Path::new(dataset), "test")?;
    let out = Path::new(out);
    std::fs::create_dir_all(out.join("clouds"))?;
    std::fs::create_dir_all(out.join("models"))?;
    let targets: Vec<Target> = dataset.object_targets(&dataset.targets(None)?)?;
    let infos = dataset.models_info(Models::Rendering)?.ok_or("models_info.json is missing")?;
    let mut models = vec![];
    for (id, info) in &infos.0 {
        let mesh = dataset.model(*id, Models::Rendering)?;
        let start = Instant::now();
        let model = ObjectModel::new(&mesh, &info.symmetry_poses(0.05), &ModelOptions::default())?;
        let seconds = start.elapsed().as_secs_f64();
        write(&out.join(format!("models/{id}.f32")), model.samples())?;
        let points = ModelPoints::new(mesh.vertices()).ok_or("empty model")?;
        models.push((*id, model, points, seconds));
    }
    let mut images = vec![];
    let mut results = vec![];
    for scene_id in dataset.scene_ids() {
        let scene = dataset.scene(scene_id)?;
        for im_id in scene.image_ids().into_iter().step_by(every.parse()?) {
            let camera = scene.camera(im_id)?;
            let depth = scene.depth(im_id)?.ok_or("an image has no depth")?;
            let start = Instant::now();
            let prepared = DepthRegion::from_depth(&depth, &camera, None, &DepthOptions::default())?;
            let preparation = start.elapsed().as_secs_f64();
            write(&out.join(format!("clouds/{scene_id}_{im_id}.f32")), prepared.cloud())?;
            images.push(json!({ "scene": scene_id, "image": im_id, "preparation": preparation }));
            for t in targets.iter().filter(|t| (t.scene_id, t.im_id) == (scene_id, im_id)) {
                let Some(o) = t.object else { continue };
                let Some((_, model, points, _)) = models.iter().find(|m| m.0 == o.obj_id) else { continue };
                let start = Instant::now();
                let (found, timing) = estimate_timed(&prepared, model, &PpfOptions::default());
                let seconds = start.elapsed().as_secs_f64();
                let image = scene.image(im_id)?;
                let Some(truth) = image.ground_truth.iter().find(|g| g.obj_id == o.obj_id) else { continue };
                let error = found.first().map(|e| {
                    mssd(points, e.camera_from_object, truth.camera_from_object, model.symmetries())
                });
                results.push(json!({
                    "scene": scene_id, "image": im_id, "object": o.obj_id, "seconds": seconds, "timing": timing,
                    "pose": found.first().map(|e| rows(&e.camera_from_object)), "mssd": error,
                    "truth": rows(&truth.camera_from_object), "diameter": model.diameter(),
                    "symmetries": model.symmetries().iter().map(rows).collect::<Vec<_>>(),
                }));
            }
        }
    }
    let models: Vec<_> = models.iter().map(|m| json!({ "object": m.0, "seconds": m.3 })).collect();
    let whole = json!({ "models": models, "images": images, "results": results });
    std::fs::write(out.join("ours.json"), serde_json::to_string(&whole)?)?;
    Ok(())
}
