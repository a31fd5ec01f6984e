//! What a robot that learns grasps by doing tries next, and what it keeps of it (dissertation, section 6.2.1).
//!
//! Experience proposes where some is near enough, else geometry alone; the best grasps are tried until one holds, and a few
//! others besides. What held becomes an experience, and every try an outcome. How a grasp is tried, in simulation or by a
//! robot, is the caller's.
//!
//! What came of a task is stored at its end, all of it at once: a task that was interrupted has left nothing behind that would
//! change what is tried when it is done again.

use std::error::Error as StdError;

use sixfold_experience::{Attempt, Crop, Experience, JournalEntry, StoreError, TaskRecord};
use sixfold_grasp::{
    AntipodalOptions, ClusterOptions, Grasp, GraspFitter, GraspView, Gripper, OptionsError, antipodal_grasps,
};
use thiserror::Error;

use crate::model::DgcmModel;
use crate::transfer::{
    Kind, Memory, Proposals, ProposeError, ProposeOptions, Ranked, propose, rank_by_outcome, rank_on_part,
};

/// How much is tried, and when experience is asked.
#[derive(Debug, Clone, PartialEq)]
pub struct LearnerOptions {
    /// Grasps tried until one holds, the best first.
    pub tries: usize,
    /// Further grasps tried, spread over the ranked ones: what fails teaches how much to trust a grasp.
    pub explore: usize,
    /// Feature distance of the nearest experience below which experience proposes; 0 for never (dissertation, section 6.3.2:
    /// 0.9).
    pub near: f64,
    /// Only grasps on parts of this name.
    pub part: Option<String>,
}

/// The part that a grasp is on; none in particular, or one by name.
pub type PartOf<'a> = dyn Fn(&Grasp) -> Option<&'static str> + 'a;

/// An object in front of the robot.
pub struct GraspTask<'a> {
    /// What the camera sees of it.
    pub view: &'a GraspView,
    /// How grasps are planned by geometry.
    pub planner: AntipodalOptions,
    /// The object's name, for the store.
    pub object: &'a str,
    /// Where what is stored comes from.
    pub provenance: &'a str,
    /// The part that a grasp is on, where somebody knows the object's parts.
    pub part_of: Option<&'a PartOf<'a>>,
    /// Seconds since 1970.
    pub now: fn() -> i64,
}

/// What came of a lesson. `T` is how a try ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Learned<T> {
    /// Distance of the nearest experience's feature, where experience was asked and there is some.
    pub nearest: Option<f64>,
    /// Whether experience proposed; else geometry did.
    pub from_experience: bool,
    /// The last of the grasps that were tried to hold the object: its rank from 0, and how the try ended. None where there
    /// was no grasp.
    pub last: Option<(usize, T)>,
    /// Whether it held.
    pub held: bool,
    /// Number of the experience that came of it.
    pub stored: Option<i64>,
}

/// What cannot be learned from.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum LearnError {
    /// The planner's options.
    #[error(transparent)]
    Options(#[from] OptionsError),
    /// Experience cannot be asked.
    #[error(transparent)]
    Propose(#[from] ProposeError),
    /// The store.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The grasp could not be tried.
    #[error(transparent)]
    Try(Box<dyn StdError + Send + Sync>),
}

/// Tries a grasp: whether it held, and how it ended.
pub type TryGrasp<'a, T> = dyn FnMut(&Grasp) -> Result<(bool, T), Box<dyn StdError + Send + Sync>> + 'a;

/// The row that a journal gets for a task, with the number of the experience that came of it.
pub struct JournalOf<'a, T> {
    /// The journal's name, which no other has.
    pub journal: &'a str,
    /// The row.
    pub row: &'a dyn Fn(&Learned<T>, Option<i64>) -> String,
}

/// What a task has led to so far.
#[derive(Default)]
struct Record {
    attempts: Vec<Attempt>,
    experience: Option<Experience>,
}

/// Whoever learns.
pub struct Learner<'a> {
    /// Encodes what is seen.
    pub network: &'a DgcmModel,
    /// What is known so far.
    pub memory: &'a mut Memory,
    /// The gripper as the learner knows it.
    pub gripper: &'a Gripper,
    /// How much is tried.
    pub options: &'a LearnerOptions,
}

impl Learner<'_> {
    /// Chooses grasps on what is seen, has them tried, and keeps what came of it. Where somebody keeps a journal of tasks, the
    /// store keeps its row too, in the same step.
    ///
    /// # Errors
    /// [`LearnError`]; where a grasp could not be tried, the outcomes of those before are kept.
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
        let mut geometry = antipodal_grasps(task.view, self.gripper, &task.planner)?;
        if let (Some(part_of), Some(part)) = (task.part_of, &self.options.part) {
            geometry.retain(|grasp| part_of(grasp) == Some(part.as_str()));
        }
        let fitter = GraspFitter::new(task.view, self.gripper, &task.planner)?;
        self.memory.refresh()?;
        let (nearest, found) = self.ask_experience(&fitter)?;
        let ranked = self.rank(&geometry, found.as_ref(), &fitter, task.part_of.is_some());
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
        // The object is put back after every try: what the others would have done costs nothing but time.
        let others = &ranked[left..];
        let count = self.options.explore.min(others.len());
        for k in 0..count {
            let number = k * others.len() / count;
            self.execute(task, &fitter, &others[number], left + number, try_grasp, record)?;
        }
        Ok(learned)
    }

    /// The distance of the nearest experience, and what experience proposes where that is near enough.
    fn ask_experience(
        &mut self,
        fitter: &GraspFitter<'_>,
    ) -> Result<(Option<f64>, Option<Proposals>), ProposeError> {
        if self.options.near <= 0.0 {
            return Ok((None, None));
        }
        let options = ProposeOptions { part: self.options.part.clone(), ..ProposeOptions::default() };
        let proposed = propose(fitter, self.network, self.memory, &options)?;
        let nearest = proposed.nearest.first().map(|m| m.distance);
        let near = nearest.is_some_and(|d| d < self.options.near);
        Ok((nearest, Some(proposed).filter(|p| !p.proposals.is_empty() && near)))
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
            // Where nobody says what a handle is, experience on handles does.
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
            share: candidate.experience,
            transferred: candidate.kind == Kind::Experience,
            held,
            gripper: self.gripper.name.clone(),
            object: task.object.to_owned(),
            time: (task.now)(),
            provenance: format!("{}, rank {rank}", task.provenance),
        });
        Ok((held, ending))
    }

    /// The experience of a grasp that held; none where the object cannot be cut out.
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
