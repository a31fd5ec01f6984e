//! Pose errors before and after refinement (section 4.2.3).

use std::collections::BTreeMap;
use std::time::Instant;

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use sixfold_data::PosedImage;
use sixfold_geometry::nalgebra::Matrix4;
use sixfold_geometry::{Pose, Vec3, stats};
use sixfold_mesh::Mesh;
use sixfold_nol::model::NolModel;
use sixfold_nol::refine::{
    PoseRefinementOptions, PosedSource, PublishedRuleOptions, published_rule_poses, refine_scene,
};

use super::material::{Material, Poses, Source};

/// Variants of refinement: key and title.
pub(super) const WAYS: [(&str, &str); 6] = [
    ("printed", "published rule, the network's rendering"),
    ("printed-average", "published rule, mean of the colours"),
    ("colours", "ours, colours only"),
    ("outline", "ours, outline only"),
    ("both", "ours, both"),
    (ANNOTATED, "ours, both, begun at the annotated poses"),
];
/// This variant starts from the true poses, so its errors are the disagreement of photographs and
/// annotations.
pub(super) const ANNOTATED: &str = "annotated";
/// The variant whose poses are used to render the views.
pub(super) const BEST: &str = "both";
/// Number of other images used for the published rule's first rendering.
const PER_VIEW: usize = 6;

/// One variant with one disturbance.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct PosesRow {
    pub way: String,
    pub seed: u64,
    pub seconds: f64,
    /// Whether the objects were found to be static; only for variants that test this.
    pub still: Option<bool>,
    pub sources: Vec<RefinedSource>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct RefinedSource {
    pub frame: (u32, u32),
    pub object: u32,
    pub before: PoseError,
    pub after: PoseError,
    /// The refined pose, row by row, metres.
    pub camera_from_object: [[f64; 4]; 4],
    /// Why it should not be used.
    pub dropped: Option<String>,
}

/// Errors of a pose: metres at the centre of the object's box, and radians.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct PoseError {
    pub distance: f64,
    pub across: f64,
    pub along: f64,
    pub turned: f64,
    /// Mean distance of the corners of the object's box.
    pub corners: f64,
}

impl PoseError {
    pub fn new(found: &Pose, truth: &Pose, mesh: &Mesh) -> PoseError {
        let (low, high) = mesh.bounding_box();
        let off = |p: Vec3| found.transform_point(&p) - truth.transform_point(&p);
        let d = off((low + high) * 0.5);
        PoseError {
            distance: d.norm(),
            across: d.xy().norm(),
            along: d.z.abs(),
            turned: found.rotation_angle_to(truth),
            corners: mesh.box_corners().map(|corner| off(corner).norm()).iter().sum::<f64>() / 8.0,
        }
    }
}

impl PosesRow {
    /// Writes the refined poses of all sources into `poses`; other poses stay.
    pub fn put_into(&self, sources: &[Source], poses: &mut Poses) -> Result<()> {
        for (s, refined) in sources.iter().zip(&self.sources) {
            let rows = refined.camera_from_object;
            let matrix = Matrix4::from_fn(|i, j| rows[i][j]);
            poses[s.frame][s.index] = Pose::from_matrix(&matrix).context("a kept row's pose")?;
        }
        Ok(())
    }
}

/// Refines the sources with one variant.
pub(super) fn refine(
    material: &Material,
    sources: &[Source],
    way: &str,
    model: Option<&NolModel>,
    seed: u64,
) -> Result<PosesRow> {
    let start = Instant::now();
    let (poses, dropped, still): (Vec<Pose>, Vec<Option<String>>, Option<bool>) = match way {
        "printed" | "printed-average" => {
            let model = model.filter(|_| way == "printed");
            let mut poses = vec![];
            for (object, mesh) in &material.meshes {
                let of: Vec<PosedImage> =
                    sources.iter().filter(|s| s.object == *object).map(|s| s.photograph.clone()).collect();
                let options = PublishedRuleOptions::default();
                let side = PoseRefinementOptions::default().side;
                let found = published_rule_poses(&of, mesh, model, side, PER_VIEW, &options)?;
                poses.extend(found.into_iter().map(|(pose, _)| pose));
            }
            let none = vec![None; poses.len()];
            (poses, none, None)
        }
        _ => {
            let default = PoseRefinementOptions::default();
            let options = PoseRefinementOptions {
                colors: if way == "outline" { 0.0 } else { default.colors },
                line: if way == "colours" { 0.0 } else { default.line },
                ..default
            };
            let ids: Vec<u32> = material.meshes.keys().copied().collect();
            let meshes: Vec<Mesh> = material.meshes.values().cloned().collect();
            let scene: Vec<PosedSource<'_>> = sources
                .iter()
                .filter_map(|s| {
                    let object = ids.iter().position(|id| *id == s.object)?;
                    Some(PosedSource { object, image: s.frame, photograph: &s.photograph })
                })
                .collect();
            let going =
                |_, _| !sixfold_shell::progress::interrupted().load(std::sync::atomic::Ordering::SeqCst);
            let refined = refine_scene(&scene, &meshes, &options, &going)?;
            sixfold_shell::progress::check_interrupt(super::RESUME_HINT)?;
            let reports = refined.sources;
            (
                reports.iter().map(|r| r.camera_from_object).collect(),
                reports.into_iter().map(|r| r.dropped).collect(),
                Some(refined.still),
            )
        }
    };
    let seconds = start.elapsed().as_secs_f64();
    let sources = sources
        .iter()
        .zip(poses.iter().zip(dropped))
        .map(|(s, (pose, dropped))| {
            let mesh = &material.meshes[&s.object];
            RefinedSource {
                frame: material.sources[s.frame].id,
                object: s.object,
                before: PoseError::new(s.photograph.camera_from_object(), &s.truth, mesh),
                after: PoseError::new(pose, &s.truth, mesh),
                camera_from_object: pose.rows(),
                dropped,
            }
        })
        .collect();
    Ok(PosesRow { way: way.to_owned(), seed, seconds, still, sources })
}

/// Medians over sources.
#[derive(Debug, Clone, Serialize)]
pub(super) struct PosesSummary {
    pub title: String,
    pub all: Medians,
    pub objects: BTreeMap<u32, Medians>,
    /// Seconds for all sources of one disturbance; `None` for the disturbed poses themselves.
    pub seconds: Option<f64>,
    /// Sources that were rejected because their poses had too large errors.
    pub dropped: usize,
}

#[derive(Debug, Clone, Serialize)]
pub(super) struct Medians {
    pub sources: usize,
    pub millimetres: f64,
    pub millimetres_across: f64,
    pub millimetres_along: f64,
    pub degrees: f64,
    /// Fraction of the disturbed sources whose box corners came closer to their true positions.
    pub improved: Option<f64>,
}

/// The disturbed poses, then every variant.
pub(super) fn summaries(rows: &[PosesRow]) -> Vec<PosesSummary> {
    let mut all = vec![];
    // The disturbance is the same for every variant.
    if let Some(first) = rows.first() {
        let of: Vec<&PosesRow> = rows.iter().filter(|r| r.way == first.way).collect();
        all.push(PosesSummary { seconds: None, dropped: 0, ..summary("disturbed", &of, |s| s.before) });
    }
    for (way, title) in WAYS {
        let of: Vec<&PosesRow> = rows.iter().filter(|r| r.way == way).collect();
        if !of.is_empty() {
            all.push(summary(title, &of, |s| s.after));
        }
    }
    all
}

fn summary(title: &str, rows: &[&PosesRow], error: impl Fn(&RefinedSource) -> PoseError) -> PosesSummary {
    let sources: Vec<&RefinedSource> = rows.iter().flat_map(|r| &r.sources).collect();
    let mut by_object: BTreeMap<u32, Vec<&RefinedSource>> = BTreeMap::new();
    for s in &sources {
        by_object.entry(s.object).or_default().push(s);
    }
    let medians = |of: &[&RefinedSource]| {
        let over = |f: &dyn Fn(PoseError) -> f64| median(of.iter().map(|s| f(error(s))).collect());
        let disturbed = of.iter().filter(|s| s.before.corners > 0.0).count();
        let improved = of.iter().filter(|s| error(s).corners < s.before.corners).count();
        Medians {
            sources: of.len(),
            millimetres: 1e3 * over(&|e| e.distance),
            millimetres_across: 1e3 * over(&|e| e.across),
            millimetres_along: 1e3 * over(&|e| e.along),
            degrees: over(&|e| e.turned).to_degrees(),
            improved: (disturbed > 0).then(|| improved as f64 / disturbed as f64),
        }
    };
    PosesSummary {
        title: title.to_owned(),
        all: medians(&sources),
        objects: by_object.iter().map(|(id, of)| (*id, medians(of))).collect(),
        seconds: Some(rows.iter().map(|r| r.seconds).sum::<f64>() / rows.len().max(1) as f64),
        dropped: sources.iter().filter(|s| s.dropped.is_some()).count(),
    }
}

/// The middle value, or the mean of the two middle ones.
fn median(mut values: Vec<f64>) -> f64 {
    stats::median(&mut values).unwrap_or(f64::NAN)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_those_of_the_boxs_centre() {
        let vertices = vec![Vec3::zeros(), Vec3::x() * 0.1, Vec3::y() * 0.1, Vec3::z() * 0.1];
        let mesh = Mesh::new(vertices, vec![[0, 1, 2], [0, 2, 3]]).unwrap();
        let moved = Pose::from_translation(Vec3::new(0.003, 0.004, 0.012));
        let e = PoseError::new(&moved, &Pose::identity(), &mesh);
        let expected = [0.013, 0.005, 0.012, 0.0, 0.013];
        for (found, expected) in [e.distance, e.across, e.along, e.turned, e.corners].iter().zip(expected) {
            assert!((found - expected).abs() < 1e-12, "{e:?}");
        }
        assert_eq!(median(vec![3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(vec![4.0, 1.0, 2.0, 3.0]), 2.5);
    }
}
