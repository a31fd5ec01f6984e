//! Semantic grasps (figure 6.13): experience from handles only transfers the grasp to the handle of another
//! object. Beside Sixfold's ranking: DGCM-Net as published, alone and joined with GPD, and three planners, which do not know
//! handles.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use sixfold_dgcm::model::DgcmModel;
use sixfold_dgcm::transfer::{
    Memory, ProposeOptions, Ranked, propose, rank_as_published, rank_experience_as_published, rank_on_part,
};
use sixfold_geometry::{DepthImage, NormalOptions, Rect, RgbImage, Vec3, normals_from_depth};
use sixfold_grasp::{
    AntipodalOptions, ClusterOptions, DrawnGrasp, Grasp, GraspFitter, GraspView, Gripper,
    centre_between_pads, draw_grasps,
};
use sixfold_io::{read_rgb, write_rgb};
use sixfold_mesh::Mesh;
use sixfold_plot::{Canvas, INK};
use sixfold_simulation::{AttemptOptions, ConvexParts, PartsOptions, SimulatedView, scene};

use sixfold_shell::grasp::journal::Journal;
use sixfold_shell::grasp::object_list::{PartBox, file_name};
use sixfold_shell::grasp::planner::Planner;
use sixfold_shell::grasp::trial::Hardness;
use sixfold_shell::overlay;
use sixfold_shell::progress::{Progress, check_interrupt};

/// Minimum fraction of the object's pixels that must show the handle; otherwise the view gives no cue.
const MIN_SEEN: f64 = 0.02;
/// Points within this distance of the named part's box count as on it, metres.
const AROUND: f64 = 0.006;

/// Width and height of an image of the figure, pixels.
const SIDE: usize = 200;
/// Height of the figure's captions, pixels.
const CAPTION: usize = 24;
/// Views of each object in the figure.
const SHOWN: usize = 2;

/// One view of an object with a handle. For each method: whether its first grasp is on the handle; `None` where nothing was
/// proposed.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Row {
    pub object: String,
    pub number: u64,
    /// Fraction of the object's pixels that show the handle.
    pub seen: f64,
    /// Sixfold's ranking, with experience on handles.
    pub by_experience: Option<bool>,
    /// DGCM-Net alone as published, with the same experience.
    pub by_network: Option<bool>,
    /// GPD's grasps joined with DGCM-Net as published.
    pub by_gpd_and_network: Option<bool>,
    /// The antipodal planner. It has no notion of handles, like the next two.
    pub by_geometry: Option<bool>,
    pub by_gpd: Option<bool>,
    pub by_haf: Option<bool>,
}

/// A method's answer in a row.
type Answer = fn(&Row) -> Option<bool>;

/// The methods' names and answers, in the order of the figure's columns.
pub(super) const METHODS: [(&str, Answer); 6] = [
    ("experience", |r| r.by_experience),
    ("network", |r| r.by_network),
    ("gpd and network", |r| r.by_gpd_and_network),
    ("geometry", |r| r.by_geometry),
    ("gpd", |r| r.by_gpd),
    ("haf", |r| r.by_haf),
];

/// The inputs of the test.
pub(super) struct Handles<'a> {
    pub objects: &'a [(String, String, Mesh)],
    pub parts: &'a [Option<PartBox>],
    pub network: &'a DgcmModel,
    /// GPD and HAF.
    pub planners: &'a [Planner; 2],
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
            "planners": self.planners.each_ref().map(Planner::fingerprint),
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
        figure(&rows, folder)?;
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
        let grasps = self.first_grasps(view, &planner, memory, &part.name)?;
        let held = grasps.map(|g| g.map(|g| on(&centre_between_pads(&g.camera_from_gripper))));
        let [by_experience, by_network, by_gpd_and_network, by_geometry, by_gpd, by_haf] = held;
        let row = Row {
            object: name.to_owned(),
            number,
            seen,
            by_experience,
            by_network,
            by_gpd_and_network,
            by_geometry,
            by_gpd,
            by_haf,
        };
        write_rgb(&strip_file(&row, folder), &strip(picture, view, gripper, &grasps, &held)?)?;
        Ok(Some(row))
    }

    /// The first grasp of each method, in the order of [`METHODS`].
    fn first_grasps(
        &self,
        view: &GraspView,
        options: &AntipodalOptions,
        memory: &mut Memory,
        part: &str,
    ) -> Result<[Option<Grasp>; METHODS.len()]> {
        let gripper = &self.setting.gripper;
        let clusters = ClusterOptions::default();
        let fitter = GraspFitter::new(view, gripper, options)?;
        let mut found = |form: ProposeOptions| {
            let options = ProposeOptions { part: Some(part.to_owned()), ..form };
            propose(&fitter, self.network, memory, &options)
        };
        let (ours, published) = (found(ProposeOptions::default())?, found(ProposeOptions::published())?);
        let outcomes = memory.outcomes(&gripper.name);
        let [gpd, haf] = self.planners;
        let antipodal = Planner::Antipodal;
        let planned = |planner: &Planner| planner.grasps(view, gripper, options);
        let (of_antipodal, of_gpd, of_haf) = (planned(&antipodal)?, planned(gpd)?, planned(haf)?);
        let geometry: Vec<Grasp> = of_antipodal.iter().map(|scored| scored.grasp).collect();
        let first = |ranked: Vec<Ranked>| ranked.first().map(|r| r.grasp);
        let alone = |planner: &Planner, grasps: &[_]| planner.ranked(grasps).first().map(|c| c.best);
        Ok([
            first(rank_on_part(&geometry, &ours, &clusters, &fitter, &outcomes)),
            first(rank_experience_as_published(&published.proposals, &clusters)),
            first(rank_as_published(&of_gpd, &published.proposals, &clusters)),
            alone(&antipodal, &of_antipodal),
            alone(gpd, &of_gpd),
            alone(haf, &of_haf),
        ])
    }
}

/// The image of a row's view.
fn strip_file(row: &Row, folder: &Path) -> PathBuf {
    folder.join(format!("{}-{}.png", file_name(&row.object), row.number))
}

/// The object's normals, and the gripper of each method on its depth: green on the handle, red elsewhere.
fn strip(
    picture: &SimulatedView,
    view: &GraspView,
    gripper: &Gripper,
    grasps: &[Option<Grasp>],
    held: &[Option<bool>],
) -> Result<RgbImage> {
    let [left, top, width, height] = view.mask.bounding_box().unwrap_or([0, 0, SIDE, SIDE]);
    let size = (1.7 * width.max(height) as f64).round().max(1.0);
    let corner = |from: usize, length: usize| (from as f64 + 0.5 * (length as f64 - size)).round();
    let (x, y) = (corner(left, width), corner(top, height));
    let camera = picture.camera.crop(&Rect { x, y, width: size, height: size }).resize(SIDE, SIDE);
    let step = size / SIDE as f64;
    let source = |u: usize, v: usize| {
        let at = |corner: f64, i: usize| (corner + (i as f64 + 0.5) * step).floor();
        let (x, y) = (at(x, u), at(y, v));
        (x >= 0.0 && y >= 0.0).then_some((x as usize, y as usize))
    };
    let normals = overlay::normal_picture(&normals_from_depth(
        &picture.depth,
        &picture.camera,
        &NormalOptions::default(),
    ));
    let normals = RgbImage::from_fn(SIDE, SIDE, |u, v| {
        source(u, v).and_then(|(x, y)| normals.get(x, y).copied()).unwrap_or([0; 3])
    });
    let depth = DepthImage::from_fn(SIDE, SIDE, |u, v| {
        source(u, v).and_then(|(x, y)| picture.depth.get(x, y).copied()).unwrap_or(0.0)
    });
    let background = overlay::depth_picture(&depth);
    let mut images = vec![normals];
    for (grasp, held) in grasps.iter().zip(held) {
        let color = if *held == Some(true) { [60, 220, 80] } else { [235, 70, 60] };
        let drawn: Vec<DrawnGrasp> = grasp
            .iter()
            .map(|g| DrawnGrasp { camera_from_gripper: g.camera_from_gripper, opening: g.opening, color })
            .collect();
        images.push(draw_grasps(&background, Some(&depth), &camera, gripper, &drawn)?);
    }
    Ok(RgbImage::from_fn(SIDE * images.len(), SIDE, |x, y| images[x / SIDE][(x % SIDE, y)]))
}

/// Figure 6.13, `handles.png`: the first views of each object, one below the other.
fn figure(rows: &[Row], folder: &Path) -> Result<()> {
    let mut strips = vec![];
    for (k, row) in rows.iter().enumerate() {
        if rows[..k].iter().filter(|r| r.object == row.object).count() < SHOWN {
            strips.push(read_rgb(&strip_file(row, folder))?);
        }
    }
    let width = SIDE * (1 + METHODS.len());
    let mut head = Canvas::new(width, CAPTION);
    let names = std::iter::once("normals").chain(METHODS.map(|m| m.0));
    for (k, name) in names.enumerate() {
        head.text((SIDE * k) as f64 + 6.0, 6.0, 1.5, name, INK);
    }
    let head = head.finish();
    let image =
        RgbImage::from_fn(width, CAPTION + SIDE * strips.len(), |x, y| match y.checked_sub(CAPTION) {
            None => head[(x, y)],
            Some(y) => strips[y / SIDE].get(x, y % SIDE).copied().unwrap_or([255; 3]),
        });
    Ok(write_rgb(&folder.join("handles.png"), &image)?)
}
