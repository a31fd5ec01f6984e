//! Pix2Pose for one stored object, trained on new views that Neural Object Learning makes of its photographs, and kept with the
//! object: `sixfold teach --train`.

use std::path::Path;
use std::time::Instant;

use anyhow::{Context, Result, anyhow, bail};
use serde::{Deserialize, Serialize};
use serde_json::json;
use sixfold_bop::BopDataset;
use sixfold_data::{FrameSelection, PosedImage, RoughImageOptions, RoughImages, TrainingSet};
use sixfold_estimator::{Object, ObjectStore, StoreError};
use sixfold_nn::options::OptionError;
use sixfold_nn::weights::read_card;
use sixfold_nol::model::NolModel;
use sixfold_nol::synthesis::Weighting;
use sixfold_nol::view_grid::ViewGrid;
use sixfold_pix2pose::model::Pix2PoseModel;
use sixfold_pix2pose::own_weights::WEIGHTS_FILE;
use sixfold_pix2pose::recipe::{MIN_VISIBILITY, Pix2PoseRecipe};
use sixfold_teach::photographs_of;

use crate::folder::{Contents, DatasetFolder};
use crate::new_views::{ChosenBy, NewViews, Refinement, add_contents};
use crate::progress::Watch;
use crate::training::train_pix2pose;

/// Default number of training steps.
pub const STEPS: usize = 3000;
/// Default step between synthesized views in azimuth and elevation, degrees.
pub const VIEW_STEP: f64 = 10.0;
/// Images in a training step.
const IMAGES: usize = 8;
/// Fraction of renders of the mesh among them.
const RENDERS: f32 = 0.5;
/// The split of the synthesized views.
const SPLIT: &str = "train_nol";
/// Maximum number of photographs, and number used for each view.
const SOURCES: usize = 16;
const PER_VIEW: usize = 6;
/// Lowest and highest elevation of the views, degrees; and their side, pixels.
const ELEVATION: [f64; 2] = [0.0, 85.0];
const SIDE: usize = 192;
/// The field of the model's card in which a training of a stored object is recognised.
const FIELD: &str = "taught";

/// The training of a stored object.
#[derive(Debug, Clone, Copy)]
pub struct ObjectTraining<'a> {
    /// The store.
    pub store: &'a ObjectStore,
    /// Name of the object.
    pub name: &'a str,
    /// Training steps.
    pub steps: usize,
    /// Step between synthesized views in azimuth and elevation, degrees.
    pub view_step: f64,
    /// Replace weights that the object has.
    pub replace: bool,
    /// Folder for views, checkpoints and learning curves.
    pub out: &'a Path,
}

/// What an object's weights were trained on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainedOn {
    /// Number of images synthesized from the photographs.
    pub synthesized: usize,
    /// Number of photographs.
    pub photographs: usize,
    /// Step between synthesized views, degrees.
    pub view_step: f64,
}

/// How long each step took in the run that ended the training.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Seconds {
    /// Making views.
    pub views: f64,
    /// Training, with its preparation and measurement.
    pub training: f64,
}

/// An object with weights of its own.
#[derive(Debug, Serialize)]
pub struct TrainedObject {
    /// Their file, in the object's folder.
    pub weights: String,
    /// Training steps.
    pub steps: u64,
    /// What they were trained on.
    #[serde(flatten)]
    pub on: TrainedOn,
    /// `None` if an earlier run trained them.
    pub seconds: Option<Seconds>,
}

impl ObjectTraining<'_> {
    /// Makes views, trains, and stores the weights; each step resumes where an earlier run of the same training was stopped. Nothing
    /// is done for an object that has these weights.
    ///
    /// # Errors
    /// For an object that is not stored or has no photographs, weights of another training, and when `watch` stops it.
    pub fn run(&self, watch: &dyn Watch) -> Result<TrainedObject> {
        let name = self.name;
        let object = self.store.load(name).map_err(|error| match error {
            StoreError::Unknown { folder, there, .. } => anyhow!(
                "no object named {name:?} in {} ({there}): give --photographs DIR to teach it first",
                folder.display()
            ),
            error => error.into(),
        })?;
        if let Some(trained) = self.trained(&object)? {
            return Ok(trained);
        }
        let photographs = photographs_of(&object).ok_or_else(|| {
            anyhow!(
                "object {name}: is stored without photographs and poses, of which views could be made: teach it with `sixfold teach \
                 {name} --photographs DIR --replace`, or train on renders of its mesh with `sixfold train pix2pose --object {name}`"
            )
        })?;
        let (images, contents) = read(&object, &photographs)?;
        // Each record has its own folder: a training on other photographs or another mesh starts from the beginning.
        let out = self.out.join(format!("training-{:08x}", contents.value() as u32));
        let start = Instant::now();
        let views = out.join(format!("views-{}", self.view_step));
        self.make_views(&views, images, &contents, watch)?;
        let made = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let (material, [synthesized, photographs]) = material(name, &views, self.grid().count())?;
        let on = TrainedOn { synthesized, photographs, view_step: self.view_step };
        let recipe = Pix2PoseRecipe {
            steps: Some(self.steps as u64),
            per_object: Some(IMAGES),
            render_fraction: RENDERS,
            command: format!(
                "sixfold teach {name} --train --train-steps {} --view-step {}",
                self.steps, self.view_step
            ),
            ..Pix2PoseRecipe::default()
        };
        let out = out.join(format!("pix2pose-{}-{}", self.view_step, self.steps));
        let trained = train_pix2pose(&recipe, material, &out, false, watch, by_flag)?;
        let weights = self.keep(&object, &trained.model, &on)?;
        let seconds = Some(Seconds { views: made, training: start.elapsed().as_secs_f64() });
        Ok(TrainedObject { weights, steps: trained.steps, on, seconds })
    }

    /// The weights that the object has, if they are of the same training; an error if they are of another.
    fn trained(&self, object: &Object) -> Result<Option<TrainedObject>> {
        let Some(file) = object.file(WEIGHTS_FILE).filter(|file| file.exists() && !self.replace) else {
            return Ok(None);
        };
        let card = read_card(&file)?;
        let on: Option<TrainedOn> = serde_json::from_value(card.extra[FIELD].clone()).ok();
        match on.filter(|on| card.steps == self.steps as u64 && on.view_step == self.view_step) {
            Some(on) => {
                let weights = file.display().to_string();
                Ok(Some(TrainedObject { weights, steps: card.steps, on, seconds: None }))
            }
            None => bail!(
                "{}: weights of another training, of {} steps: give --replace to replace them, or the same --train-steps and \
                 --view-step to keep them",
                file.display(),
                card.steps
            ),
        }
    }

    fn grid(&self) -> ViewGrid {
        ViewGrid { step: self.view_step, elevation: ELEVATION, rotations: 1, size: SIDE, seed: 0 }
    }

    /// Makes the views that are not there yet. The poses are those of the record: the mesh was made with them.
    fn make_views(
        &self,
        views: &Path,
        images: RoughImages,
        contents: &Contents,
        watch: &dyn Watch,
    ) -> Result<()> {
        let options = json!({
            "version": env!("CARGO_PKG_VERSION"), "step": self.view_step, "elevation": ELEVATION, "size": SIDE,
            "sources": SOURCES, "per_view": PER_VIEW,
        });
        let folder = DatasetFolder::take(views, "teach", options, &[])?;
        folder.begin(contents)?;
        let network = NolModel::shipped()?;
        let new = NewViews {
            split: SPLIT,
            chosen_by: ChosenBy::Surface,
            sources: SOURCES,
            per_view: PER_VIEW,
            weighting: Weighting::Network(&network),
            refinement: Refinement::Given,
            disturbed: false,
            grid: self.grid(),
            backgrounds: None,
            with_photographs: true,
            compare_photographs: true,
        };
        let (summary, mut sheets) = new.make(&folder, images, watch)?;
        sheets.take_failed().iter().for_each(|text| watch.note(&format!("skipped {text}")));
        if summary.objects.is_empty() {
            bail!("object {}: none of its photographs can be used", self.name);
        }
        Ok(())
    }

    /// Adds to the card of a model what it was trained on, and copies it into the folder of the object, unless that was replaced by
    /// another one; returns the file.
    fn keep(&self, object: &Object, file: &Path, on: &TrainedOn) -> Result<String> {
        let mut model = Pix2PoseModel::load(file)?;
        model.card_mut().extra[FIELD] = serde_json::to_value(on)?;
        model.save(file)?;
        let bytes = std::fs::read(file).with_context(|| file.display().to_string())?;
        let mut kept = String::new();
        let hash = |object: &Object| object.mesh.as_ref().map(|mesh| mesh.contents_hash());
        self.store.extend(self.name, |now| {
            let file = now.file(WEIGHTS_FILE).filter(|_| hash(now) == hash(object));
            let file = file.ok_or("it was replaced by another object while it was trained")?;
            kept = file.display().to_string();
            Ok(sixfold_io::write_atomically(&file, &bytes)?)
        })?;
        Ok(kept)
    }
}

/// The photographs of an object, and the hashes of all that views depend on.
fn read(object: &Object, photographs: &Path) -> Result<(RoughImages, Contents)> {
    let options = RoughImageOptions { min_visibility: 0.0, disturb: None, seed: 0, detect: None };
    let mut images = RoughImages::of_file(photographs, 1, &options)?;
    for of_file in &mut images.objects {
        // The record's symmetries.
        of_file.info = object.info.clone().context("the object has no mesh")?;
    }
    let mut contents = Contents::default();
    add_contents(&mut contents, &images);
    Ok((images, contents))
}

/// What is trained on, and the numbers of views and of photographs in it: the images whose number is below `views` are views.
fn material(name: &str, dataset: &Path, views: usize) -> Result<(TrainingSet, [usize; 2])> {
    let dataset = BopDataset::open(dataset, SPLIT)?;
    let material = TrainingSet::of_opened(&dataset, &[], &FrameSelection::All, MIN_VISIBILITY)?;
    let is_view = |image: &&PosedImage| image.frame().is_some_and(|frame| (frame.im_id as usize) < views);
    let synthesized = material.images.iter().filter(is_view).count();
    let photographs = material.images.len() - synthesized;
    let description = format!(
        "object {name}: {synthesized} views synthesized from its photographs, {photographs} photographs, and renders of its mesh"
    );
    // The frames are those of the views, not of a dataset on which the weights could be tested.
    Ok((TrainingSet { frames: vec![], description, ..material }, [synthesized, photographs]))
}

fn by_flag(error: &OptionError) -> anyhow::Error {
    match error.field {
        "steps" => anyhow!("--train-steps: found {}, expected {}", error.found, error.expected),
        _ => anyhow!("{error}"),
    }
}

impl TrainedObject {
    /// Prints it for people.
    pub fn print(&self) {
        let TrainedOn { synthesized, photographs, .. } = &self.on;
        match &self.seconds {
            None => println!("trained before, {} steps: {}", self.steps, self.weights),
            Some(seconds) => println!(
                "trained {} steps on {synthesized} views, made in {:.0} s, and {photographs} photographs in {:.0} s: {}",
                self.steps, seconds.views, seconds.training, self.weights
            ),
        }
    }
}
