//! `sixfold simulate-depth`: simulated depth images for a dataset that has poses but no depth.

use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::{Args, ValueEnum};
use serde_json::{Value, json};
use sixfold_bop::{DepthSimulation, Models, SceneWriter, Target, write_camera, write_targets};
use sixfold_render::DepthSensor;

use sixfold_shell::Outcome;
use sixfold_shell::datasets;
use sixfold_shell::folder::{Contents, DatasetFolder, OutputFolder, copy_files};
use sixfold_shell::output::{JsonArguments, report};
use sixfold_shell::overlay;
use sixfold_shell::pictures::Pictures;
use sixfold_shell::progress::{Progress, check_interrupt};
use sixfold_shell::ranges::{folder_name, without_duplicates};

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
    /// Its noise; `None` for an ideal camera.
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
    #[arg(long, default_value = "test", value_parser = folder_name)]
    pub split: String,
    /// Folder of the dataset's models to render and copy, such as models_cad or models_reconst of T-LESS (default: models, or
    /// models_eval without it)
    #[arg(long, value_name = "FOLDER", value_parser = folder_name)]
    pub models: Option<String>,
    /// New dataset folder
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Depth camera
    #[arg(long, value_enum, default_value = "kinect")]
    pub sensor: Sensor,
    /// Copy the colour images too
    #[arg(long)]
    pub rgb: bool,
    /// Folder for images of ideal and simulated depth side by side
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

impl SimulateArguments {
    /// The options on which the result depends.
    fn deciding(&self) -> Value {
        json!({
            "dataset": self.dataset, "split": self.split, "sensor": format!("{:?}", self.sensor), "rgb": self.rgb,
            "models": self.models, "images": self.images, "no-table": self.no_table, "seed": self.seed,
        })
    }
}

pub(crate) fn run(a: &SimulateArguments) -> Result<Outcome> {
    without_duplicates("--images", &a.images)?;
    let dataset = datasets::open(&a.dataset, &a.split, a.models.as_deref())?;
    // Written last: if it is missing, a run was interrupted, and this one repeats everything.
    let targets_file = a.out.join("test_targets_bop19.json");
    if targets_file.exists() {
        bail!("{} exists already: remove it or choose another --out", a.out.join(&a.split).display());
    }
    let folder = DatasetFolder::take(&a.out, "simulate-depth", a.deciding(), &[&a.dataset])?;
    folder.begin(&Contents::default())?;
    let mut pictures = Pictures::of(a.pictures.as_deref().map(OutputFolder::take).transpose()?);
    let wanted = |im_id: u32| a.images.is_empty() || a.images.contains(&im_id);
    let (mut images, mut without_table, mut first_camera) = (0, vec![], None);
    let mut simulation = DepthSimulation::new(&dataset);
    simulation.sensor = a.sensor.model();
    (simulation.with_table, simulation.with_rgb, simulation.seed) = (!a.no_table, a.rgb, a.seed);
    for scene_id in dataset.scene_ids() {
        let scene = dataset.scene(scene_id)?;
        let ids: Vec<u32> = scene.image_ids().into_iter().filter(|i| wanted(*i)).collect();
        let mut writer = SceneWriter::new(&a.out, &a.split, scene_id);
        let mut progress = Progress::new("images", ids.len());
        for im_id in ids {
            check_interrupt("run the same command again to make all of it")?;
            let seen = simulation.image(&scene, im_id, &mut writer)?;
            if !seen.has_table && !a.no_table {
                without_table.push(format!("{scene_id}/{im_id}"));
            }
            if a.pictures.is_some() {
                let picture = overlay::side_by_side(&seen.ideal, &seen.measured);
                pictures.write(&format!("{scene_id:06}_{im_id:06}.png"), &picture);
            }
            if first_camera.is_none() {
                first_camera = Some(scene.camera(im_id)?);
            }
            images += 1;
            progress.step(format!("{scene_id}/{im_id}"));
        }
        progress.finish();
        writer.finish()?;
    }
    if let Some(camera) = first_camera {
        write_camera(&a.out, &camera, 1e-3)?;
    }
    if let Some(models) = dataset.models_dir(Models::Rendering) {
        copy_files(&models, &a.out.join("models"))?;
    }
    let targets: Vec<Target> = dataset.targets(None)?.into_iter().filter(|t| wanted(t.im_id)).collect();
    write_targets(&targets_file, &targets)?;
    for image in &without_table {
        eprintln!("note: image {image}: no plane found under its objects, simulated without a table");
    }
    let value = json!({ "images": images, "without_table": without_table, "out": a.out });
    report(&a.json, &value, || println!("{images} images with simulated depth in {}", a.out.display()))?;
    Ok(pictures.outcome(if images > 0 { Outcome::Found } else { Outcome::NothingFound }))
}
