//! Arguments of `sixfold estimate`: the options that all methods share, and those of the chosen method (`methods.rs`).

use std::num::NonZeroUsize;
use std::path::PathBuf;

use clap::builder::NonEmptyStringValueParser;
use clap::error::ErrorKind;
use clap::parser::ValueSource;
use clap::{ArgMatches, Args, Command, FromArgMatches};
use sixfold_estimator::{Cache, ObjectStore, check_min_confidence};
use sixfold_mesh::Unit;
use sixfold_runner::RunOptions;
use sixfold_shell::output::JsonArguments;
use sixfold_shell::ranges::{self, count};

use super::methods::{METHODS, Method};
use super::networks::objects_file;

pub(crate) const AFTER_HELP: &str = "Examples:\n  \
    sixfold estimate --depth d.png --rgb c.png --camera camera.json --object mug.ply --unit mm --out out\n  \
    sixfold estimate --method pix2pose --weights model.safetensors --rgb c.png --camera camera.json --object mug.ply --unit mm --box 210,140,90,120 --out out\n  \
    sixfold estimate --method auto --depth d.png --rgb c.png --camera camera.json --object mug box can --out out\n  \
    sixfold estimate --method mttm --depth d.png --camera camera.json --object mug --out out\n  \
    sixfold estimate --dataset lmo --split test --out results.csv\n  \
    sixfold estimate --method pix2pose --weights model.safetensors --dataset lmo --boxes gt --out results.csv";

/// The folder of stored objects.
#[derive(Debug, Args)]
pub(crate) struct StoreArguments {
    /// Folder of stored objects
    #[arg(long, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
}

impl StoreArguments {
    pub fn store(&self) -> ObjectStore {
        ObjectStore::new(&self.store)
    }
}

/// Where what methods derive from mesh files is kept.
#[derive(Debug, Args)]
pub(crate) struct CacheArguments {
    /// Cache folder for data computed from mesh files and datasets, at most 1 GB (default: sixfold in the user's cache folder,
    /// ~/.cache)
    #[arg(long, value_name = "DIR", env = "SIXFOLD_CACHE")]
    pub cache: Option<PathBuf>,
    /// Do not use the cache
    #[arg(long)]
    pub no_cache: bool,
}

impl CacheArguments {
    pub fn cache(&self) -> Cache {
        match &self.cache {
            _ if self.no_cache => Cache::none(),
            Some(folder) => Cache::new(folder, Cache::LIMIT),
            None => Cache::of_user(),
        }
    }
}

/// The options of a single image. Options of a dataset conflict with them explicitly: `clap` does not check a required option that
/// conflicts with a given one, so options of a dataset would otherwise be ignored.
const OF_ONE_IMAGE: [&str; 6] = ["depth", "camera", "objects", "object_id", "mask", "region"];

/// Options that belong to no method.
#[derive(Debug, Args)]
pub(crate) struct CommonArguments {
    /// Colour image to search in, or for the overlay
    #[arg(long, value_name = "FILE", requires = "camera", conflicts_with = "dataset")]
    pub rgb: Option<PathBuf>,
    /// Depth image: PNG, one channel of 16 bits
    #[arg(long, value_name = "FILE", requires = "camera", conflicts_with = "dataset")]
    pub depth: Option<PathBuf>,
    /// Camera: a file of BOP, OpenCV or ROS (docs/cameras.md), and depth_scale (millimetres per unit of the depth image)
    #[arg(long, value_name = "FILE", conflicts_with = "dataset")]
    pub camera: Option<PathBuf>,
    /// Millimetres per unit of the depth image, in place of the camera file's depth_scale
    #[arg(long, value_name = "MM", value_parser = ranges::depth_scale, conflicts_with = "dataset")]
    pub depth_scale: Option<f64>,
    /// Objects to search for: mesh files, or names given with `sixfold object add`
    #[arg(long = "object", value_name = "NAME_OR_MESH", num_args = 1.., conflicts_with = "dataset")]
    pub objects: Vec<String>,
    /// Unit of mesh files: m, cm, mm, in (not needed for stored objects)
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<Unit>,
    /// Object to search for, by its id in the trained network or detector (default: its only object)
    #[arg(long, value_name = "ID", conflicts_with = "dataset")]
    pub object_id: Option<u32>,
    /// Search only in this mask (PNG, above zero inside)
    #[arg(long, value_name = "FILE", conflicts_with = "dataset")]
    pub mask: Option<PathBuf>,
    /// Search only in this box, pixels
    #[arg(
        long = "box",
        value_name = "X,Y,W,H",
        value_delimiter = ',',
        allow_hyphen_values = true,
        conflicts_with = "dataset"
    )]
    pub region: Option<Vec<f64>>,
    /// Maximum number of instances of each object (in a dataset: as in its targets)
    #[arg(long, value_name = "N", default_value = "1", value_parser = count::<1000>)]
    pub instances: NonZeroUsize,
    /// BOP dataset folder: estimate all its targets
    #[arg(long, value_name = "DIR", requires = "out")]
    pub dataset: Option<PathBuf>,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Folder of the dataset's models, such as models_cad or models_reconst of T-LESS (default: models, or models_eval without it)
    #[arg(long, value_name = "FOLDER", requires = "dataset", conflicts_with_all = OF_ONE_IMAGE, value_parser = ranges::folder_name)]
    pub models: Option<String>,
    /// Targets file of the dataset, or all: every annotated pose that is at least 10 % visible (default: its
    /// test_targets_bop19.json, or all without it)
    #[arg(long, value_name = "FILE|all", requires = "dataset", conflicts_with_all = OF_ONE_IMAGE)]
    pub targets: Option<PathBuf>,
    /// Objects of the dataset to search for (default: all targets)
    #[arg(long, value_name = "ID", value_delimiter = ',', requires = "dataset", conflicts_with_all = OF_ONE_IMAGE)]
    pub ids: Vec<u32>,
    /// Leave out these frames of the dataset, such as those used for training: JSON, [{"scene_id": 2, "im_id": 36}, ...]
    #[arg(long, value_name = "FILE", requires = "dataset", conflicts_with_all = OF_ONE_IMAGE)]
    pub except: Option<PathBuf>,
    /// Boxes to search in: gt (ground truth), detect (from --detector), or a file of COCO detections (default: detect with
    /// --detector, else the whole image)
    #[arg(long, value_name = "gt|detect|FILE", requires = "dataset", conflicts_with_all = OF_ONE_IMAGE, value_parser = NonEmptyStringValueParser::new())]
    pub boxes: Option<String>,
    /// Trained detector that provides the boxes: a file that `sixfold train detector` wrote, or torchvision's weights, as for
    /// `sixfold detect`
    #[arg(long, value_name = "FILE")]
    pub detector: Option<PathBuf>,
    /// Result: a CSV file in the BOP format for a dataset, a folder for one image
    #[arg(long, value_name = "PATH")]
    pub out: Option<PathBuf>,
    /// Folder for overlays of a dataset's images
    #[arg(long, value_name = "DIR", requires = "dataset", conflicts_with_all = OF_ONE_IMAGE)]
    pub overlays: Option<PathBuf>,
    /// Leave out poses with a lower confidence, 0 to 1 (default: 0.25 for one image and 0.05 for a dataset with --method ppf, 0.45
    /// and 0.05 with mttm, 0.4 and 0 with views, 0 with pix2pose; with auto the probability that
    /// the pose or one of its alternatives is right, 0.5 and 0)
    #[arg(long, value_name = "SCORE", value_parser = min_score)]
    pub min_score: Option<f64>,
    /// Seed of all random numbers
    #[arg(long, default_value = "0")]
    pub seed: u64,
    #[command(flatten)]
    pub store: StoreArguments,
    #[command(flatten)]
    pub cache: CacheArguments,
    #[command(flatten)]
    pub json: JsonArguments,
}

/// A number that can be a minimum confidence.
fn min_score(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|error| format!("{error}"))?;
    check_min_confidence(value).map(|()| value).map_err(|error| format!("expected {}", error.expected))
}

/// The options of `sixfold estimate`, of which a method's own are accepted for that method only.
#[derive(Debug)]
pub(crate) struct EstimateArguments {
    pub common: CommonArguments,
    pub method: &'static Method,
    matches: ArgMatches,
}

/// Options about where results are written, which do not influence the results.
const NOT_OF_RESULTS: [&str; 7] = ["out", "overlays", "json", "store", "cache", "no_cache", "object_id"];

impl EstimateArguments {
    /// The values that were given for the method's own options.
    pub fn of_method(&self) -> &ArgMatches {
        &self.matches
    }

    /// All options on which the results depend, by name.
    pub fn run_options(&self) -> RunOptions {
        let mut options = RunOptions::default();
        let common = CommonArguments::augment_args(Command::new("common"));
        let ids = common
            .get_arguments()
            .chain(&self.method.arguments())
            .map(|a| a.get_id().to_string())
            .collect::<Vec<_>>();
        for id in ids.iter().filter(|id| !NOT_OF_RESULTS.contains(&id.as_str())) {
            if let Ok(Some(values)) = self.matches.try_get_raw(id) {
                let values: Vec<_> = values.map(|v| v.to_string_lossy()).collect();
                options.add(&id.replace('_', "-"), &values.join(","));
            }
        }
        if let Some(file) = self.common.detector.as_deref().and_then(objects_file) {
            options.add("objects of the detector", &file.to_string_lossy());
        }
        options
    }
}

impl Args for EstimateArguments {
    fn augment_args(command: Command) -> Command {
        let names: Vec<&str> = METHODS.iter().map(|m| m.name).collect();
        let about: Vec<String> = METHODS.iter().map(|m| format!("{}: {}", m.name, m.about)).collect();
        let method = clap::Arg::new("method")
            .long("method")
            .value_name("NAME")
            .value_parser(names)
            .default_value(METHODS[0].name)
            .help(format!("How poses are found. {}", about.join(". ")));
        let mut command = CommonArguments::augment_args(command.arg(method));
        for method in METHODS {
            for argument in method.arguments() {
                let users: Vec<&str> =
                    METHODS.iter().filter(|m| m.has(argument.get_id())).map(|m| m.name).collect();
                if users.first() == Some(&method.name) {
                    let heading = format!("Options of --method {}", users.join(" and "));
                    command = command.arg(argument.help_heading(clap::builder::Str::from(heading)));
                }
            }
        }
        command
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for EstimateArguments {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let name = matches.get_one::<String>("method").map_or("", String::as_str);
        let method = METHODS.iter().find(|m| m.name == name).unwrap_or(&METHODS[0]);
        for other in METHODS {
            for argument in other.arguments() {
                let id = argument.get_id();
                let given = matches.value_source(id.as_str()) == Some(ValueSource::CommandLine);
                if given && !method.has(id) {
                    let users: Vec<&str> = METHODS.iter().filter(|m| m.has(id)).map(|m| m.name).collect();
                    let option = argument.get_long().unwrap_or(id.as_str());
                    let text = format!(
                        "--{option} is no option of --method {}, but of --method {}\n",
                        method.name,
                        users.join(" and ")
                    );
                    return Err(clap::Error::raw(ErrorKind::UnknownArgument, text));
                }
            }
        }
        let common = CommonArguments::from_arg_matches(matches)?;
        Ok(EstimateArguments { common, method, matches: matches.clone() })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}
