//! Output of proposed grasps: numbers for JSON and tables, and an image.

use anyhow::Result;
use serde::Serialize;
use sixfold_geometry::{Camera, DepthImage, Plane, Pose, RgbImage};
use sixfold_grasp::learned::ScoredGrasp;
use sixfold_grasp::{AntipodalQuality, DrawnGrasp, Grasp, GraspCluster, Gripper, draw_grasps};

use super::planner::Planner;
use crate::labels::{Label, draw_labels};
use crate::overlay::{caption, depth_picture};

/// The best grasp's colour; the others are blue.
const BEST: [u8; 3] = [60, 220, 80];
const OTHER: [u8; 3] = [86, 150, 233];

/// `normal . p = offset` in the camera's frame, metres.
#[derive(Serialize)]
pub struct Table {
    normal: [f64; 3],
    offset: f64,
}

impl From<Plane> for Table {
    fn from(plane: Plane) -> Table {
        Table { normal: plane.normal.into(), offset: plane.offset }
    }
}

/// A grasp.
#[derive(Serialize)]
pub struct Proposed {
    /// Pose of the gripper when it closes, 4x4, row by row.
    pub camera_from_gripper: [[f64; 4]; 4],
    /// Distance of the pads before closing, metres.
    pub opening: f64,
    /// Distance of the contacts, metres.
    pub width: f64,
    /// Quality of its contacts, or the success probability that a trained planner predicts, 0 to 1.
    pub quality: f64,
    /// The terms of the quality of its contacts.
    #[serde(skip_serializing_if = "Option::is_none")]
    parts: Option<AntipodalQuality>,
    cluster_score: f64,
    /// Number of grasps in its cluster.
    pub cluster_members: usize,
    /// The experience it was transferred from, or that agrees with it.
    #[serde(skip_serializing_if = "Option::is_none")]
    experience: Option<FromExperience>,
    #[serde(skip)]
    pose: Pose,
}

#[derive(Serialize)]
struct FromExperience {
    kind: &'static str,
    /// Id of the experience in its store.
    id: Option<i64>,
    /// Distance of the features.
    distance: Option<f64>,
    /// Whether a difference in size was explained by a scale or by a rotation.
    hypothesis: Option<&'static str>,
    /// The fraction of experience that agrees with the grasp.
    agreement: f64,
}

impl Proposed {
    fn new(grasp: &Grasp, score: f64, members: usize) -> Proposed {
        Proposed {
            camera_from_gripper: grasp.camera_from_gripper.rows(),
            opening: grasp.opening,
            width: grasp.width,
            quality: grasp.quality.total(),
            parts: Some(grasp.quality),
            cluster_score: score,
            cluster_members: members,
            experience: None,
            pose: grasp.camera_from_gripper,
        }
    }
}

/// Grasps of the planner alone, the best first.
pub fn of_planner(planner: &Planner, grasps: &[ScoredGrasp]) -> Vec<Proposed> {
    let clusters = planner.ranked(grasps);
    let proposed = |c: &GraspCluster| Proposed {
        quality: c.best_score,
        parts: matches!(planner, Planner::Antipodal).then_some(c.best.quality),
        ..Proposed::new(&c.best, c.score, c.members)
    };
    clusters.iter().map(proposed).collect()
}

/// Grasps of experience and of geometry, the best first. The quality of grasps of a trained planner is its score, scaled to 0..1
/// over all its grasps.
#[cfg(feature = "experience")]
pub fn of_both(planner: &Planner, grasps: &sixfold_dgcm::transfer::RankedGrasps) -> Vec<Proposed> {
    use sixfold_dgcm::transfer::Kind;
    let proposed = |r: &sixfold_dgcm::transfer::Ranked| {
        let proposal = r.proposal.map(|i| &grasps.found.proposals[i]);
        let experience = FromExperience {
            kind: match r.kind {
                Kind::Geometry => "geometry",
                Kind::Experience => "experience",
            },
            id: proposal.map(|p| p.from.experience),
            distance: proposal.map(|p| p.from.distance),
            hypothesis: proposal.map(|p| p.hypothesis.name()),
            agreement: r.experience,
        };
        let made = Proposed { experience: Some(experience), ..Proposed::new(&r.grasp, r.score, r.members) };
        match (planner, r.kind) {
            (Planner::Antipodal, _) | (_, Kind::Experience) => made,
            _ => Proposed { quality: r.geometry, parts: None, ..made },
        }
    };
    grasps.ranked.iter().map(proposed).collect()
}

/// The grippers over the colour image or, without one, the depth image, each with its number and quality.
///
/// # Errors
/// For a gripper that has no mesh.
pub fn picture(
    rgb: Option<RgbImage>,
    depth: &DepthImage,
    camera: &Camera,
    gripper: &Gripper,
    proposed: &[Proposed],
) -> Result<RgbImage> {
    let background = rgb.unwrap_or_else(|| depth_picture(depth));
    let drawn: Vec<DrawnGrasp> = proposed
        .iter()
        .enumerate()
        .rev()
        .map(|(i, p)| DrawnGrasp {
            camera_from_gripper: p.pose,
            opening: p.opening,
            color: if i == 0 { BEST } else { OTHER },
        })
        .collect();
    let mut out = draw_grasps(&background, Some(depth), camera, gripper, &drawn)?;
    // Number and quality of each grasp, drawn where the hand begins.
    let label = |(i, p): (usize, &Proposed)| {
        let at = camera.project(&p.pose.translation())?;
        Some(Label {
            text: caption(&(i + 1).to_string(), p.quality),
            of: [at.x, at.y, at.x, at.y],
            color: if i == 0 { BEST } else { OTHER },
            is_sure: true,
        })
    };
    let labels: Vec<Label> = proposed.iter().enumerate().filter_map(label).collect();
    draw_labels(&mut out, &labels);
    Ok(out)
}

/// Number of the nearest experiences in [`nearest_picture`], as in the dissertation.
#[cfg(feature = "experience")]
const NEAREST: usize = 3;

/// The object with its best grasp beside the experiences nearest to it (dissertation, figure 6.8): normals above, VD-NOC below. The
/// labels are the objects of the experiences and the distances of the features.
///
/// # Errors
/// When the store cannot be read, or for a gripper that has no mesh.
#[cfg(feature = "experience")]
pub fn nearest_picture(
    grasps: &sixfold_dgcm::transfer::RankedGrasps,
    memory: &mut sixfold_dgcm::transfer::Memory,
    gripper: &Gripper,
) -> Result<RgbImage> {
    let mut nearest: Vec<(std::sync::Arc<sixfold_experience::Stored>, f64)> = vec![];
    for found in &grasps.found.nearest {
        // Its copies, rotated in the image plane, are further away.
        let is_copy = nearest.iter().any(|(shown, _)| shown.id == found.experience);
        if nearest.len() < NEAREST
            && !is_copy
            && let Some(stored) = memory.get(found.experience)?
        {
            nearest.push((stored, found.distance));
        }
    }
    let grasp = grasps.ranked.first().map(|r| (&r.grasp.camera_from_gripper, r.grasp.opening, gripper));
    let experiences: Vec<_> = nearest.iter().map(|(stored, _)| &stored.experience).collect();
    let mut out = sixfold_experience::picture_with_nearest(&grasps.found.crop, grasp, &experiences)?;
    let side = out.height() as f64 / 2.0;
    let texts = nearest.iter().map(|(stored, distance)| caption(&stored.experience.object, *distance));
    let label = |(column, text): (usize, String)| {
        let middle = (column as f64 + 0.5) * side;
        Label {
            text,
            of: [middle, side, middle, side],
            color: if column == 0 { BEST } else { OTHER },
            is_sure: true,
        }
    };
    let labels: Vec<Label> =
        std::iter::once("this object".to_owned()).chain(texts).enumerate().map(label).collect();
    draw_labels(&mut out, &labels);
    Ok(out)
}

/// Prints the grasps, one a line.
pub fn print_table(grasps: &[Proposed]) {
    println!(
        "{:>2} {:>8} {:>8} {:>10} {:>10} {:>26}",
        "", "quality", "members", "width (m)", "open (m)", "tips' centre (m)"
    );
    for (i, g) in grasps.iter().enumerate() {
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
}
