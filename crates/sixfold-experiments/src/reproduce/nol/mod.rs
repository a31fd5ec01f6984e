//! `sixfold reproduce nol`: the tables of Neural Object Learning (dissertation, chapter 4) on a dataset: poses after refinement
//! (section 4.2.3), views compared with real pixels (table 4.6), wrong meshes (section 4.4.3), another lamp, and times.

pub(crate) mod arguments;
mod drawn;
mod lamps;
mod material;
mod picture;
mod poses;
mod speed;
mod table;
mod views;

use std::collections::BTreeMap;

use anyhow::{Context, Result, bail};
use serde::Serialize;
use sixfold_data::PosedImage;
use sixfold_mesh::Mesh;
use sixfold_nol::model::NolModel;
use sixfold_nol::similarity::ImageSimilarity;

use self::arguments::ReproduceNolArguments;
use self::material::{Material, Source};
use self::picture::Strips;
use self::poses::{PosesRow, PosesSummary};
use self::speed::Speed;
use self::views::{Networks, Target, ViewRow, ViewsSummary, Way};
use super::kept::{kept_or_made, same_inputs, write_table};
use sixfold_shell::Outcome;
use sixfold_shell::output::JsonArguments;
use sixfold_shell::progress::{Progress, check_interrupt};

/// The message after an interrupt.
const RESUME_HINT: &str = "the finished rows are kept; run the same command again to continue";
/// Side of the views that are compared, pixels.
const SIDE: usize = 128;
/// The inputs of the views, in the order of the table.
const SETS: [&str; 8] = [
    views::MODEL,
    "disturbed poses",
    "refined poses",
    "refined, agreeing",
    "true poses",
    "500 faces",
    "vertices 1 mm off",
    lamps::SET,
];
/// Number of disturbances; one with `--quick`.
const DISTURBANCES: u64 = 3;

/// The inputs of all rows. Rows made from other inputs are not mixed with these.
#[derive(Debug, PartialEq, Serialize)]
struct Inputs {
    version: &'static str,
    dataset: String,
    split: String,
    /// Sources, `scene/image`.
    frames: Vec<String>,
    /// Networks and the FNV-1a of their files.
    networks: Vec<(String, String)>,
    hope: Option<String>,
    seed: u64,
}

#[derive(Serialize)]
struct Whole {
    inputs: Inputs,
    /// Whether only some rows were made. They are a subset of the full run, which continues with the others without `--quick`.
    quick: bool,
    disturbances: u64,
    poses: Vec<PosesSummary>,
    /// The same for rendered frames, whose poses are exact.
    drawn_poses: Vec<PosesSummary>,
    /// Number of targets that were compared, and that were left out.
    targets_of_views: [usize; 2],
    views: Vec<ViewsSummary>,
    lamps: Vec<ViewsSummary>,
    speed: Speed,
}

/// The state that the parts share.
struct Bench<'a> {
    a: &'a ReproduceNolArguments,
    material: Material,
    networks: Vec<(String, NolModel)>,
    judge: ImageSimilarity,
    strips: Strips,
}

pub(super) fn run(a: &ReproduceNolArguments, json: &JsonArguments) -> Result<Outcome> {
    let mut networks = vec![];
    let mut hashes = vec![];
    let files = a.weights.iter().map(|file| ("network".to_owned(), file));
    for (name, file) in files.chain(a.compare.iter().map(|(name, file)| (name.clone(), file))) {
        if hashes.iter().any(|(n, _)| *n == name) || ["best", "average"].contains(&name.as_str()) {
            bail!(
                "--compare: found the name {name} twice, expected another; `network`, `best` and `average` are taken"
            );
        }
        networks.push((name.clone(), NolModel::load(file)?));
        let bytes = std::fs::read(file).with_context(|| file.display().to_string())?;
        hashes.push((name, format!("{:016x}", sixfold_io::fnv1a(&bytes))));
    }
    let material = Material::read(a)?;
    let inputs = Inputs {
        version: env!("CARGO_PKG_VERSION"),
        dataset: a.dataset.display().to_string(),
        split: a.split.clone(),
        frames: material.sources.iter().map(|f| format!("{}/{}", f.id.0, f.id.1)).collect(),
        networks: hashes,
        hope: a.hope.as_ref().map(|f| f.display().to_string()),
        seed: a.seed,
    };
    same_inputs(&a.out, &inputs)?;
    let bench = Bench { a, material, networks, judge: ImageSimilarity::new()?, strips: Strips::new(&a.out) };
    let disturbances = if a.quick { 1 } else { DISTURBANCES };
    let mut rows = vec![];
    for seed in a.seed..a.seed + disturbances {
        rows.extend(bench.poses(&bench.material, "poses", seed)?);
    }
    let drawn = drawn::drawn(&bench.material, a.seed)?;
    drawn::picture(&drawn, &a.out.join("drawn.png"))?;
    let mut drawn_rows = vec![];
    for seed in a.seed..a.seed + disturbances {
        drawn_rows.extend(bench.poses(&drawn, "drawn", seed)?);
    }
    let view_rows = bench.views(&rows)?;
    let lamp_rows = match &a.hope {
        Some(root) => lamps::rows(root, &a.out, &bench.networks, &bench.judge, &bench.strips, a.quick)?,
        None => vec![],
    };
    bench.sheets(&view_rows, &lamp_rows)?;
    let speed = kept_or_made(&a.out, "speed", || {
        let sources = bench.material.photographs(&bench.material.disturbed(a.seed))?;
        speed::measure(&bench.material, &sources, &bench.networks)
    })?;
    let left_out = view_rows.iter().filter(|r| r.cells.is_empty()).count();
    let result = Whole {
        inputs,
        quick: a.quick,
        disturbances,
        poses: poses::summaries(&rows),
        drawn_poses: poses::summaries(&drawn_rows),
        targets_of_views: [view_rows.len() - left_out, left_out],
        views: views::summaries(&view_rows),
        lamps: views::summaries(&lamp_rows),
        speed,
    };
    write_table(
        &a.out,
        &table::markdown(&result),
        &result,
        "table.md, reproduce.json, the images and the rows are",
        json,
    )?;
    Ok(if view_rows.is_empty() { Outcome::NothingFound } else { Outcome::Found })
}

impl Bench<'_> {
    /// All variants of refinement on one disturbance.
    fn poses(&self, material: &Material, what: &str, seed: u64) -> Result<Vec<PosesRow>> {
        let sources = material.photographs(&material.disturbed(seed))?;
        if sources.is_empty() {
            bail!("--frames: none of the frames shows enough of an object");
        }
        // The network of --weights; a network for comparison does not count.
        let model = self.a.weights.as_ref().and_then(|_| self.networks.first()).map(|(_, model)| model);
        let mut rows = vec![];
        for (way, _) in poses::WAYS {
            if way == "printed" && model.is_none() {
                continue;
            }
            check_interrupt(RESUME_HINT)?;
            let key = format!("{what}-{way}-{seed}");
            rows.push(kept_or_made(&self.a.out, &key, || match way {
                poses::ANNOTATED => {
                    let sources = material.at_poses(&sources, &material.true_poses())?;
                    poses::refine(material, &sources, way, model, seed)
                }
                _ => poses::refine(material, &sources, way, model, seed),
            })?);
        }
        Ok(rows)
    }

    /// Views of all objects in the frames that are not sources, from the poses of the first disturbance.
    fn views(&self, rows: &[PosesRow]) -> Result<Vec<ViewRow>> {
        let rough = self.material.disturbed(self.a.seed);
        let disturbed = self.material.photographs(&rough)?;
        let Some(row) = rows.iter().find(|r| r.way == poses::BEST && r.seed == self.a.seed) else {
            bail!("no refined poses")
        };
        let mut poses = rough.clone();
        row.put_into(&disturbed, &mut poses)?;
        let mut refined = self.material.at_poses(&disturbed, &poses)?;
        let dropped: Vec<bool> = row.sources.iter().map(|s| s.dropped.is_some()).collect();
        let mut used = dropped.iter().map(|dropped| !dropped);
        refined.retain(|_| used.next().unwrap_or(true));
        let exact = self.material.at_poses(&disturbed, &self.material.true_poses())?;
        let sets = [(SETS[1], disturbed), (SETS[2], refined), (SETS[4], exact)];
        let mut all = vec![];
        let mut progress = Progress::new("objects", self.material.meshes.len());
        let ids: Vec<u32> = self.material.meshes.keys().copied().collect();
        for object in ids {
            all.extend(self.views_of(object, &sets)?);
            progress.step(format!("object {object}"));
        }
        progress.finish();
        Ok(all)
    }

    fn views_of(&self, object: u32, sets: &[(&'static str, Vec<Source>)]) -> Result<Vec<ViewRow>> {
        let targets = self.material.targets_of(object)?;
        let mut count = BTreeMap::new();
        let keys: Vec<String> = targets
            .iter()
            .map(|((scene_id, im_id), _)| {
                let number = count.entry((*scene_id, *im_id)).and_modify(|n| *n += 1).or_insert(0);
                format!("view-{object}-{scene_id}-{im_id}-{number}")
            })
            .collect();
        let kept = |key: &String| self.a.out.join("rows").join(format!("{key}.json")).is_file();
        let mesh = &self.material.meshes[&object];
        let coarse: Mesh = views::coarse(mesh, 500)?;
        let rough: Mesh = views::rough(mesh, 0.001, self.a.seed)?;
        let mut ways: Vec<Way<'_>> = vec![];
        // Encoding is slow, and not needed if all rows exist.
        if !keys.iter().all(kept) {
            let of = |sources: &[Source]| -> Vec<PosedImage> {
                sources.iter().filter(|s| s.object == object).map(|s| s.photograph.clone()).collect()
            };
            for (set, sources) in sets {
                ways.extend(views::ways(set, mesh, &of(sources), self.networks(), SIDE, false));
            }
            ways.extend(views::ways(SETS[3], mesh, &of(&sets[1].1), self.networks(), SIDE, true));
            let exact = of(&sets[2].1);
            for (set, mesh) in [(SETS[5], &coarse), (SETS[6], &rough)] {
                ways.extend(views::ways(set, mesh, &exact, self.networks(), SIDE, false));
            }
        }
        let mut rows = vec![];
        let mut image_written = false;
        for (key, (frame, photograph)) in keys.iter().zip(&targets) {
            check_interrupt(RESUME_HINT)?;
            let row = kept_or_made(&self.a.out, key, || {
                let target = Target { key, frame: *frame, object, photograph, mesh, side: SIDE };
                let (row, pictures) = views::compare(&target, &ways, &self.judge)?;
                if !image_written {
                    self.strips.keep(&row, &pictures)?;
                }
                Ok(row)
            })?;
            image_written |= !row.cells.is_empty();
            rows.push(row);
        }
        Ok(rows)
    }

    fn networks(&self) -> &Networks {
        &self.networks
    }

    /// One image per part.
    fn sheets(&self, views: &[ViewRow], lamps: &[ViewRow]) -> Result<()> {
        self.strips.sheet(&self.a.out.join("views.png"), views, &SETS[..5])?;
        self.strips.sheet(&self.a.out.join("geometry.png"), views, &SETS[4..7])?;
        self.strips.sheet(&self.a.out.join("lamps.png"), lamps, &[views::MODEL, lamps::SET])
    }
}
