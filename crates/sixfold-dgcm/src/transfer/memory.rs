//! Experiences in memory: the index of all features, and recently retrieved experiences.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use sixfold_experience::{Attempt, ExperienceStore, FeatureIndex, Match, StoreError, Stored, Summary};

use crate::model::DgcmModel;
use crate::outcome::OutcomeModel;

/// Experiences of one store for one network.
pub struct Memory {
    store: Box<dyn ExperienceStore + Send>,
    index: FeatureIndex,
    /// Summaries of the experiences by number, for filtering.
    labels: HashMap<i64, Summary>,
    kept: HashMap<i64, Arc<Stored>>,
    attempts: Vec<Attempt>,
    /// Number of the last attempt read.
    last_attempt: i64,
    /// Outcome models fitted to the attempts, by gripper.
    outcomes: HashMap<String, OutcomeModel>,
    /// Errors of rows that are left out and were not yet reported.
    left_out: Vec<StoreError>,
    /// Experiences that are left out.
    broken: HashSet<i64>,
}

impl Memory {
    /// All experiences of a store that can be used with a model.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn new(store: Box<dyn ExperienceStore + Send>, model: &DgcmModel) -> Result<Memory, StoreError> {
        let mut memory = Memory {
            store,
            index: FeatureIndex::new(&model.fingerprint()),
            labels: HashMap::new(),
            kept: HashMap::new(),
            attempts: vec![],
            last_attempt: 0,
            outcomes: HashMap::new(),
            left_out: vec![],
            broken: HashSet::new(),
        };
        memory.refresh()?;
        Ok(memory)
    }

    /// Applies what others have stored and removed.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn refresh(&mut self) -> Result<(), StoreError> {
        self.index.refresh(&*self.store)?;
        for id in self.index.take_unusable() {
            let found = "something else".to_owned();
            self.leave_out(
                id,
                StoreError::Field { id, field: "feature", expected: "256 finite numbers", found },
            );
        }
        self.labels = self.store.list()?.into_iter().map(|s| (s.id, s)).collect();
        self.kept.retain(|id, _| self.labels.contains_key(id));
        for (id, attempt) in self.store.attempt_rows(self.last_attempt)? {
            self.last_attempt = id;
            match attempt {
                Ok(attempt) => {
                    self.attempts.push(attempt);
                    self.outcomes.clear();
                }
                Err(error) => self.left_out.push(error),
            }
        }
        Ok(())
    }

    /// Errors of experiences and attempts that were left out since the last call, for the user.
    pub fn take_left_out(&mut self) -> Vec<StoreError> {
        std::mem::take(&mut self.left_out)
    }

    fn leave_out(&mut self, id: i64, error: StoreError) {
        if self.broken.insert(id) {
            self.left_out.push(error);
        }
    }

    /// The outcome model fitted to the attempts with a gripper.
    pub fn outcomes(&mut self, gripper: &str) -> OutcomeModel {
        let attempts = &self.attempts;
        let learn = || OutcomeModel::learn(attempts, gripper);
        self.outcomes.entry(gripper.to_owned()).or_insert_with(learn).clone()
    }

    /// The store.
    pub fn store(&mut self) -> &mut dyn ExperienceStore {
        &mut *self.store
    }

    /// The index of features.
    pub fn index(&self) -> &FeatureIndex {
        &self.index
    }

    /// Number of experiences, including those of other networks.
    pub fn len(&self) -> usize {
        self.labels.len()
    }

    /// Whether there are no experiences.
    pub fn is_empty(&self) -> bool {
        self.labels.is_empty()
    }

    /// The nearest experiences that `wanted` accepts.
    pub fn nearest(
        &self,
        feature: &[f32],
        count: usize,
        wanted: impl Fn(&Summary) -> bool + Sync,
    ) -> Vec<Match> {
        let labels = &self.labels;
        self.index.nearest(feature, count, |id| labels.get(&id).is_some_and(&wanted))
    }

    /// An experience; `None` when it was removed meanwhile, or cannot be read and is left out ([`Memory::take_left_out`]).
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn get(&mut self, id: i64) -> Result<Option<Arc<Stored>>, StoreError> {
        const KEPT: usize = 500;
        if let Some(stored) = self.kept.get(&id) {
            return Ok(Some(stored.clone()));
        }
        let stored = match self.store.get(id) {
            Err(error) if error.is_of_one_row() => {
                self.leave_out(id, error);
                return Ok(None);
            }
            stored => stored?,
        };
        let Some(stored) = stored else { return Ok(None) };
        let stored = Arc::new(stored);
        if self.kept.len() >= KEPT {
            self.kept.clear();
        }
        self.kept.insert(id, stored.clone());
        Ok(Some(stored))
    }
}
