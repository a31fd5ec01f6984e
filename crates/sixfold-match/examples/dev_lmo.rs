//! Development loop: LM-O frames as simulated depth, ADD(-S) and MSSD of PPF poses.
//! `dev_lmo DATA_DIR EVERY [real]`
use std::path::Path;
use std::time::Instant;

use serde_json::Value;
use sixfold_geometry::*;
use sixfold_match::*;
use sixfold_mesh::{Mesh, Unit, read_mesh};
use sixfold_render::*;

fn pose_of(v: &Value) -> Pose {
    let r: Vec<f64> = v["cam_R_m2c"].as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect();
    let t: Vec<f64> =
        v["cam_t_m2c"].as_array().unwrap().iter().map(|x| x.as_f64().unwrap() / 1000.0).collect();
    Pose::from_parts(&Mat3::from_row_slice(&r), Vec3::new(t[0], t[1], t[2])).unwrap()
}

fn main() {
    let args: Vec<String> = std::env::args().collect();
    let dir = Path::new(&args[1]);
    let every: usize = args[2].parse().unwrap();
    let real = args.get(3).is_some_and(|a| a == "real");
    let camera = Camera::new(572.4114, 573.57043, 325.2611, 242.04899, 640, 480).unwrap();
    let ids = [1u32, 5, 6, 8, 9, 10, 11, 12];
    let z180 = Pose::exp(&[0.0, 0.0, 0.0, 0.0, 0.0, std::f64::consts::PI].into());
    let meshes: Vec<Mesh> = ids
        .iter()
        .map(|id| read_mesh(dir.join(format!("models/obj_{id:06}.ply")), Unit::Millimetre).unwrap())
        .collect();
    let info: Value =
        serde_json::from_str(&std::fs::read_to_string(dir.join("models/models_info.json")).unwrap()).unwrap();
    let start = Instant::now();
    let models: Vec<ObjectModel> = ids
        .iter()
        .zip(&meshes)
        .map(|(id, m)| {
            let syms: Vec<Pose> =
                info[id.to_string()]["symmetries_discrete"].as_array().map_or(vec![], |_| vec![z180]);
            let syms: Vec<Pose> = if syms.is_empty() {
                syms
            } else {
                let s = &info[id.to_string()]["symmetries_discrete"][0];
                let v: Vec<f64> = s.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect();
                vec![
                    Pose::from_parts(
                        &Mat3::new(v[0], v[1], v[2], v[4], v[5], v[6], v[8], v[9], v[10]),
                        Vec3::new(v[3], v[7], v[11]) / 1000.0,
                    )
                    .unwrap(),
                ]
            };
            ObjectModel::new(m, &syms, &ModelOptions::default()).unwrap()
        })
        .collect();
    println!("models built in {:.2} s", start.elapsed().as_secs_f64());
    for (id, m) in ids.iter().zip(&models) {
        println!("  {id}: {} samples, {} pairs", m.samples().len(), m.pair_count());
    }
    let gt: Value =
        serde_json::from_str(&std::fs::read_to_string(dir.join("test/000002/scene_gt.json")).unwrap())
            .unwrap();
    let mut frames: Vec<usize> = gt.as_object().unwrap().keys().map(|k| k.parse().unwrap()).collect();
    frames.sort();
    let targets: Value =
        serde_json::from_str(&std::fs::read_to_string(dir.join("test_targets_bop19.json")).unwrap()).unwrap();
    let is_target =
        |f: usize, id: u32| targets.as_array().unwrap().iter().any(|t| t["im_id"] == f && t["obj_id"] == id);
    if real {
        frames = vec![3];
    }
    let mut hits = vec![(0, 0, 0.0); ids.len()];
    let mut timing = [0f64; 6];
    let mut n = 0;
    for f in frames.iter().step_by(every) {
        let poses: Vec<(u32, Pose)> = gt[f.to_string()]
            .as_array()
            .unwrap()
            .iter()
            .map(|v| (v["obj_id"].as_u64().unwrap() as u32, pose_of(v)))
            .collect();
        let mesh_of = |id: u32| &meshes[ids.iter().position(|&i| i == id).unwrap()];
        let mut objects: Vec<SceneObject> =
            poses.iter().map(|(id, p)| SceneObject { mesh: mesh_of(*id), camera_from_object: *p }).collect();
        let depth = if real {
            let img = image::open(dir.join("test/000002/depth/000003.png")).unwrap().to_luma16();
            DepthImage::from_vec(640, 480, img.pixels().map(|p| f32::from(p.0[0]) / 1000.0).collect())
                .unwrap()
        } else {
            let plane = support_plane(&objects).unwrap();
            let table = plane_mesh(&plane, &camera, 3.0).unwrap();
            objects.push(SceneObject { mesh: &table, camera_from_object: Pose::identity() });
            let mut frame = Frame::new(&camera);
            frame.render(&objects, &RenderOptions { parallel: true, ..Default::default() });
            simulate_depth(&frame.depth(), &frame.normals(&objects), &DepthSensor::kinect(), *f as u64)
        };
        let start = Instant::now();
        let scene = Scene::new(&depth, &camera, None, &SceneOptions::default()).unwrap();
        timing[0] += start.elapsed().as_secs_f64();
        for (k, id) in ids.iter().enumerate() {
            if !is_target(*f, *id) {
                continue;
            }
            let start = Instant::now();
            let (found, t) = estimate::estimate_timed(&scene, &models[k], &EstimateOptions::default());
            timing[5] += start.elapsed().as_secs_f64();
            timing[1] += t.voting;
            timing[2] += t.clustering;
            timing[3] += t.screening;
            timing[4] += t.verification;
            n += 1;
            let truth = poses.iter().find(|p| p.0 == *id).unwrap().1;
            let error = found.first().map_or(f64::INFINITY, |e| {
                models[k]
                    .symmetries()
                    .iter()
                    .map(|s| {
                        let g = truth * *s;
                        mesh_of(*id)
                            .vertices()
                            .iter()
                            .step_by(20)
                            .map(|v| (e.camera_from_object.transform_point(v) - g.transform_point(v)).norm())
                            .fold(0.0, f64::max)
                    })
                    .fold(f64::INFINITY, f64::min)
            }) / models[k].diameter();
            hits[k].0 += 1;
            hits[k].1 += usize::from(error < 0.1);
            hits[k].2 += (1..=10).filter(|i| error < 0.05 * f64::from(*i)).count() as f64 / 10.0;
            if real || std::env::var("V").is_ok() {
                let o = EstimateOptions::default();
                let th = o.verification.threshold_for(models[k].diameter());
                let err = |p: &Pose| {
                    models[k]
                        .symmetries()
                        .iter()
                        .map(|s| {
                            let g = truth * *s;
                            mesh_of(*id)
                                .vertices()
                                .iter()
                                .step_by(20)
                                .map(|v| (p.transform_point(v) - g.transform_point(v)).norm())
                                .fold(0.0, f64::max)
                        })
                        .fold(f64::INFINITY, f64::min)
                        / models[k].diameter()
                };
                let votes = voting::vote(&models[k], scene.cloud(), &o.voting);
                let (lo, hi) = mesh_of(*id).bounding_box();
                let cl = clustering::cluster(
                    &votes,
                    &((lo + hi) * 0.5),
                    models[k].diameter(),
                    models[k].symmetries(),
                    &o.clustering,
                );
                let target = IndexedCloud::new(scene.cloud().clone()).unwrap();
                let sc = estimate::screen(&scene, &models[k], &target, &cl, &o);
                let best = |h: &[voting::Hypothesis]| {
                    h.iter()
                        .enumerate()
                        .map(|(i, h)| (err(&h.camera_from_object), i))
                        .min_by(|a, b| a.0.total_cmp(&b.0))
                };
                let tr = voting::Hypothesis { camera_from_object: truth, votes: 0.0 };
                let v: Vec<Estimate> = estimate::verify(&scene, &models[k], &[tr], th, &o);
                let sco = |p: &Pose, t: f32| estimate::screening_score(&scene, &models[k], p, t, 0.7);
                let d = models[k].diameter() as f32;
                println!(
                    "   coarse truth {:.2} vt {:.2} fine truth {:.2} vt {:.2}; top fine {:?} z {:.2} found z {:.2}",
                    sco(&truth, 0.075 * d),
                    sco(&v[0].camera_from_object, 0.075 * d),
                    sco(&truth, 0.01),
                    sco(&v[0].camera_from_object, 0.01),
                    sc.iter().take(5).map(|h| sco(&h.camera_from_object, 0.01)).collect::<Vec<_>>(),
                    truth.translation().z,
                    found[0].camera_from_object.translation().z
                );
                let mut near: Vec<_> = cl
                    .iter()
                    .enumerate()
                    .filter(|c| err(&c.1.camera_from_object) < 0.2)
                    .map(|(i, c)| (i, err(&c.camera_from_object), sco(&c.camera_from_object, 0.075 * d)))
                    .collect();
                near.truncate(5);
                println!("   near clusters {near:?}");
                println!(
                    "   votes {} best {:?} clusters best {:?} screened {} best {:?}",
                    votes.len(),
                    best(&votes),
                    best(&cl),
                    sc.len(),
                    best(&sc)
                );
                let score_truth = v[0].score;
                let s = found.first().map(|e| e.score);
                println!(
                    "{f} {id} mssd/d {error:.3} found {:.3} {:?} truth rank {:.3} {:?}",
                    s.map_or(0.0, |s| s.ranking()),
                    s.map(|s| (s.depth, s.boundary, s.normals, s.visible_share())),
                    score_truth.ranking(),
                    (
                        score_truth.depth,
                        score_truth.boundary,
                        score_truth.normals,
                        score_truth.visible_share()
                    )
                );
            }
        }
    }
    let (mut a, mut b, mut c) = (0, 0, 0.0);
    for (id, h) in ids.iter().zip(&hits) {
        println!("{id}: MSSD<0.1d {}/{}  AR_MSSD {:.3}", h.1, h.0, h.2 / h.0 as f64);
        a += h.0;
        b += h.1;
        c += h.2;
    }
    println!("all: {b}/{a} = {:.3}, AR_MSSD {:.3}", b as f64 / a as f64, c / a as f64);
    let per = |t: f64| t / n as f64;
    println!(
        "per object: scene {:.3} vote {:.3} cluster {:.3} screen {:.3} verify {:.3} total {:.3}",
        per(timing[0]),
        per(timing[1]),
        per(timing[2]),
        per(timing[3]),
        per(timing[4]),
        per(timing[5] + timing[0])
    );
}
