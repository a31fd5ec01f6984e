//! The command line, defined once: parsing, `--help` and completions all come from here.

use std::num::NonZeroUsize;
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use sixfold_mesh::Unit;
use sixfold_render::DepthSensor;

use crate::commands::grasp::arguments::GraspArguments;
use crate::commands::mttm::arguments::{DepthViewArguments, Matcher, ReproduceMttmArguments, TemplateViews};
use crate::commands::reproduce::nol::arguments::{AFTER_HELP as NOL_HELP, ReproduceNolArguments};
use crate::commands::train::TrainDetectorArguments;
pub(crate) use crate::commands::train::TrainPix2PoseArguments;

/// 6D object pose and grasp transfer from little data.
#[derive(Debug, Parser)]
#[command(
    name = "sixfold",
    version,
    after_help = "Example:\n  sixfold demo\n\nExit status: 0 found, 1 nothing found, 2 error."
)]
pub(crate) struct Arguments {
    /// Use this many threads (default: all cores); the results are the same for any number
    #[arg(long, global = true, value_name = "N")]
    pub threads: Option<NonZeroUsize>,
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Estimate poses in the sample frames of this repository, score them and draw them
    #[command(after_help = "Example:\n  sixfold demo --out out/demo")]
    Demo(DemoArguments),
    /// Estimate the 6D pose of known objects, in one image or in a whole dataset
    #[command(after_help = "Examples:\n  \
        sixfold estimate --depth d.png --rgb c.png --camera camera.json --object mug.ply --unit mm --out out\n  \
        sixfold estimate --method pix2pose --weights model.safetensors --rgb c.png --camera camera.json --object mug.ply --unit mm --box 210,140,90,120 --out out\n  \
        sixfold estimate --method mttm --depth d.png --camera camera.json --object mug --out out\n  \
        sixfold estimate --dataset lmo --split test --out results.csv\n  \
        sixfold estimate --method pix2pose --weights model.safetensors --dataset lmo --boxes gt --out results.csv")]
    Estimate(Box<EstimateArguments>),
    /// Detect objects in colour images: boxes and masks, for `sixfold estimate` or any COCO tool
    #[command(after_help = "Examples:\n  \
        sixfold detect --weights detector.safetensors --rgb c.png --out out\n  \
        sixfold detect --weights detector.safetensors --dataset lmo --out detections.json")]
    Detect(Box<DetectArguments>),
    /// Score a result file against the ground truth of a BOP dataset
    #[command(
        after_help = "Example:\n  sixfold eval --dataset lmo --results results.csv --curves curves.png"
    )]
    Eval(EvalArguments),
    /// Grasps of a parallel-jaw gripper: propose them from depth, try them in simulation
    #[command(
        after_help = "Example:\n  sixfold grasp propose --depth d.png --camera camera.json --mask mask.png --out out"
    )]
    Grasp(GraspArguments),
    /// Render an object: depth, mask, normals, object coordinates, colour
    #[command(
        after_help = "Example:\n  sixfold render --object mug.ply --unit mm --camera camera.json --pose 0,0,0.6,0.5,0,0 --out out/mug"
    )]
    Render(RenderArguments),
    /// Write a dataset with simulated depth images, rendered from ground-truth poses on a table
    #[command(
        name = "simulate-depth",
        after_help = "Example:\n  sixfold simulate-depth --dataset lmo --split test --out lmo-simulated"
    )]
    SimulateDepth(SimulateArguments),
    /// Drop objects on a plane and write images of them from all around as a BOP dataset with ground truth
    #[cfg(feature = "physics")]
    #[command(
        name = "simulate-scenes",
        after_help = crate::commands::simulate_scenes::arguments::AFTER_HELP
    )]
    SimulateScenes(Box<crate::commands::simulate_scenes::arguments::SimulateScenesArguments>),
    /// Make a training set of new views from at most sixteen cluttered photographs with rough poses
    #[command(after_help = crate::commands::synthesize::arguments::AFTER_HELP)]
    Synthesize(Box<crate::commands::synthesize::arguments::SynthesizeArguments>),
    /// Train a network on a few posed photographs and renders
    #[command(
        after_help = "Example:\n  sixfold train pix2pose --dataset lmo --frames frames.json --out out/lmo"
    )]
    Train(TrainArguments),
    /// Measure a method on a dataset as its paper does, with its ablations: one table from one command
    #[command(
        after_help = "Example:\n  sixfold reproduce pix2pose --dataset lmo --frames frames.json --weights model.safetensors --out out/reproduce"
    )]
    Reproduce(ReproduceArguments),
    /// Keep objects under a name: add, list, show, remove
    #[command(after_help = "Example:\n  sixfold object add mug mug.ply --unit mm")]
    Object(ObjectArguments),
    /// Print shell completions
    #[command(
        after_help = "Example:\n  sixfold completions bash > ~/.local/share/bash-completion/completions/sixfold"
    )]
    Completions(CompletionsArguments),
}

/// `--json`: to the screen, or to a file.
#[derive(Debug, Default, Args, Clone)]
pub(crate) struct JsonArguments {
    /// Print the result as JSON, or write it to FILE and keep the table
    #[arg(long, global = true, value_name = "FILE", num_args = 0..=1)]
    json: Option<Option<PathBuf>>,
}

impl JsonArguments {
    /// Whether JSON replaces the table on the screen.
    pub fn on_screen(&self) -> bool {
        matches!(self.json, Some(None))
    }

    /// The file JSON goes to.
    pub fn file(&self) -> Option<&PathBuf> {
        self.json.as_ref().and_then(Option::as_ref)
    }
}

#[derive(Debug, Args)]
pub(crate) struct DemoArguments {
    /// Folder for results and pictures
    #[arg(long, default_value = "out/demo", value_name = "DIR")]
    pub out: PathBuf,
    /// Folder of the sample data (default: data/demo of this repository)
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Weights for poses from colour (default: weights/pix2pose-lmo.safetensors of this repository)
    #[arg(long, value_name = "FILE.safetensors")]
    pub weights: Option<PathBuf>,
    /// Weights of the detector (default: weights/detector-lmo.safetensors of this repository)
    #[arg(long, value_name = "FILE.safetensors")]
    pub detector: Option<PathBuf>,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Method {
    /// Point pair features on depth, no training
    Ppf,
    /// Object coordinates from colour by a trained network, in boxes
    Pix2pose,
    /// Templates in depth, from a mesh or from depth images of the object, no training
    Mttm,
}

impl Method {
    /// As it is typed.
    pub fn name(self) -> &'static str {
        match self {
            Method::Ppf => "ppf",
            Method::Pix2pose => "pix2pose",
            Method::Mttm => "mttm",
        }
    }
}

#[derive(Debug, Args)]
pub(crate) struct EstimateArguments {
    /// How poses are found
    #[arg(long, value_enum, default_value = "ppf")]
    pub method: Method,
    /// Trained model for --method pix2pose: a file that `sixfold train pix2pose` wrote; for --method mttm another network than
    /// that within the program
    #[arg(long, value_name = "FILE.safetensors")]
    pub weights: Option<PathBuf>,
    /// Leave out the last step of --method pix2pose, which aligns the rendered mesh with the image
    #[arg(long)]
    pub no_refine: bool,
    /// Most looks of --method pix2pose at an object: each but the first is into the box of the pose before, which helps where
    /// boxes are poor and takes as long again (default: 1)
    #[arg(long, value_name = "N")]
    pub looks: Option<NonZeroUsize>,
    /// Which of the model's objects --method pix2pose looks for in one image (default: its only one)
    #[arg(long, value_name = "ID", conflicts_with = "dataset")]
    pub object_id: Option<u32>,
    /// Align the poses of --method pix2pose with the depth image (ICP)
    #[arg(long)]
    pub icp: bool,
    /// Who matches regions with templates in --method mttm
    #[arg(long, value_enum, default_value = "both")]
    pub matcher: Matcher,
    /// Judge the poses of --method mttm by its templates alone, as if there were no mesh
    #[arg(long)]
    pub templates_only: bool,
    /// Colour image: what pix2pose works on, else for the overlay
    #[arg(long, value_name = "FILE", requires = "camera")]
    pub rgb: Option<PathBuf>,
    /// Depth image: PNG, one channel of 16 bits
    #[arg(long, value_name = "FILE", requires = "camera", conflicts_with = "dataset")]
    pub depth: Option<PathBuf>,
    /// Camera: a JSON file with fx fy cx cy or cam_K, and depth_scale (millimetres per unit of the depth image)
    #[arg(long, value_name = "FILE", conflicts_with = "dataset")]
    pub camera: Option<PathBuf>,
    /// Millimetres per unit of the depth image, in place of the camera file's depth_scale
    #[arg(long, value_name = "MM")]
    pub depth_scale: Option<f64>,
    /// Objects to look for: mesh files, or names given with `sixfold object add`
    #[arg(long = "object", value_name = "NAME_OR_MESH", num_args = 1.., conflicts_with = "dataset")]
    pub objects: Vec<String>,
    /// Unit of mesh files: m, cm, mm, in (meshes in the store know theirs)
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<Unit>,
    /// The object lies in this mask (PNG, above zero inside)
    #[arg(long, value_name = "FILE", conflicts_with = "dataset")]
    pub mask: Option<PathBuf>,
    /// The object lies in this box, in pixels
    #[arg(
        long = "box",
        value_name = "X,Y,W,H",
        value_delimiter = ',',
        allow_hyphen_values = true,
        conflicts_with = "dataset"
    )]
    pub region: Option<Vec<f64>>,
    /// Most instances of each object (in a dataset: what its targets say)
    #[arg(long, value_name = "N", default_value = "1")]
    pub instances: NonZeroUsize,
    /// BOP dataset folder: estimate all its targets
    #[arg(long, value_name = "DIR", requires = "out")]
    pub dataset: Option<PathBuf>,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Targets file of the dataset (default: its test_targets_bop19.json, or all ground truth)
    #[arg(long, value_name = "FILE", requires = "dataset")]
    pub targets: Option<PathBuf>,
    /// Leave out these frames of the dataset, such as those of a training: JSON, [{"scene_id": 2, "im_id": 36}, ...]
    #[arg(long, value_name = "FILE", requires = "dataset")]
    pub except: Option<PathBuf>,
    /// Where the objects are: gt for the ground truth's boxes, detect for those of --detector, or a file of COCO
    /// detections (default: detect with --detector, else anywhere)
    #[arg(long, value_name = "gt|detect|FILE", requires = "dataset")]
    pub boxes: Option<String>,
    /// Trained detector that says where the objects are: a file that `sixfold train detector` wrote
    #[arg(long, value_name = "FILE.safetensors")]
    pub detector: Option<PathBuf>,
    /// Result: a CSV file in the BOP format for a dataset, a folder for one image
    #[arg(long, value_name = "PATH")]
    pub out: Option<PathBuf>,
    /// Folder for overlay pictures of a dataset's images
    #[arg(long, value_name = "DIR", requires = "dataset")]
    pub overlays: Option<PathBuf>,
    /// Leave out poses with a lower confidence, 0 to 1 (default: 0.25 for one image, 0.05 for a dataset, 0
    /// with --method pix2pose, 0.45 for one image with --method mttm)
    #[arg(long, value_name = "SCORE")]
    pub min_score: Option<f64>,
    /// Match points on the table plane too
    #[arg(long)]
    pub keep_plane: bool,
    /// Folder of stored objects
    #[arg(long, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
    /// Seed of everything random
    #[arg(long, default_value = "0")]
    pub seed: u64,
    #[command(flatten)]
    pub json: JsonArguments,
}

impl EstimateArguments {
    /// Whether poses from colour are aligned with the image.
    pub fn refines(&self) -> bool {
        self.method == Method::Pix2pose && !self.no_refine
    }
}

#[derive(Debug, Args)]
pub(crate) struct EvalArguments {
    /// BOP dataset folder
    #[arg(long, value_name = "DIR")]
    pub dataset: PathBuf,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Targets file (default: the dataset's test_targets_bop19.json, or all ground truth)
    #[arg(long, value_name = "FILE")]
    pub targets: Option<PathBuf>,
    /// Results in the BOP CSV format
    #[arg(long, value_name = "FILE.csv", required_unless_present = "detections")]
    pub results: Option<PathBuf>,
    /// COCO detections to score by box AP (and mask AP where they have masks)
    #[arg(long, value_name = "FILE.json", conflicts_with = "results")]
    pub detections: Option<PathBuf>,
    /// Leave out these frames, such as those of a training: JSON, [{"scene_id": 2, "im_id": 36}, ...]
    #[arg(long, value_name = "FILE")]
    pub except: Option<PathBuf>,
    /// With --detections: score from which on detections count for recall and false detections, 0 to 1
    #[arg(long, value_name = "SCORE", default_value = "0.4")]
    pub min_score: f64,
    /// With --detections: write the ground truth that they were scored with as a COCO file
    #[arg(long, value_name = "FILE.json", requires = "detections")]
    pub write_truth: Option<PathBuf>,
    /// Also score as 6D detection (BOP'24: AP of MSSD and MSPD)
    #[arg(long)]
    pub detection_ap: bool,
    /// Skip broken rows of the result file, report them and score the rest (exit status 2)
    #[arg(long)]
    pub lenient: bool,
    /// Leave out VSD, which renders every pose
    #[arg(long)]
    pub no_vsd: bool,
    /// Picture of the recall curves
    #[arg(long, value_name = "FILE.png")]
    pub curves: Option<PathBuf>,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[derive(Debug, Args)]
pub(crate) struct RenderArguments {
    /// Mesh file or name of a stored object
    #[arg(long, value_name = "NAME_OR_MESH")]
    pub object: String,
    /// Unit of the mesh file: m, cm, mm, in
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<Unit>,
    /// Camera file (default: 640x480, 60 degrees wide)
    #[arg(long, value_name = "FILE")]
    pub camera: Option<PathBuf>,
    /// Pose camera_from_object: tx,ty,tz,rx,ry,rz (metres, rotation vector in radians) or 16 numbers of a 4x4 matrix
    /// row by row (default: fills the picture, seen from above)
    #[arg(long, value_name = "NUMBERS", value_delimiter = ',', allow_hyphen_values = true)]
    pub pose: Option<Vec<f64>>,
    /// Folder for the pictures
    #[arg(long, value_name = "DIR", default_value = "out/render")]
    pub out: PathBuf,
    /// Folder of stored objects
    #[arg(long, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Sensor {
    /// Noise, quantisation and losses of a Kinect-class camera (Nguyen et al. 2012)
    Kinect,
    /// The same with the projector's shadow and the growth of the noise with the surface's angle
    Xtion,
    /// An active stereo camera of the RealSense D400 class
    Realsense,
    /// No noise
    #[value(alias = "none")]
    Ideal,
}

impl Sensor {
    /// Its noise; none for an ideal camera.
    pub fn model(self) -> Option<DepthSensor> {
        match self {
            Sensor::Ideal => None,
            Sensor::Kinect => Some(DepthSensor::kinect()),
            Sensor::Xtion => Some(DepthSensor::xtion()),
            Sensor::Realsense => Some(DepthSensor::realsense()),
        }
    }
}

#[derive(Debug, Args)]
pub(crate) struct SimulateArguments {
    /// BOP dataset folder with ground truth
    #[arg(long, value_name = "DIR")]
    pub dataset: PathBuf,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// New dataset folder
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Depth camera
    #[arg(long, value_enum, default_value = "kinect")]
    pub sensor: Sensor,
    /// Copy the colour images too
    #[arg(long)]
    pub rgb: bool,
    /// Folder for pictures of ideal and simulated depth side by side
    #[arg(long, value_name = "DIR")]
    pub pictures: Option<PathBuf>,
    /// Simulate only these image ids
    #[arg(long, value_name = "ID", value_delimiter = ',')]
    pub images: Vec<u32>,
    /// Leave out the table
    #[arg(long)]
    pub no_table: bool,
    /// Seed of the noise
    #[arg(long, default_value = "0")]
    pub seed: u64,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[derive(Debug, Args)]
pub(crate) struct TrainArguments {
    #[command(subcommand)]
    pub command: TrainCommand,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[derive(Debug, Subcommand)]
pub(crate) enum TrainCommand {
    /// Per-pixel object coordinates from RGB: poses with `sixfold estimate --method pix2pose`
    #[command(after_help = "Examples:\n  \
        sixfold train pix2pose --dataset lmo --frames frames.json --out out/lmo\n  \
        sixfold train pix2pose --object mug.ply --unit mm --out out/mug\n\n\
        Interrupted, it goes on when the same command is given again.")]
    Pix2pose(Box<TrainPix2PoseArguments>),
    /// Boxes and masks of objects in colour images: `sixfold detect`, `sixfold estimate --detector`
    #[command(after_help = "Examples:\n  \
        sixfold train detector --dataset lmo --frames frames.json --backgrounds photographs --out out/detector\n  \
        sixfold train detector --object mug.ply --unit mm --out out/mug-detector\n\n\
        Interrupted, it goes on when the same command is given again.")]
    Detector(Box<TrainDetectorArguments>),
    /// Train the network that transfers grasps from experience, on made-up objects
    #[cfg(feature = "experience")]
    #[command(after_help = "Example:\n  sixfold train dgcm --out out/dgcm\n\n\
        Stopped, the same command goes on.")]
    Dgcm(Box<crate::commands::train::TrainDgcmArguments>),
    /// Train the network that finds objects by their templates in depth, on made-up objects
    #[cfg(feature = "physics")]
    #[command(after_help = "Example:\n  sixfold train mttm --out out/mttm\n\n\
        Stopped, the same command goes on.")]
    Mttm(Box<crate::commands::train::TrainMttmArguments>),
    /// Train the network that renders new views of an object from few photographs, on made-up objects
    #[command(after_help = "Example:\n  sixfold train nol --backgrounds photographs --out out/nol\n\n\
        Stopped, the same command goes on.")]
    Nol(Box<crate::commands::train::TrainNolArguments>),
}

#[derive(Debug, Args)]
pub(crate) struct DetectArguments {
    /// Trained detector: a file that `sixfold train detector` wrote
    #[arg(long, value_name = "FILE.safetensors")]
    pub weights: PathBuf,
    /// Colour images: PNG or JPEG of any size, grey or colour
    #[arg(long, value_name = "FILE", num_args = 1.., required_unless_present = "dataset", conflicts_with = "dataset")]
    pub rgb: Vec<PathBuf>,
    /// BOP dataset folder: detect in the images of its targets
    #[arg(long, value_name = "DIR", requires = "out")]
    pub dataset: Option<PathBuf>,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Targets file that says which images (default: its test_targets_bop19.json, or all images)
    #[arg(long, value_name = "FILE", requires = "dataset")]
    pub targets: Option<PathBuf>,
    /// Leave out these frames of the dataset, such as those of the training: JSON, [{"scene_id": 2, "im_id": 36}, ...]
    #[arg(long, value_name = "FILE", requires = "dataset")]
    pub except: Option<PathBuf>,
    /// Result: a JSON file of COCO detections for a dataset, a folder for images
    #[arg(long, value_name = "PATH")]
    pub out: Option<PathBuf>,
    /// Folder for overlay pictures of a dataset's images
    #[arg(long, value_name = "DIR", requires = "dataset")]
    pub overlays: Option<PathBuf>,
    /// Only these of the detector's objects (default: all)
    #[arg(long, value_name = "ID", value_delimiter = ',')]
    pub ids: Vec<u32>,
    /// Leave out detections with a lower score, 0 to 1 (default: the model's; 0.02 with --dataset, as average precision
    /// wants it)
    #[arg(long, value_name = "SCORE")]
    pub threshold: Option<f32>,
    /// Of two boxes of an object that overlap more than this (intersection over union), leave the worse one out
    #[arg(long, value_name = "SHARE", default_value = "0.5")]
    pub overlap: f32,
    /// Most detections of each object in an image, the best ones
    #[arg(long, value_name = "N", default_value = "100")]
    pub per_object: usize,
    /// Most detections in an image, the best ones
    #[arg(long, value_name = "N", default_value = "100")]
    pub most: usize,
    /// Boxes only
    #[arg(long)]
    pub no_masks: bool,
    #[command(flatten)]
    pub json: JsonArguments,
}

/// What a training learns from.
#[derive(Debug, Args)]
pub(crate) struct MaterialArguments {
    /// BOP dataset folder with models and posed photographs
    #[arg(long, value_name = "DIR")]
    pub dataset: Option<PathBuf>,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Which frames of the split are photographs to learn from: JSON, [{"scene_id": 2, "im_id": 36}, ...] (default: all)
    #[arg(long, value_name = "FILE", requires = "dataset")]
    pub frames: Option<PathBuf>,
    /// Open no photograph, learn from renders of the dataset's models alone
    #[arg(long, requires = "dataset", conflicts_with = "frames")]
    pub renders_only: bool,
    /// Object ids of the dataset (default: all)
    #[arg(long, value_name = "ID", value_delimiter = ',', requires = "dataset")]
    pub ids: Vec<u32>,
    /// Objects to learn from renders: mesh files, or names given with `sixfold object add`; they get the ids 1, 2, ...
    #[arg(long = "object", value_name = "NAME_OR_MESH", num_args = 1.., conflicts_with = "dataset")]
    pub objects: Vec<String>,
    /// Unit of mesh files: m, cm, mm, in (meshes in the store know theirs)
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<Unit>,
    /// Folder of photographs for backgrounds (default: made-up textures)
    #[arg(long, value_name = "DIR")]
    pub backgrounds: Option<PathBuf>,
    /// Folder of stored objects
    #[arg(long, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
}

#[derive(Debug, Args)]
pub(crate) struct ReproduceArguments {
    #[command(subcommand)]
    pub command: ReproduceCommand,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[derive(Debug, Subcommand)]
pub(crate) enum ReproduceCommand {
    /// Recall and AR of Pix2Pose per object, what each part of the method is worth, and times
    #[command(after_help = "Example:\n  \
        sixfold reproduce pix2pose --dataset lmo --frames frames.json --weights model.safetensors --published lmo/published/cnos-fastsam-megapose_lmo-test.csv --out out/reproduce\n\n\
        Every row is kept; interrupted, it goes on when the same command is given again.")]
    Pix2pose(Box<ReproducePix2PoseArguments>),
    /// Masks and poses of template matching per object, with its ablations, point pair features, and times
    #[command(after_help = "Example:\n  \
        sixfold reproduce mttm --dataset lmo-simulated --out out/reproduce-mttm\n\n\
        Every image is kept; interrupted, it goes on when the same command is given again.")]
    Mttm(ReproduceMttmArguments),
    /// Poses and views of Neural Object Learning beside truth and real pixels, wrong meshes, another lamp, and times
    #[command(after_help = NOL_HELP)]
    Nol(ReproduceNolArguments),
    /// Grasps from experience: table 6.2, figure 6.7, learning from nothing, handles
    #[cfg(all(feature = "physics", feature = "experience"))]
    #[command(after_help = "Example:\n  \
        sixfold reproduce dgcm --list benches/grasp-objects.json --meshes DIR --out out/reproduce-dgcm\n\n\
        Every part is kept; interrupted, it goes on when the same command is given again.")]
    Dgcm(Box<crate::commands::grasp::reproduce::ReproduceDgcmArguments>),
}

#[derive(Debug, Args)]
pub(crate) struct ReproducePix2PoseArguments {
    /// BOP dataset folder with ground truth
    #[arg(long, value_name = "DIR")]
    pub dataset: PathBuf,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Frames that the model was trained on, which are left out: JSON as for `sixfold train pix2pose`
    #[arg(long, value_name = "FILE")]
    pub frames: PathBuf,
    /// Trained model
    #[arg(long, value_name = "FILE.safetensors")]
    pub weights: PathBuf,
    /// Folder for the table, its JSON, and the rows done so far
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Also with the boxes of these files of COCO detections; may be given several times
    #[arg(long, value_name = "FILE.json")]
    pub detections: Vec<PathBuf>,
    /// Score these published results (BOP's CSV) on the same targets, for comparison
    #[arg(long, value_name = "FILE.csv")]
    pub published: Option<PathBuf>,
    /// Every eighth frame only
    #[arg(long)]
    pub quick: bool,
    /// Also train the networks of the training ablations (hours)
    #[arg(long)]
    pub train: bool,
    /// Steps of these trainings
    #[arg(long, value_name = "N", default_value = "1500", requires = "train")]
    pub steps: u64,
    /// Side of these networks' input in pixels
    #[arg(long, value_name = "PIXELS", default_value = "96", requires = "train")]
    pub size: usize,
    /// Folder of photographs for the backgrounds of these trainings (default: made-up textures)
    #[arg(long, value_name = "DIR", requires = "train")]
    pub backgrounds: Option<PathBuf>,
    /// Seed of the boxes' noise, of RANSAC and of the trainings
    #[arg(long, default_value = "0")]
    pub seed: u64,
}

#[derive(Debug, Args)]
pub(crate) struct ObjectArguments {
    /// Folder of stored objects
    #[arg(long, global = true, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
    #[command(subcommand)]
    pub command: ObjectCommand,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[derive(Debug, Subcommand)]
pub(crate) enum ObjectCommand {
    /// Store a mesh under a name, or an object seen in depth images
    #[command(after_help = "Examples:\n  \
        sixfold object add mug mug.ply --unit mm --turns-about z --templates\n  \
        sixfold object add mug --depth d.png --mask mask.png --camera camera.json")]
    Add {
        /// Name: letters, digits, - and _
        name: String,
        /// Mesh file: PLY, OBJ, STL, glTF, GLB
        #[arg(required_unless_present = "depth")]
        mesh: Option<PathBuf>,
        /// Unit of the mesh file: m, cm, mm, in
        #[arg(long, value_name = "UNIT", required_unless_present = "depth")]
        unit: Option<Unit>,
        /// Also make the mesh's templates for `estimate --method mttm`, from these sides
        #[arg(long, value_enum, value_name = "VIEWS", num_args = 0..=1, default_missing_value = "above", conflicts_with = "depth")]
        templates: Option<TemplateViews>,
        #[command(flatten)]
        views: DepthViewArguments,
        /// BOP models_info.json to take the symmetries from
        #[arg(long, value_name = "FILE", requires = "model_id")]
        models_info: Option<PathBuf>,
        /// Object id in models_info.json
        #[arg(long, value_name = "ID")]
        model_id: Option<u32>,
        /// The object may turn freely about this axis of its own frame: x, y or z
        #[arg(long, value_name = "AXIS", conflicts_with = "models_info")]
        turns_about: Option<Axis>,
        /// Replace an object of the same name
        #[arg(long)]
        replace: bool,
    },
    /// List the stored objects
    #[command(after_help = "Example:\n  sixfold object list")]
    List,
    /// Show one object, and draw it
    #[command(after_help = "Example:\n  sixfold object show mug --picture mug.png")]
    Show {
        /// Its name
        name: String,
        /// Picture to write
        #[arg(long, value_name = "FILE.png")]
        picture: Option<PathBuf>,
    },
    /// Remove one object
    #[command(after_help = "Example:\n  sixfold object remove mug")]
    Remove {
        /// Its name
        name: String,
    },
}

/// An axis of an object's own frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Axis {
    X,
    Y,
    Z,
}

#[derive(Debug, Args)]
pub(crate) struct CompletionsArguments {
    /// Which shell
    #[arg(value_enum)]
    pub shell: clap_complete::Shell,
}
