//! Arguments of `sixfold synthesize`.

use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use serde_json::{Value, json};
use sixfold_nol::refine::{PoseRefinementOptions, SceneKind};
use sixfold_nol::view_grid::ViewGrid;
use sixfold_shell::new_views::{ChosenBy, Refinement};
use sixfold_shell::output::JsonArguments;
use sixfold_shell::ranges::{self, in_range, without_duplicates};

/// How colours of several photographs become one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum WeightingKind {
    /// The network of NOL
    Network,
    /// All photographs with the same weight
    Average,
    /// The photograph that sees the surface most directly
    Best,
}

/// Whether objects moved between photographs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum SceneArgument {
    /// Decided by how well the given poses agree with one static arrangement
    Judge,
    /// Only the camera moved
    Still,
    /// Objects may have moved
    Moving,
}

/// By what photographs are chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum SelectKind {
    /// Those that add the most surface
    Surface,
    /// At random, no two with poses nearer than 0.3 m and 45 degrees
    Pose,
}

/// How poses are refined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum RefinementKind {
    /// All photographs together, on points of the surface
    Ours,
    /// Each photograph against a rendering from the others (equation 4.3)
    Published,
}

/// Which form of the method runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Preset {
    /// As in the dissertation
    #[value(alias = "paper")]
    Published,
}

#[derive(Debug, Args)]
pub(crate) struct SynthesizeArguments {
    /// BOP dataset folder with models and posed images
    #[arg(long, value_name = "DIR", required_unless_present = "photographs")]
    pub dataset: Option<PathBuf>,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Folder of the dataset's models, such as models_cad or models_reconst of T-LESS (default: models, or models_eval without it)
    #[arg(long, value_name = "FOLDER", requires = "dataset", conflicts_with = "photographs", value_parser = ranges::folder_name)]
    pub models: Option<String>,
    /// Frames of the split to use as photographs: JSON, [{"scene_id": 2, "im_id": 36}, ...] (default: all)
    #[arg(long, value_name = "FILE", requires = "dataset", conflicts_with = "photographs")]
    pub frames: Option<PathBuf>,
    /// Object ids of the dataset (default: all)
    #[arg(
        long,
        value_name = "ID",
        value_delimiter = ',',
        requires = "dataset",
        conflicts_with = "photographs"
    )]
    pub ids: Vec<u32>,
    /// In place of a dataset: a JSON file that names a mesh and its photographs (see below)
    #[arg(long, value_name = "FILE.json", conflicts_with = "dataset")]
    pub photographs: Option<PathBuf>,
    /// Folder for the new dataset, the refined poses and the images
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Name of the new dataset's split
    #[arg(long, value_name = "NAME", default_value = "train_nol", value_parser = ranges::folder_name)]
    pub new_split: String,
    /// Make views as the dissertation describes it: --select pose, --refinement published, --rotations 7 (docs/coverage.md)
    #[arg(long, value_name = "NAME", value_enum)]
    pub preset: Option<Preset>,
    /// How photographs are chosen (default: surface; with --preset published: pose)
    #[arg(long, value_name = "BY", value_enum)]
    pub select: Option<SelectKind>,
    /// Maximum number of photographs of an object
    #[arg(long, value_name = "N", default_value = "16")]
    pub sources: usize,
    /// Number of photographs used for each new view
    #[arg(long, value_name = "N", default_value = "6")]
    pub per_view: usize,
    /// Minimum visible fraction of the object; other photographs are left out
    #[arg(long, value_name = "FRACTION", default_value = "0.5")]
    pub min_visible: f64,
    /// Trained detector that makes masks for photographs without masks (default: masks rendered from the poses, without occlusion)
    #[arg(long, value_name = "FILE.safetensors")]
    pub detector: Option<PathBuf>,
    /// How the colours of several photographs are combined
    #[arg(long, value_enum, default_value = "network")]
    pub weighting: WeightingKind,
    /// NOL network to use instead of the built-in one
    #[arg(long, value_name = "FILE.safetensors")]
    pub weights: Option<PathBuf>,
    /// Do not refine the poses
    #[arg(long)]
    pub no_refine: bool,
    /// How poses are refined (default: ours; with --preset published: published)
    #[arg(long, value_name = "HOW", value_enum, conflicts_with = "no_refine")]
    pub refinement: Option<RefinementKind>,
    /// Whether objects moved between the photographs
    #[arg(long, value_enum, default_value = "judge")]
    pub scene: SceneArgument,
    /// Error of the given poses: standard deviation in millimetres along each axis and degrees about each
    #[arg(long, value_name = "MM,DEGREES", value_delimiter = ',', default_values_t = [6.0, 1.7])]
    pub rough: Vec<f64>,
    /// For experiments: disturb the given poses by at most these millimetres along and degrees about each axis
    #[arg(long, value_name = "MM,DEGREES", value_delimiter = ',')]
    pub disturb: Vec<f64>,
    /// Degrees between views, in azimuth and elevation
    #[arg(long, value_name = "DEGREES", default_value = "5")]
    pub step: f64,
    /// Elevation of the camera over the object's xy plane, lowest and highest, degrees
    #[arg(long, value_name = "LOW,HIGH", value_delimiter = ',', default_values_t = [0.0, 85.0], allow_hyphen_values = true)]
    pub elevation: Vec<f64>,
    /// Images of each view, each with another in-plane rotation (up to 45 degrees) (default: 1; with --preset
    /// published: 7, every 15 degrees)
    #[arg(long, alias = "turns", value_name = "N")]
    pub rotations: Option<usize>,
    /// Side of the new images in pixels
    #[arg(long, value_name = "PIXELS", default_value = "192")]
    pub size: usize,
    /// Folder of photographs for backgrounds (default: procedural textures)
    #[arg(long, value_name = "DIR")]
    pub backgrounds: Option<PathBuf>,
    /// Also put the photographs, cropped to the object, into the new dataset
    #[arg(long)]
    pub with_photographs: bool,
    /// Seed of rotations, distances, backgrounds and disturbances
    #[arg(long, default_value = "0")]
    pub seed: u64,
    #[command(flatten)]
    pub json: JsonArguments,
}

/// Shown under `sixfold synthesize --help`.
pub(crate) const AFTER_HELP: &str = "Examples:\n  \
    sixfold synthesize --dataset lmo --frames frames.json --out out/nol\n  \
    sixfold synthesize --photographs mug/photographs.json --out out/mug\n  \
    sixfold train pix2pose --dataset out/nol --split train_nol --render-fraction 0 --out out/mug-model\n\n\
    A file for --photographs (paths are relative to it; poses as in BOP, object to camera, millimetres; mask may be left out):\n  \
    {\"mesh\": \"mug.ply\", \"unit\": \"mm\", \"photographs\": [{\"image\": \"1.png\", \"camera\": \"camera.json\",\n    \
    \"cam_R_m2c\": [1,0,0, 0,1,0, 0,0,1], \"cam_t_m2c\": [0, 0, 600], \"mask\": \"1-mask.png\"}]}\n\n\
    After a stop, the same command resumes.";

impl SynthesizeArguments {
    /// Checks every option that is a number.
    pub fn check(&self) -> Result<()> {
        for (option, values) in
            [("--elevation", &self.elevation), ("--rough", &self.rough), ("--disturb", &self.disturb)]
        {
            if values.len() != 2 && !(values.is_empty() && option == "--disturb") {
                bail!("{option}: found {}, expected two numbers with a comma between them", values.len());
            }
        }
        if !(1.0..=90.0).contains(&self.step) {
            bail!("--step: found {}, expected degrees from 1 to 90", self.step);
        }
        let [low, high] = [self.elevation[0], self.elevation[1]];
        if !(-90.0 <= low && low <= high && high <= 90.0) {
            bail!(
                "--elevation: found {low},{high}, expected two angles from -90 to 90 degrees, the lower one first"
            );
        }
        if !(1..=72).contains(&self.rotations()) {
            bail!("--rotations: found {}, expected 1 to 72", self.rotations());
        }
        in_range(
            "views of an object by --step, --elevation and --rotations",
            self.grid().count(),
            1..=200_000,
        )?;
        if !(32..=1024).contains(&self.size) {
            bail!("--size: found {}, expected 32 to 1024 pixels", self.size);
        }
        in_range("--sources", self.sources, 1..=1000)?;
        in_range("--per-view", self.per_view, 1..=1000)?;
        in_range("--min-visible", self.min_visible, 0.0..=1.0)?;
        without_duplicates("--ids", &self.ids)?;
        if self.weights.is_some() && self.weighting != WeightingKind::Network {
            bail!("--weights belongs to --weighting network");
        }
        if !self.rough.iter().all(|v| *v > 0.0 && *v <= 1000.0) {
            bail!("--rough: found {:?}, expected millimetres and degrees above 0, at most 1000", self.rough);
        }
        self.disturb_reach()?;
        Ok(())
    }

    /// The largest disturbance of poses, metres and radians.
    pub fn disturb_reach(&self) -> Result<Option<[f64; 2]>> {
        match self.disturb.as_slice() {
            [] => Ok(None),
            [mm, degrees] if [mm, degrees].iter().all(|v| (0.0..=1000.0).contains(*v)) => {
                Ok(Some([mm * 1e-3, degrees.to_radians()]))
            }
            other => bail!("--disturb: found {other:?}, expected millimetres and degrees, 0 to 1000"),
        }
    }

    /// Images of each view.
    fn rotations(&self) -> usize {
        self.rotations.unwrap_or(if self.preset.is_some() { 7 } else { 1 })
    }

    /// The criterion by which photographs are chosen.
    fn select(&self) -> SelectKind {
        self.select.unwrap_or(if self.preset.is_some() { SelectKind::Pose } else { SelectKind::Surface })
    }

    /// The same for the library.
    pub fn chosen_by(&self) -> ChosenBy {
        match self.select() {
            SelectKind::Surface => ChosenBy::Surface,
            SelectKind::Pose => ChosenBy::Pose(self.seed),
        }
    }

    /// The kind of pose refinement.
    fn refinement_kind(&self) -> RefinementKind {
        let default = if self.preset.is_some() { RefinementKind::Published } else { RefinementKind::Ours };
        self.refinement.unwrap_or(default)
    }

    /// The viewpoints of the views.
    pub fn grid(&self) -> ViewGrid {
        let (step, elevation) = (self.step, [self.elevation[0], self.elevation[1]]);
        ViewGrid { step, elevation, rotations: self.rotations(), size: self.size, seed: self.seed }
    }

    /// How poses are refined.
    pub fn refinement(&self) -> Refinement {
        let scene = match self.scene {
            SceneArgument::Judge => SceneKind::Judge,
            SceneArgument::Still => SceneKind::Still,
            SceneArgument::Moving => SceneKind::Moving,
        };
        let rough = [self.rough[0] * 1e-3, self.rough[1].to_radians()];
        match self.refinement_kind() {
            _ if self.no_refine => Refinement::Given,
            RefinementKind::Published => Refinement::Published,
            RefinementKind::Ours => {
                let seed = self.seed;
                Refinement::Ours(PoseRefinementOptions { scene, rough, seed, ..Default::default() })
            }
        }
    }

    /// The options on which the result depends; a folder made with others is not resumed.
    pub fn deciding(&self) -> Value {
        json!({
            "version": env!("CARGO_PKG_VERSION"),
            "dataset": self.dataset, "split": self.split, "models": self.models, "frames": self.frames, "ids": self.ids,
            "photographs": self.photographs, "new_split": self.new_split, "sources": self.sources,
            "per_view": self.per_view, "min_visible": self.min_visible,
            "weighting": format!("{:?}", self.weighting), "weights": self.weights,
            "detector": self.detector, "no_refine": self.no_refine, "scene": format!("{:?}", self.scene),
            "rough": self.rough, "disturb": self.disturb, "step": self.step, "elevation": self.elevation,
            "rotations": self.rotations(), "select": format!("{:?}", self.select()),
            "refinement": format!("{:?}", self.refinement_kind()), "size": self.size, "backgrounds": self.backgrounds,
            "with_photographs": self.with_photographs, "preset": self.preset.is_some(), "seed": self.seed,
        })
    }
}
