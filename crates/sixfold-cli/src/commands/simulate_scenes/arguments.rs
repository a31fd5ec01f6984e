//! Arguments of `sixfold simulate-scenes`, and their checks.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use clap::Args;
use serde_json::{Value, json};
use sixfold_mesh::Unit;
use sixfold_simulation::{PileOptions, TabletopOptions};
use sixfold_synth::shapes::Family;

use crate::commands::simulate::Sensor;
use sixfold_shell::folder::Contents;
use sixfold_shell::objects::find;
use sixfold_shell::output::JsonArguments;
use sixfold_shell::ranges::{folder_name, in_range, without_duplicates};
use sixfold_shell::scenes::NamedModels;

/// Maximum number of synthetic objects of a kind: each is kept in memory with its mesh.
const MAX_OBJECTS: usize = 10_000;

/// Shown under `sixfold simulate-scenes --help`.
pub(crate) const AFTER_HELP: &str = "Examples:\n  \
    sixfold simulate-scenes --object mug.ply drill.ply --unit mm --scenes 5 --out out/scenes\n  \
    sixfold simulate-scenes --families can,mug --toys 40 --scenes 100 --views 10 --out out/toys\n  \
    sixfold simulate-scenes --dataset lmo --sensor xtion --out out/lmo-scenes\n  \
    sixfold simulate-scenes --families all --backgrounds photographs --out out/colour\n\n\
    The folder is a BOP dataset, for `sixfold estimate --dataset` and `sixfold eval`. preview.png shows its first scenes.\n\
    After a stop, the same command resumes.";

#[derive(Debug, Args)]
pub(crate) struct SimulateScenesArguments {
    /// Objects: mesh files, or names given with `sixfold object add`
    #[arg(long = "object", value_name = "NAME_OR_MESH", num_args = 1..)]
    pub objects: Vec<String>,
    /// Unit of mesh files: m, cm, mm, in (not needed for stored objects)
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<Unit>,
    /// Folder of stored objects
    #[arg(long, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
    /// BOP dataset folder: its models, which keep their ids
    #[arg(long, value_name = "DIR")]
    pub dataset: Option<PathBuf>,
    /// Object ids of the dataset (default: all)
    #[arg(long, value_name = "ID", value_delimiter = ',', requires = "dataset")]
    pub ids: Vec<u32>,
    /// Synthetic household objects: all, or some of can, mug, cup, bottle, bowl, box, clamp, drill
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub families: Vec<String>,
    /// Synthetic objects of each family
    #[arg(long, value_name = "N", default_value = "1", requires = "families")]
    pub members: usize,
    /// Synthetic objects of no family: figures, machine parts and heaps of solids
    #[arg(long, value_name = "N", default_value = "0")]
    pub toys: usize,
    /// Scenes: each drops other objects
    #[arg(long, value_name = "N", default_value = "10")]
    pub scenes: usize,
    /// Images of each scene
    #[arg(long, value_name = "N", default_value = "4")]
    pub views: usize,
    /// Number of objects in a scene, minimum and maximum; no object twice if there are enough
    #[arg(long, value_name = "LOW,HIGH", value_delimiter = ',', default_values_t = [6, 10])]
    pub objects_per_scene: Vec<usize>,
    /// Objects are dropped over a disc of this radius, metres
    #[arg(long, value_name = "METRES", default_value = "0.18")]
    pub radius: f64,
    /// Fraction of the objects that start upright, the z axis of their mesh up; the others fall in any orientation
    #[arg(long, value_name = "FRACTION", default_value = "0.5")]
    pub upright: f64,
    /// Fraction of the objects that may fall on others; the rest fall on a free place
    #[arg(long, value_name = "FRACTION", default_value = "0.4")]
    pub stacked: f64,
    /// Collide with the exact shape, hollows included, instead of the convex hull; takes seconds per object
    #[arg(long)]
    pub exact: bool,
    /// Distance of the camera from the objects, smallest and largest, metres
    #[arg(long, value_name = "LOW,HIGH", value_delimiter = ',', default_values_t = [0.6, 1.2])]
    pub distance: Vec<f64>,
    /// Elevation of the camera over the plane, lowest and highest, degrees
    #[arg(long, value_name = "LOW,HIGH", value_delimiter = ',', default_values_t = [20.0, 80.0], allow_hyphen_values = true)]
    pub elevation: Vec<f64>,
    /// Depth camera
    #[arg(long, value_enum, default_value = "kinect")]
    pub sensor: Sensor,
    /// Camera file (default: 640x480, focal length 575 pixels, as a Kinect)
    #[arg(long, value_name = "FILE")]
    pub camera: Option<PathBuf>,
    /// Folder of photographs (PNG, JPEG), shown in the colour images wherever no object is (default: the plane and black)
    #[arg(long, value_name = "DIR", conflicts_with = "no_rgb")]
    pub backgrounds: Option<PathBuf>,
    /// Leave out the colour images (and the preview, which is made of them)
    #[arg(long)]
    pub no_rgb: bool,
    /// Write no masks, which are most of the files; poses, boxes and visibility are still written
    #[arg(long)]
    pub no_masks: bool,
    /// New dataset folder
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Name of the new dataset's split
    #[arg(long, value_name = "NAME", default_value = "test", value_parser = folder_name)]
    pub split: String,
    /// Seed of objects, poses, cameras and noise
    #[arg(long, default_value = "0")]
    pub seed: u64,
    #[command(flatten)]
    pub json: JsonArguments,
}

impl SimulateScenesArguments {
    /// Checks every option that is a number or a name.
    pub fn check(&self) -> Result<()> {
        if self.objects.is_empty() && self.dataset.is_none() && self.families.is_empty() && self.toys == 0 {
            bail!(
                "no objects: give --object MESH, --dataset DIR, --families all or --toys N (or several of them)"
            );
        }
        let pairs = [
            ("--objects-per-scene", self.objects_per_scene.len()),
            ("--distance", self.distance.len()),
            ("--elevation", self.elevation.len()),
        ];
        for (option, found) in pairs {
            if found != 2 {
                bail!("{option}: found {found} numbers, expected two with a comma between them");
            }
        }
        let counts = [
            ("--scenes", self.scenes, 1..=1_000_000),
            ("--views", self.views, 1..=10_000),
            ("--members", self.members, 1..=MAX_OBJECTS),
            ("--toys", self.toys, 0..=MAX_OBJECTS),
        ];
        for (option, value, range) in counts {
            in_range(option, value, range)?;
        }
        without_duplicates("--ids", &self.ids)?;
        let [low, high] = [self.objects_per_scene[0], self.objects_per_scene[1]];
        if low < 1 || low > high || high > 100 {
            bail!(
                "--objects-per-scene: found {low},{high}, expected two numbers from 1 to 100, the lower one first"
            );
        }
        let [low, high] = [self.distance[0], self.distance[1]];
        if !(0.1 <= low && low <= high && high <= 6.0) {
            bail!(
                "--distance: found {low},{high}, expected two distances from 0.1 to 6 metres, the lower one first"
            );
        }
        let [low, high] = [self.elevation[0], self.elevation[1]];
        if !(1.0 <= low && low <= high && high <= 90.0) {
            bail!(
                "--elevation: found {low},{high}, expected two angles from 1 to 90 degrees, the lower one first"
            );
        }
        self.pile().check()?;
        self.chosen_families()?;
        Ok(())
    }

    /// How objects are dropped.
    pub fn pile(&self) -> PileOptions {
        PileOptions {
            radius: self.radius,
            reach: (self.radius + 0.13).min(0.9),
            upright: self.upright,
            stacked: self.stacked,
        }
    }

    /// All objects.
    pub fn models(&self) -> Result<NamedModels> {
        let mut models = match &self.dataset {
            Some(dataset) => NamedModels::of_dataset(dataset, &self.ids)?,
            None => NamedModels::default(),
        };
        for name in &self.objects {
            let object = find(name, self.unit, &self.store)?;
            models.add(object.name, object.mesh, object.info);
        }
        models.add_synthetic(&self.chosen_families()?, self.members, self.toys, self.seed)?;
        Ok(models)
    }

    /// Hashes of the inputs. Synthetic objects follow from the options.
    pub fn contents(&self, models: &NamedModels) -> Result<Contents> {
        let mut contents = Contents::default();
        if let Some(camera) = &self.camera {
            contents.add_path("camera", camera)?;
        }
        if let Some(folder) = &self.backgrounds {
            contents.add_path("backgrounds", folder)?;
        }
        let synthetic = self.chosen_families()?.len() * self.members + self.toys;
        for model in &models.0[..models.0.len() - synthetic] {
            contents.add_object(&format!("object {}", model.id), &model.mesh, &model.info);
        }
        Ok(contents)
    }

    /// The options of the scenes.
    pub fn tabletop(&self) -> TabletopOptions {
        TabletopOptions {
            objects: [self.objects_per_scene[0], self.objects_per_scene[1]],
            pile: self.pile(),
            distance: [self.distance[0], self.distance[1]],
            elevation_degrees: [self.elevation[0], self.elevation[1]],
            seed: self.seed,
        }
    }

    /// The families that --families names.
    pub fn chosen_families(&self) -> Result<Vec<Family>> {
        if self.families == ["all"] {
            return Ok(Family::ALL.to_vec());
        }
        let known = || Family::ALL.map(Family::name).join(", ");
        self.families
            .iter()
            .map(|name| match Family::ALL.into_iter().find(|f| f.name() == name) {
                Some(family) => Ok(family),
                None => bail!("--families: found {name:?}, expected all, or some of {}", known()),
            })
            .collect()
    }

    /// The options on which the result depends.
    pub fn deciding(&self) -> Value {
        let path = |path: &Path| path.display().to_string();
        json!({
            "version": env!("CARGO_PKG_VERSION"),
            "object": self.objects, "unit": self.unit.map(|u| u.to_string()), "store": path(&self.store),
            "dataset": self.dataset.as_deref().map(path), "ids": self.ids, "families": self.families,
            "members": self.members, "toys": self.toys, "scenes": self.scenes, "views": self.views,
            "objects-per-scene": self.objects_per_scene, "radius": self.radius, "upright": self.upright,
            "stacked": self.stacked, "exact": self.exact, "distance": self.distance,
            "elevation": self.elevation, "sensor": format!("{:?}", self.sensor),
            "camera": self.camera.as_deref().map(path), "no-rgb": self.no_rgb, "no-masks": self.no_masks,
            "backgrounds": self.backgrounds.as_deref().map(path), "split": self.split,
            "seed": self.seed,
        })
    }
}
