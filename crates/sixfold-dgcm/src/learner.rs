//! What a robot that learns grasps by doing tries next, and what it keeps of it (dissertation, section 6.2.1).
//!
//! Experience proposes where some is near enough, else geometry alone; the best grasps are tried until one holds, and a few
//! others besides. What held becomes an experience, and every try an outcome. How a grasp is tried, in simulation or by a
//! robot, is the caller's.

use std::error::Error as StdError;

use sixfold_experience::{Attempt, Crop, Experience, StoreError};
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
    /// Chooses grasps on what is seen, has them tried, and keeps what came of it.
    ///
    /// # Errors
    /// [`LearnError`]; what was tried before is kept.
    pub fn learn<T>(
        &mut self,
        task: &GraspTask<'_>,
        try_grasp: &mut TryGrasp<'_, T>,
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
            let (held, ending) = self.execute(task, &fitter, candidate, number, try_grasp)?;
            learned.last = Some((number, ending));
            left = number + 1;
            if held {
                learned.held = true;
                learned.stored = self.remember(task, &candidate.grasp)?;
                break;
            }
        }
        // The object is put back after every try: what the others would have done costs nothing but time.
        let others = &ranked[left..];
        let count = self.options.explore.min(others.len());
        for k in 0..count {
            let number = k * others.len() / count;
            self.execute(task, &fitter, &others[number], left + number, try_grasp)?;
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

    /// Has one grasp tried and keeps what came of it.
    fn execute<T>(
        &mut self,
        task: &GraspTask<'_>,
        fitter: &GraspFitter<'_>,
        candidate: &Ranked,
        rank: usize,
        try_grasp: &mut TryGrasp<'_, T>,
    ) -> Result<(bool, T), LearnError> {
        let (held, ending) = try_grasp(&candidate.grasp).map_err(LearnError::Try)?;
        let tried = Attempt {
            description: fitter.describe(&candidate.grasp),
            share: candidate.experience,
            transferred: candidate.kind == Kind::Experience,
            held,
            gripper: self.gripper.name.clone(),
            object: task.object.to_owned(),
            time: (task.now)(),
            provenance: format!("{}, rank {rank}", task.provenance),
        };
        self.memory.store().add_attempt(&tried)?;
        Ok((held, ending))
    }

    /// Stores a grasp that held; nothing where the object cannot be cut out.
    fn remember(&mut self, task: &GraspTask<'_>, grasp: &Grasp) -> Result<Option<i64>, LearnError> {
        let Ok(crop) = Crop::of_view(task.view, self.network.crop_options()) else { return Ok(None) };
        let part = match task.part_of {
            Some(part_of) => part_of(grasp),
            None => self.options.part.as_deref(),
        };
        let experience = Experience::new(
            self.network,
            crop,
            grasp,
            self.gripper,
            task.object,
            part,
            (task.now)(),
            task.provenance,
        );
        let (id, _) = self.memory.store().add(&experience)?;
        self.memory.refresh()?;
        Ok(Some(id))
    }
}
