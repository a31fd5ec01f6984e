//! Semantic grasps (figure 6.13): experience from handles only transfers the grasp to the handle of another
//! object.

use std::path::Path;

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use sixfold_dgcm::model::DgcmModel;
use sixfold_dgcm::transfer::{Memory, ProposeOptions, propose, rank_on_part};
use sixfold_geometry::Vec3;
use sixfold_grasp::{
    AntipodalOptions, ClusterOptions, DrawnGrasp, Grasp, GraspFitter, centre_between_pads, draw_grasps,
};
use sixfold_io::write_rgb;
use sixfold_mesh::Mesh;
use sixfold_simulation::{AttemptOptions, ConvexParts, PartsOptions, scene};

use sixfold_shell::grasp::journal::Journal;
use sixfold_shell::grasp::object_list::{PartBox, file_name};
use sixfold_shell::grasp::trial::Hardness;
use sixfold_shell::overlay;
use sixfold_shell::progress::{Progress, check_interrupt};

/// Minimum fraction of the object's pixels that must show the handle; otherwise the view gives no cue.
const MIN_SEEN: f64 = 0.02;
/// Points within this distance of the named part's box count as on it, metres.
const AROUND: f64 = 0.006;

/// One view of an object with a handle.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Row {
    pub object: String,
    pub number: u64,
    /// Fraction of the object's pixels that show the handle.
    pub seen: f64,
    /// Whether the first grasp from experience on handles is on the handle; `None` where nothing was proposed.
    pub by_experience: Option<bool>,
    /// The same for the planner's first grasp; the planner has no notion of handles.
    pub by_geometry: Option<bool>,
}

/// The inputs of the test.
pub(super) struct Handles<'a> {
    pub objects: &'a [(String, String, Mesh)],
    pub parts: &'a [Option<PartBox>],
    pub network: &'a DgcmModel,
    pub setting: &'a Hardness,
    /// Views of each object.
    pub views: usize,
    pub seed: u64,
}

impl Handles<'_> {
    /// Rows of all views, those of an earlier run included.
    pub fn run(&self, memory: &mut Memory, folder: &Path) -> Result<Vec<Row>> {
        let marked: Vec<(&String, &Mesh, &PartBox)> = self
            .objects
            .iter()
            .zip(self.parts)
            .filter_map(|((_, name, mesh), part)| part.as_ref().map(|part| (name, mesh, part)))
            .collect();
        let recorded = serde_json::json!({
            "objects": marked.iter().map(|m| m.0).collect::<Vec<_>>(), "views": self.views, "seed": self.seed,
            "network": self.network.fingerprint(), "experiences": memory.len(),
        });
        let (mut journal, mut rows) = Journal::open::<Row>(&folder.join("handles.jsonl"), &recorded)?;
        let mut progress = Progress::new("views of handles", marked.len() * self.views);
        for (name, mesh, part) in marked {
            let mut done = rows.iter().filter(|r| r.object == *name).count();
            let mut number =
                rows.iter().filter(|r| r.object == *name).map(|r| r.number + 1).max().unwrap_or(0);
            (0..done).for_each(|_| progress.step(name.clone()));
            let parts = ConvexParts::of_mesh(mesh, &PartsOptions::default()).with_context(|| name.clone())?;
            // Views from behind do not show the handle: skip them.
            while done < self.views && number < 8 * self.views as u64 {
                check_interrupt("what was tried is kept; run the same command again to continue")?;
                if let Some(row) = self.row(name, mesh, part, &parts, number, memory, folder)? {
                    journal.row(&row)?;
                    rows.push(row);
                    done += 1;
                    progress.step(name.clone());
                }
                number += 1;
            }
        }
        progress.finish();
        Ok(rows)
    }

    #[allow(clippy::too_many_arguments)]
    fn row(
        &self,
        name: &str,
        mesh: &Mesh,
        part: &PartBox,
        parts: &ConvexParts,
        number: u64,
        memory: &mut Memory,
        folder: &Path,
    ) -> Result<Option<Row>> {
        let options: &AttemptOptions = &self.setting.options;
        let gripper = &self.setting.gripper;
        let scene = scene(mesh, parts, options, self.seed ^ 0x6861_6e64, number);
        let (Some(view), Some(picture)) = (&scene.view, &scene.seen) else { return Ok(None) };
        let object_from_camera = scene.world_from_object.inverse() * picture.world_from_camera;
        let on = |p: &Vec3| part.contains(&object_from_camera.transform_point(p), AROUND);
        let seen =
            view.object.points.iter().filter(|p| on(p)).count() as f64 / view.object.len().max(1) as f64;
        if seen < MIN_SEEN {
            return Ok(None);
        }
        let planner = AntipodalOptions { seed: scene.noise, ..options.planner };
        let fitter = GraspFitter::new(view, gripper, &planner)?;
        let options = ProposeOptions { part: Some(part.name.clone()), ..ProposeOptions::default() };
        let found = propose(&fitter, self.network, memory, &options)?;
        let outcomes = memory.outcomes(&gripper.name);
        let clusters = ClusterOptions::default();
        let geometry = sixfold_grasp::antipodal_grasps(view, gripper, &planner)?;
        let first = rank_on_part(&geometry, &found, &clusters, &fitter, &outcomes);
        let plain = sixfold_grasp::cluster_grasps(&geometry, &clusters);
        let holds = |g: &Grasp| on(&centre_between_pads(&g.camera_from_gripper));
        let row = Row {
            object: name.to_owned(),
            number,
            seen,
            by_experience: first.first().map(|r| holds(&r.grasp)),
            by_geometry: plain.first().map(|c| holds(&c.best)),
        };
        let drawn = |g: &Grasp, color| DrawnGrasp {
            camera_from_gripper: g.camera_from_gripper,
            opening: g.opening,
            color,
        };
        let mut grasps = vec![];
        if let Some(c) = plain.first() {
            grasps.push(drawn(&c.best, [150, 150, 150]));
        }
        if let Some(r) = first.first() {
            let color = if row.by_experience == Some(true) { [60, 220, 80] } else { [235, 70, 60] };
            grasps.push(drawn(&r.grasp, color));
        }
        let background = overlay::depth_picture(&picture.depth);
        let image = draw_grasps(&background, Some(&picture.depth), &picture.camera, gripper, &grasps)?;
        write_rgb(&folder.join(format!("{}-{number}.png", file_name(name))), &image)?;
        Ok(Some(row))
    }
}
