//! Pose errors before and after refinement on frames of a BOP dataset, poses disturbed at random.
//! `pose_probe DATASET SPLIT SCENE FRAMES...`
use rand::{RngExt, SeedableRng};
use sixfold_bop::{BopDataset, Models, ground_truth_visibility};
use sixfold_geometry::{Mask, Pose, Vec3, nalgebra::UnitQuaternion};
use sixfold_mesh::Mesh;
use sixfold_nol::{
    Photograph,
    refine::{RefineOptions, SceneKind, SceneSource, refine_scene},
};
use std::sync::Arc;

fn number(name: &str, default: f64) -> f64 {
    std::env::var(name).ok().map_or(default, |v| v.parse().expect("a number"))
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let dataset = BopDataset::open(std::path::Path::new(&arguments[0]), &arguments[1])?;
    let scene_id: u32 = arguments[2].parse()?;
    let scene = dataset.scene(scene_id)?;
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(number("SEED", 0.0) as u64);
    let mut photographs: std::collections::BTreeMap<u32, Vec<(Photograph, Pose)>> = Default::default();
    let mut meshes: std::collections::BTreeMap<u32, Mesh> = Default::default();
    for frame in &arguments[3..] {
        let im_id: u32 = frame.parse()?;
        let image = Arc::new(scene.rgb(im_id)?.expect("rgb"));
        let camera = scene.camera(im_id)?;
        let truth = &scene.image(im_id)?.ground_truth;
        for g in truth {
            meshes
                .entry(g.obj_id)
                .or_insert_with(|| dataset.model(g.obj_id, Models::Rendering).expect("model"));
        }
        let mut symmetric = |reach: f64| reach * (2.0 * random.random::<f64>() - 1.0);
        let disturbed: Vec<Pose> = truth
            .iter()
            .map(|g| {
                let shift = Vec3::from_fn(|_, _| symmetric(number("MM", 10.0) * 1e-3));
                let [a, b, c] = [0; 3].map(|_| symmetric(number("RAD", 0.05)));
                let turn = UnitQuaternion::from_euler_angles(a, b, c);
                let p = g.camera_from_object;
                Pose::new(turn * p.rotation(), p.translation() + shift)
            })
            .collect();
        let placed: Vec<(&Mesh, Pose)> =
            truth.iter().zip(&disturbed).map(|(g, p)| (&meshes[&g.obj_id], *p)).collect();
        let visible = ground_truth_visibility(&placed, &camera, None, 0.015);
        for ((g, pose), v) in truth.iter().zip(&disturbed).zip(visible) {
            if v.info.visib_fract < 0.5 {
                continue;
            }
            let mask: Mask = v.mask_visible;
            let photograph = Photograph::new(format!("{im_id}"), image.clone(), camera, *pose, Some(mask))?;
            photographs.entry(g.obj_id).or_default().push((photograph, g.camera_from_object));
        }
    }
    let d = RefineOptions::default();
    let options = RefineOptions {
        wide: number("WIDE", f64::from(d.wide)) as f32,
        shared: number("SHARED", d.shared as f64) as usize,
        colors: number("COLORS", d.colors),
        line: number("LINE", d.line),
        steps: number("STEPS", d.steps as f64) as usize,
        scene: if number("MOVING", 0.0) > 0.0 { SceneKind::Moving } else { SceneKind::Judge },
        side: number("SIDE", d.side as f64) as usize,
        blurs: std::env::var("BLURS")
            .map_or(d.blurs.clone(), |v| v.split(',').map(|x| x.parse().unwrap()).collect()),
        ..d
    };
    let median = |v: &mut Vec<f64>| {
        v.sort_by(f64::total_cmp);
        v[v.len() / 2]
    };
    let (mut before, mut after) = ([vec![], vec![], vec![], vec![]], [vec![], vec![], vec![], vec![]]);
    let start = std::time::Instant::now();
    let frames: Vec<String> = arguments[3..].to_vec();
    let ids: Vec<u32> = photographs.keys().copied().collect();
    let list_of_meshes: Vec<Mesh> = ids.iter().map(|id| meshes[id].clone()).collect();
    let sources: Vec<SceneSource> = photographs
        .iter()
        .flat_map(|(id, list)| {
            let object = ids.iter().position(|i| i == id).expect("id");
            let frames = &frames;
            list.iter().map(move |(p, _)| SceneSource {
                object,
                image: frames.iter().position(|f| f == p.name()).expect("frame"),
                photograph: p,
            })
        })
        .collect();
    let refined = refine_scene(&sources, &list_of_meshes, &options, |_| true)?;
    println!("still {} disagreement {:?}", refined.still, refined.disagreement);
    let mut reports = refined.sources.iter();
    for (id, list) in &photographs {
        let (low, high) = meshes[id].bounding_box();
        let centre = (low + high) * 0.5;
        let error = |a: &Pose, b: &Pose| {
            let d = a.transform_point(&centre) - b.transform_point(&centre);
            [d.norm() * 1e3, a.rotation_angle_to(b).to_degrees(), d.xy().norm() * 1e3, d.z.abs() * 1e3]
        };
        let mut own = [[vec![], vec![], vec![], vec![]], [vec![], vec![], vec![], vec![]]];
        for ((p, truth), r) in list.iter().zip(reports.by_ref()) {
            let (b, a) = (error(p.camera_from_object(), truth), error(&r.camera_from_object, truth));
            for k in 0..4 {
                before[k].push(b[k]);
                after[k].push(a[k]);
                own[0][k].push(b[k]);
                own[1][k].push(a[k]);
            }
        }
        let m = own.map(|o| o.map(|mut v| median(&mut v)));
        println!(
            "object {id:2} ({:2}): {:.1} mm {:.2} deg -> {:.2} mm {:.2} deg (across {:.2}, depth {:.2})",
            list.len(),
            m[0][0],
            m[0][1],
            m[1][0],
            m[1][1],
            m[1][2],
            m[1][3]
        );
    }
    let mut shifts = [vec![], vec![]];
    let mut reports = refined.sources.iter();
    for (id, list) in &photographs {
        let (low, high) = meshes[id].bounding_box();
        let centre = (low + high) * 0.5;
        for ((p, truth), r) in list.iter().zip(reports.by_ref()) {
            let a = p.camera().project(&r.camera_from_object.transform_point(&centre)).expect("in front");
            let b = p.camera().project(&truth.transform_point(&centre)).expect("in front");
            shifts[0].push(a.x - b.x);
            shifts[1].push(a.y - b.y);
        }
    }
    let spread = |v: &Vec<f64>| {
        let mut v = v.clone();
        let m = median(&mut v);
        let mut d: Vec<f64> = v.iter().map(|x| (x - m).abs()).collect();
        (m, median(&mut d))
    };
    println!(
        "shift in pixels, median and median deviation: x {:.2?} y {:.2?}",
        spread(&shifts[0]),
        spread(&shifts[1])
    );
    let b = before.map(|mut v| median(&mut v));
    let a = after.map(|mut v| median(&mut v));
    println!(
        "all: {:.1} mm {:.2} deg -> {:.2} mm {:.2} deg (across {:.2}, depth {:.2}); {:.1} s",
        b[0],
        b[1],
        a[0],
        a[1],
        a[2],
        a[3],
        start.elapsed().as_secs_f64()
    );
    Ok(())
}
