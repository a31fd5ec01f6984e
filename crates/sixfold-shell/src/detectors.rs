//! Detection of objects by their views: the objects that a command names, and the detector of them.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::{Context, Result, bail};
use sixfold_bop::{BopDataset, Models};
use sixfold_detect::detector::TrainedDetector;
use sixfold_estimator::{Cache, Object, ObjectStore, PoseEstimator};
use sixfold_mesh::Unit;
use sixfold_runner::dataset_object;
use sixfold_views::detector::{ViewsDetectOptions, ViewsDetector};
use sixfold_views::estimator::ViewsEstimator;

use crate::progress::Progress;

/// Objects by the numbers under which they are reported.
pub struct NumberedObjects(BTreeMap<u32, Object>);

impl NumberedObjects {
    /// The ids of a dataset's objects: all that its `models_info.json` lists, or `wanted`.
    ///
    /// # Errors
    /// When the dataset has no `models_info.json` and `wanted` is empty.
    pub fn ids_in(dataset: &BopDataset, wanted: &[u32]) -> Result<Vec<u32>> {
        match (wanted, dataset.models_info(Models::Rendering)?) {
            ([], None) => bail!(
                "{}: expected models/models_info.json, which lists the objects to detect; found none: name some with --ids",
                dataset.root().display()
            ),
            ([], Some(infos)) => Ok(infos.0.keys().copied().collect()),
            (wanted, _) => Ok(wanted.to_vec()),
        }
    }

    /// These objects of a dataset.
    ///
    /// # Errors
    /// When a model is missing or broken.
    pub fn of_dataset(dataset: &BopDataset, ids: &[u32], cache: &Cache) -> Result<NumberedObjects> {
        let infos = dataset.models_info(Models::Rendering)?;
        let object = |id: &u32| Ok((*id, dataset_object(dataset, *id, infos.as_ref(), cache)?));
        Ok(NumberedObjects(ids.iter().map(object).collect::<Result<_>>()?))
    }

    /// Mesh files and stored objects, numbered from 1 in the order of their names.
    ///
    /// # Errors
    /// When there is no such object, or it cannot be read.
    pub fn of_names(
        names: &[String],
        unit: Option<Unit>,
        store: &ObjectStore,
        cache: &Cache,
    ) -> Result<NumberedObjects> {
        let mut objects = BTreeMap::new();
        for (id, name) in (1..).zip(names) {
            let (object, note) = store.find(name, unit, cache)?;
            if let Some(note) = note {
                eprintln!("note: {note}");
            }
            objects.insert(id, object);
        }
        Ok(NumberedObjects(objects))
    }

    /// Their names; those that several objects have, with the number behind.
    pub fn names(&self) -> BTreeMap<u32, String> {
        let shared = |name: &String| self.0.values().filter(|object| object.name == *name).count() > 1;
        let name = |(id, object): (&u32, &Object)| {
            let name = &object.name;
            (*id, if shared(name) { format!("{name} {id}") } else { name.clone() })
        };
        self.0.iter().map(name).collect()
    }

    /// Shows the progress over the objects that a detector searches in one image ([`ViewsDetector::searched`]); the bar disappears with the last one.
    pub fn progress(&self) -> Box<dyn Fn(u32) + Send + Sync> {
        let names = self.names();
        let progress = Mutex::new(Some(Progress::new("objects", names.len())));
        let last = names.keys().next_back().copied();
        Box::new(move |id| {
            let mut progress = progress.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(progress) = progress.as_mut() {
                progress.step(names.get(&id).cloned().unwrap_or_default());
            }
            if Some(id) == last
                && let Some(progress) = progress.take()
            {
                progress.finish();
            }
        })
    }

    /// A detector of them by their views, which are rendered first unless they are kept in the cache.
    ///
    /// # Errors
    /// When an object cannot be rendered.
    pub fn detector(&self, options: ViewsDetectOptions) -> Result<ViewsDetector> {
        let estimator = ViewsEstimator::shipped().context("the network within the program")?;
        let proposals = TrainedDetector::proposals().context("the detector within the program")?;
        let proposals = proposals.with_masks(options.masks && !options.poses);
        let mut progress = Progress::new("objects rendered", self.0.len());
        let mut prepared = BTreeMap::new();
        for (id, object) in &self.0 {
            let one = estimator.prepare(object)?;
            one.notes().iter().for_each(|note| eprintln!("note: {note}"));
            prepared.insert(*id, one);
            progress.step(object.name.clone());
        }
        progress.finish();
        let mut detector = ViewsDetector::new(estimator, Arc::new(proposals), prepared);
        detector.options = options;
        Ok(detector)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn objects_of_one_name_are_told_apart() {
        let object = |name: &str| Object { name: name.to_owned(), ..Object::of_model(None) };
        let objects = BTreeMap::from([(1, object("mesh")), (2, object("mug")), (3, object("mesh"))]);
        let names = NumberedObjects(objects).names();
        assert_eq!(names.into_values().collect::<Vec<_>>(), ["mesh 1", "mug", "mesh 3"]);
    }
}
