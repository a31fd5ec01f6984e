//! Scratch.
use sixfold_bop::{BopDataset, Models};
use sixfold_geometry::{Pose, Vec3};
use sixfold_match::estimate::{EstimateOptions as VO, verify};
use sixfold_match::voting::Hypothesis;
use sixfold_match::{ModelOptions, ObjectModel, Scene, SceneOptions, VerificationOptions};
use sixfold_mttm::align::{align, camera_from_view};
use sixfold_mttm::judge::{Surface, judge};
use sixfold_mttm::matching::{MatchOptions, Matcher};
use sixfold_mttm::model::MttmModel;
use sixfold_mttm::roi::Roi;
use sixfold_mttm::*;
use std::path::Path;
fn main() -> Result<(), Box<dyn std::error::Error>> {
    let a: Vec<String> = std::env::args().collect();
    let dataset = BopDataset::open(Path::new(&a[1]), "test")?;
    let (s, im): (u32, u32) = (a[2].parse()?, a[3].parse()?);
    let network = match a.get(4) {
        Some(f) => Some(std::sync::Arc::new(MttmModel::load(Path::new(f))?)),
        None => None,
    };
    let scene = dataset.scene(s)?;
    let (camera, depth) = (scene.camera(im)?, scene.depth(im)?.unwrap());
    let prepared = Scene::new(&depth, &camera, None, &SceneOptions::default())?;
    let infos = dataset.models_info(Models::Rendering)?.unwrap();
    for gt in &scene.image(im)?.ground_truth {
        let mesh = dataset.model(gt.obj_id, Models::Rendering)?;
        let templates = ObjectTemplates::from_mesh(&mesh, &TemplateOptions::default())?;
        let model =
            ObjectModel::new(&mesh, &infos.0[&gt.obj_id].symmetry_poses(0.1), &ModelOptions::default())?;
        let matcher = Matcher::new(&templates, &MatchOptions::default());
        let truth = gt.camera_from_object;
        let d = templates.diameter;
        // nearest entry
        let mut best = (f64::INFINITY, 0usize, Pose::identity());
        for (i, e) in matcher.entries().iter().enumerate() {
            let t = &templates.templates[e.template];
            let p_ref = truth.transform_point(&t.view_from_object.inverse().transform_point(&Vec3::zeros()));
            let roi = Roi { centre: p_ref };
            let view = camera_from_view(&roi.camera_from_roi(), e.turn);
            let angle = (view * t.view_from_object).rotation_angle_to(&truth);
            if angle < best.0 {
                best = (angle, i, view);
            }
        }
        let e = matcher.entries()[best.1];
        let roi = Roi { centre: best.2.translation() };
        let cells = roi.cells(&prepared, templates.size, |_| true);
        let ranked = matcher.ranked(std::slice::from_ref(&cells));
        let rank = ranked.iter().position(|r| r.0.entry == best.1).unwrap();
        let surface = Surface::new(&templates.templates[e.template], templates.size, 160);
        let vo = VerificationOptions::default();
        let th = vo.threshold_for(d);
        let at = judge(&prepared, &surface, &best.2, th, &vo);
        let moved = align(&prepared, &surface.sparse, &best.2, matcher.tolerance());
        let after = judge(&prepared, &surface, &moved, th, &vo);
        let object_pose = |v: &Pose| *v * templates.templates[e.template].view_from_object;
        let vopt = VO { verification: vo, vote_power: 0.0, ..VO::default() };
        let ver = |p: Pose| {
            verify(&prepared, &model, &[Hypothesis { camera_from_object: p, votes: 1.0 }], th, &vopt).pop()
        };
        let vt = ver(truth);
        let vm = ver(object_pose(&moved));
        let show = |v: &Option<sixfold_match::Estimate>| {
            v.as_ref().map_or("-".into(), |v| {
                format!(
                    "{:.2} (d{:.2} b{:.2} n{:.2}) off {:.1} mm {:.0} deg",
                    v.score.ranking(),
                    v.score.depth,
                    v.score.boundary,
                    v.score.normals,
                    1000.0 * v.camera_from_object.distance_to(&truth),
                    v.camera_from_object.rotation_angle_to(&truth).to_degrees()
                )
            })
        };
        println!(
            "object {} ({:.0} mm): nearest entry {:.0} deg, matcher {:.2} at truth (rank {rank} of {}, best {:.2}); judge {:.2} -> aligned {:.2}, moved to {:.1} mm {:.0} deg of truth; mesh at truth {}; from template {}",
            gt.obj_id,
            1000.0 * d,
            best.0.to_degrees(),
            ranked[rank].0.score,
            ranked.len(),
            ranked[0].0.score,
            at.ranking(),
            after.ranking(),
            1000.0 * object_pose(&moved).distance_to(&truth),
            object_pose(&moved).rotation_angle_to(&truth).to_degrees(),
            show(&vt),
            show(&vm)
        );
        let mut known = KnownObject::new(templates.clone(), Some(model));
        if let Some(n) = &network {
            known = known.with_network(n.clone());
        }
        for by in [MatchedBy::Points, MatchedBy::Network, MatchedBy::Both] {
            if network.is_none() && by != MatchedBy::Points {
                continue;
            }
            let n = |k: &str, d: usize| std::env::var(k).ok().and_then(|v| v.parse().ok()).unwrap_or(d);
            let o = EstimateOptions {
                placed: n("PLACED", 160),
                masked: n("MASKED", 50),
                regions: n("REGIONS", 10),
                verified: n("VERIFIED", 16),
                matched_by: by,
                min_score: 0.0,
                max_instances: 5,
                ..Default::default()
            };
            let (found, stages) = estimate(&prepared, &known, &o);
            println!(
                "    {:.2} {:.2} {:.2} {:.2}",
                stages.matching, stages.masks, stages.rematching, stages.verification
            );
            for f in found.iter().take(1) {
                println!(
                    "    {by:?} {:.2}: off {:.0} mm {:.0} deg, template {}, visible {:.2} d{:.2} b{:.2} n{:.2}",
                    f.confidence,
                    1000.0 * f.camera_from_object.distance_to(&truth),
                    f.camera_from_object.rotation_angle_to(&truth).to_degrees(),
                    f.template,
                    f.score.visible_share(),
                    f.score.depth,
                    f.score.boundary,
                    f.score.normals
                );
            }
        }
    }
    Ok(())
}
