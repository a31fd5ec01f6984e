//! `sixfold grasp propose`: from a depth image to ranked grasps and a picture of them.

use std::path::PathBuf;

use anyhow::{Context, Result, anyhow, bail};
use serde::Serialize;
use sixfold_bop::{read_depth, read_mask, read_rgb, write_rgb};
use sixfold_geometry::{undistort_depth, undistort_rgb};
use sixfold_grasp::{
    AntipodalOptions, AntipodalQuality, ClusterOptions, DrawnGrasp, GraspCluster, GraspView, ViewOptions,
    antipodal_grasps, cluster_grasps, draw_grasps, find_objects,
};

use super::arguments::ProposeArguments;
use crate::Outcome;
use crate::output::{pose_rows, report, write_atomically};
use crate::{camera_file, overlay};

/// The best grasp's colour; the others are blue.
const BEST: [u8; 3] = [60, 220, 80];
const OTHER: [u8; 3] = [86, 150, 233];

pub(super) fn run(a: &ProposeArguments) -> Result<Outcome> {
    let gripper = super::gripper(&a.gripper)?;
    let file = camera_file::read(&a.camera)?;
    let scale = a.depth_scale.or(file.depth_scale).ok_or_else(|| {
        anyhow!(
            "{}: field depth_scale is missing: give it there or as --depth-scale (millimetres per unit of the depth image: 1 for most cameras)",
            a.camera.display()
        )
    })?;
    if !(scale > 0.0 && scale.is_finite()) {
        bail!("--depth-scale: found {scale}, expected above 0");
    }
    let depth = read_depth(&a.depth, scale / 1000.0)?;
    let camera = file.for_image(depth.width(), depth.height(), &a.camera)?;
    let depth = undistort_depth(&depth, &camera)?;
    let rgb = match &a.rgb {
        None => None,
        Some(path) => {
            Some(undistort_rgb(&read_rgb(path)?, &camera).with_context(|| path.display().to_string())?)
        }
    };
    let camera = camera.without_distortion();
    let began = std::time::Instant::now();
    let options = ViewOptions { seed: a.seed, ..ViewOptions::default() };
    let mask = match &a.mask {
        Some(path) => Some(read_mask(path)?),
        None => find_objects(&depth, &camera, &options)
            .with_context(|| a.depth.display().to_string())?
            .into_iter()
            .next(),
    };
    let where_from = a.mask.as_ref().unwrap_or(&a.depth).display().to_string();
    let view = match &mask {
        Some(mask) => Some(GraspView::new(&depth, &camera, mask, &options).context(where_from)?),
        None => None,
    };
    let clusters: Vec<GraspCluster> = match &view {
        None => vec![],
        Some(view) => {
            let default = AntipodalOptions::default();
            let completion = default.completion.filter(|_| !a.seen_only);
            let planner = AntipodalOptions { seed: a.seed, completion, ..default };
            let grasps = antipodal_grasps(view, &gripper, &planner)?;
            let mut clusters = cluster_grasps(&grasps, &ClusterOptions::default());
            clusters.truncate(a.number.get());
            clusters
        }
    };
    let seconds = began.elapsed().as_secs_f64();
    if view.as_ref().is_some_and(|v| v.cut_by_edge) {
        eprintln!("note: the object is cut by the edge of the image: what lies outside was not seen");
    }
    let picture = match &a.out {
        None => None,
        Some(folder) => {
            let background = rgb.unwrap_or_else(|| overlay::depth_picture(&depth));
            let drawn: Vec<DrawnGrasp> = clusters
                .iter()
                .enumerate()
                .rev()
                .map(|(i, c)| DrawnGrasp {
                    camera_from_gripper: c.best.camera_from_gripper,
                    opening: c.best.opening,
                    color: if i == 0 { BEST } else { OTHER },
                })
                .collect();
            let path = folder.join("overlay.png");
            write_rgb(&path, &draw_grasps(&background, Some(&depth), &camera, &gripper, &drawn)?)?;
            Some(path)
        }
    };
    let whole = Whole {
        method: "antipodal",
        gripper: gripper.name.clone(),
        object_pixels: view.as_ref().map_or(0, |v| v.mask.as_slice().iter().filter(|m| **m).count()),
        table: view
            .as_ref()
            .and_then(|v| v.table)
            .map(|t| Table { normal: t.normal.into(), offset: t.offset }),
        cut_by_edge: view.as_ref().is_some_and(|v| v.cut_by_edge),
        grasps: clusters.iter().map(Proposed::new).collect(),
        overlay: picture,
        seconds,
    };
    if let Some(folder) = &a.out {
        let text = serde_json::to_string_pretty(&whole)?;
        write_atomically(&folder.join("grasps.json"), text.as_bytes())?;
    }
    report(&a.json, &whole, || print_table(&whole, a.out.as_deref()))?;
    Ok(if whole.grasps.is_empty() { Outcome::NothingFound } else { Outcome::Found })
}

#[derive(Serialize)]
struct Whole {
    method: &'static str,
    gripper: String,
    object_pixels: usize,
    table: Option<Table>,
    cut_by_edge: bool,
    grasps: Vec<Proposed>,
    overlay: Option<PathBuf>,
    seconds: f64,
}

/// `normal . p = offset` in the camera's frame, metres.
#[derive(Serialize)]
struct Table {
    normal: [f64; 3],
    offset: f64,
}

#[derive(Serialize)]
struct Proposed {
    camera_from_gripper: [[f64; 4]; 4],
    opening: f64,
    width: f64,
    quality: f64,
    parts: AntipodalQuality,
    cluster_score: f64,
    cluster_members: usize,
}

impl Proposed {
    fn new(cluster: &GraspCluster) -> Proposed {
        Proposed {
            camera_from_gripper: pose_rows(&cluster.best.camera_from_gripper),
            opening: cluster.best.opening,
            width: cluster.best.width,
            quality: cluster.best.quality.total(),
            parts: cluster.best.quality,
            cluster_score: cluster.score,
            cluster_members: cluster.members,
        }
    }
}

fn print_table(whole: &Whole, folder: Option<&std::path::Path>) {
    if whole.grasps.is_empty() {
        println!(
            "no grasp found for gripper {} ({} pixels of an object)",
            whole.gripper, whole.object_pixels
        );
    } else {
        println!(
            "{:>2} {:>8} {:>8} {:>10} {:>10} {:>26}",
            "", "quality", "members", "width (m)", "open (m)", "tips' middle (m)"
        );
    }
    for (i, g) in whole.grasps.iter().enumerate() {
        let t: Vec<String> = g.camera_from_gripper[..3].iter().map(|r| format!("{:8.4}", r[3])).collect();
        println!(
            "{:>2} {:>8.3} {:>8} {:>10.4} {:>10.4} {:>26}",
            i + 1,
            g.quality,
            g.cluster_members,
            g.width,
            g.opening,
            t.join(" ")
        );
    }
    if let Some(folder) = folder {
        println!("grasps.json and overlay.png are in {}", folder.display());
    }
}
