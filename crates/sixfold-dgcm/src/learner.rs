//! Learning of grasps by trial: which grasps a robot tries next, and what it stores (dissertation, section 6.2.1).
//!
//! Grasps are proposed from experience if some is near enough, otherwise from geometry alone. The best ones are tried until one
//! holds, and a few others in addition. A grasp that held is stored as an experience, and every trial as an attempt. The caller
//! executes the trials, in simulation or on a robot. In the published form (section 6.3.2) the grasps are those of DGCM-Net alone if
//! experience is near enough, otherwise those of the caller's planner.
//!
//! All results of a task are stored together at its end: an interrupted task leaves nothing behind that would change the trials
//! when it is repeated.

use std::error::Error as StdError;

use sixfold_experience::{Attempt, Crop, Experience, JournalEntry, StoreError, TaskRecord};
use sixfold_grasp::{
    AntipodalOptions, ClusterOptions, Grasp, GraspCluster, GraspFitter, GraspView, Gripper, OptionsError,
    antipodal_grasps,
};
use thiserror::Error;

use crate::model::DgcmModel;
use crate::transfer::{
    Kind, Memory, Proposals, ProposeError, ProposeOptions, Ranked, propose, rank_by_outcome,
    rank_experience_as_published, rank_on_part,
};

/// Number of trials, and when experience is used.
#[derive(Debug, Clone, PartialEq)]
pub struct LearnerOptions {
    /// Grasps tried until one holds, the best first.
    pub tries: usize,
    /// Further grasps tried, spread over the ranked ones: failures improve the prediction of outcomes.
    pub explore: usize,
    /// Feature distance of the nearest experience below which experience is used; 0 for never (dissertation, section 6.3.2: 0.9).
    pub near: f64,
    /// Only grasps on parts with this name.
    pub part: Option<String>,
}

/// Returns the name of the part on which a grasp is, or `None`.
pub type PartOf<'a> = dyn Fn(&Grasp) -> Option<&'static str> + 'a;

/// A planner's clusters of grasps on a view, in the order in which it would have them tried.
pub type PlanGrasps<'a> =
    dyn Fn(&GraspView, &AntipodalOptions) -> Result<Vec<GraspCluster>, Box<dyn StdError + Send + Sync>> + 'a;

/// An object in front of the robot.
pub struct GraspTask<'a> {
    /// The camera's view of it.
    pub view: &'a GraspView,
    /// Options of the geometric planner.
    pub planner: AntipodalOptions,
    /// The object's name, for the store.
    pub object: &'a str,
    /// Origin to store with the results.
    pub provenance: &'a str,
    /// The part on which a grasp is, if the object's parts are known.
    pub part_of: Option<&'a PartOf<'a>>,
    /// Seconds since 1970.
    pub now: fn() -> i64,
}

/// The result of a task. `T` is the outcome of a trial.
#[derive(Debug, Clone, PartialEq)]
pub struct Learned<T> {
    /// Distance of the nearest experience's feature, if experience was used and there is some.
    pub nearest: Option<f64>,
    /// Whether the grasps were proposed from experience; otherwise from geometry.
    pub from_experience: bool,
    /// The last grasp tried before exploration: its rank, from 0, and its outcome. `None` if there was no grasp.
    pub last: Option<(usize, T)>,
    /// Whether it held.
    pub held: bool,
    /// Number of the stored experience.
    pub stored: Option<i64>,
}

/// Errors of learning.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum LearnError {
    /// The planner's options.
    #[error(transparent)]
    Options(#[from] OptionsError),
    /// The proposals from experience.
    #[error(transparent)]
    Propose(#[from] ProposeError),
    /// The store.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The planner of the published form.
    #[error(transparent)]
    Plan(Box<dyn StdError + Send + Sync>),
    /// The grasp could not be tried.
    #[error(transparent)]
    Try(Box<dyn StdError + Send + Sync>),
}

/// Tries a grasp; returns whether it held, and its outcome.
pub type TryGrasp<'a, T> = dyn FnMut(&Grasp) -> Result<(bool, T), Box<dyn StdError + Send + Sync>> + 'a;

/// The row of a task in a journal, with the number of the stored experience.
pub struct JournalOf<'a, T> {
    /// The journal's unique name.
    pub journal: &'a str,
    /// The row.
    pub row: &'a dyn Fn(&Learned<T>, Option<i64>) -> String,
}

/// Results of a task so far.
#[derive(Default)]
struct Record {
    attempts: Vec<Attempt>,
    experience: Option<Experience>,
}

/// A learner.
pub struct Learner<'a> {
    /// Encodes views.
    pub network: &'a DgcmModel,
    /// The experiences and outcomes so far.
    pub memory: &'a mut Memory,
    /// The gripper that the learner assumes.
    pub gripper: &'a Gripper,
    /// Options.
    pub options: &'a LearnerOptions,
    /// The published form, with the planner for objects without near experience; `None` for ours.
    pub published: Option<&'a PlanGrasps<'a>>,
}

impl Learner<'_> {
    /// Chooses grasps for a view, has them tried, and stores the results. If there is a journal of tasks, its row is stored in the
    /// same transaction.
    ///
    /// # Errors
    /// [`LearnError`]; if a grasp could not be tried, the outcomes of those before are kept.
    pub fn learn<T>(
        &mut self,
        task: &GraspTask<'_>,
        try_grasp: &mut TryGrasp<'_, T>,
        journal: Option<&JournalOf<'_, T>>,
    ) -> Result<Learned<T>, LearnError> {
        let mut record = Record::default();
        let tried = self.try_grasps(task, try_grasp, &mut record);
        if tried.is_err() && record.attempts.is_empty() {
            return tried;
        }
        let row = |stored: Option<i64>| match (&tried, journal) {
            (Ok(learned), Some(journal)) => (journal.row)(learned, stored),
            _ => String::new(),
        };
        let entry = journal.filter(|_| tried.is_ok()).map(|j| JournalEntry { journal: j.journal, row: &row });
        let experience = record.experience.as_ref();
        let stored = self.memory.store().add_record(&TaskRecord {
            attempts: &record.attempts,
            experience,
            journal: entry,
        })?;
        let mut learned = tried?;
        learned.stored = stored;
        if stored.is_some() {
            self.memory.refresh()?;
        }
        Ok(learned)
    }

    /// Chooses grasps and has them tried.
    fn try_grasps<T>(
        &mut self,
        task: &GraspTask<'_>,
        try_grasp: &mut TryGrasp<'_, T>,
        record: &mut Record,
    ) -> Result<Learned<T>, LearnError> {
        let fitter = GraspFitter::new(task.view, self.gripper, &task.planner)?;
        self.memory.refresh()?;
        let (nearest, found) = self.ask_experience(&fitter)?;
        let ranked = match (self.published, &found) {
            (None, _) => {
                let mut geometry = antipodal_grasps(task.view, self.gripper, &task.planner)?;
                geometry.retain(|grasp| self.is_wanted(task, grasp));
                self.rank(&geometry, found.as_ref(), &fitter, task.part_of.is_some())
            }
            (Some(_), Some(found)) => {
                rank_experience_as_published(&found.proposals, &ClusterOptions::default())
            }
            (Some(plan), None) => {
                let planned = plan(task.view, &task.planner).map_err(LearnError::Plan)?;
                let wanted = planned.into_iter().filter(|cluster| self.is_wanted(task, &cluster.best));
                wanted.map(Ranked::of_planner).collect()
            }
        };
        let from_experience = found.is_some();
        let mut learned = Learned { nearest, from_experience, last: None, held: false, stored: None };
        let mut left = 0;
        for (number, candidate) in ranked.iter().take(self.options.tries).enumerate() {
            let (held, ending) = self.execute(task, &fitter, candidate, number, try_grasp, record)?;
            learned.last = Some((number, ending));
            left = number + 1;
            if held {
                learned.held = true;
                record.experience = self.experience(task, &candidate.grasp);
                break;
            }
        }
        // The object is put back after every trial: exploring other grasps costs only time.
        let others = &ranked[left..];
        let count = self.options.explore.min(others.len());
        for k in 0..count {
            let number = k * others.len() / count;
            self.execute(task, &fitter, &others[number], left + number, try_grasp, record)?;
        }
        Ok(learned)
    }

    /// The distance of the nearest experience, and the proposals from experience if it is near enough.
    fn ask_experience(
        &mut self,
        fitter: &GraspFitter<'_>,
    ) -> Result<(Option<f64>, Option<Proposals>), ProposeError> {
        if self.options.near <= 0.0 {
            return Ok((None, None));
        }
        let form =
            if self.published.is_some() { ProposeOptions::published() } else { ProposeOptions::default() };
        let options = ProposeOptions { part: self.options.part.clone(), ..form };
        let proposed = propose(fitter, self.network, self.memory, &options)?;
        let nearest = proposed.nearest.first().map(|m| m.distance);
        let near = nearest.is_some_and(|d| d < self.options.near);
        Ok((nearest, Some(proposed).filter(|p| !p.proposals.is_empty() && near)))
    }

    /// Whether a grasp is on the requested part; true for all where no part is requested or the object's parts are unknown.
    fn is_wanted(&self, task: &GraspTask<'_>, grasp: &Grasp) -> bool {
        match (task.part_of, &self.options.part) {
            (Some(part_of), Some(part)) => part_of(grasp) == Some(part.as_str()),
            _ => true,
        }
    }

    /// The grasps in the order in which they are tried.
    fn rank(
        &mut self,
        geometry: &[Grasp],
        found: Option<&Proposals>,
        fitter: &GraspFitter<'_>,
        parts_are_known: bool,
    ) -> Vec<Ranked> {
        let outcomes = self.memory.outcomes(&self.gripper.name);
        let clusters = ClusterOptions::default();
        match found {
            // If the object's parts are unknown, experience on this part locates it.
            Some(found) if self.options.part.is_some() && !parts_are_known => {
                rank_on_part(geometry, found, &clusters, fitter, &outcomes)
            }
            found => {
                let proposals = found.map_or(&[][..], |f| &f.proposals);
                rank_by_outcome(geometry, proposals, &clusters, fitter, &outcomes)
            }
        }
    }

    /// Has one grasp tried and records what came of it.
    fn execute<T>(
        &self,
        task: &GraspTask<'_>,
        fitter: &GraspFitter<'_>,
        candidate: &Ranked,
        rank: usize,
        try_grasp: &mut TryGrasp<'_, T>,
        record: &mut Record,
    ) -> Result<(bool, T), LearnError> {
        let (held, ending) = try_grasp(&candidate.grasp).map_err(LearnError::Try)?;
        record.attempts.push(Attempt {
            description: fitter.describe(&candidate.grasp),
            agreement: candidate.experience,
            transferred: candidate.kind == Kind::Experience,
            held,
            gripper: self.gripper.name.clone(),
            object: task.object.to_owned(),
            time: (task.now)(),
            provenance: format!("{}, rank {rank}", task.provenance),
        });
        Ok((held, ending))
    }

    /// The experience of a grasp that held; `None` if the object cannot be cropped.
    fn experience(&self, task: &GraspTask<'_>, grasp: &Grasp) -> Option<Experience> {
        let crop = Crop::of_view(task.view, self.network.crop_options()).ok()?;
        let part = match task.part_of {
            Some(part_of) => part_of(grasp),
            None => self.options.part.as_deref(),
        };
        Some(Experience::new(
            self.network,
            crop,
            grasp,
            self.gripper,
            task.object,
            part,
            (task.now)(),
            task.provenance,
        ))
    }
}
