//! The first step of a teaching without a board: features of all photographs, then their poses; and the known length that gives the
//! scale.

use sixfold_geometry::{DepthImage, Progress};
use sixfold_io::{ImageFile, read_depth, read_rgb};
use sixfold_nn::keypoints::KeypointFinder;

use crate::error::TeachError;
use crate::one_side::camera_above_table;
use crate::shape::step;
use crate::teaching::{By, Step, Teaching, World, is_same};
use crate::unboarded::{KnownLength, PutTogether, SeenFeatures, features_of, put_together};

impl Teaching {
    /// Sets the length between two points that a person marked, with the photographs by number; `None` to take the scale from
    /// measured depth. Only without a board. If the length changes, the poses are found again.
    ///
    /// # Errors
    /// [`TeachError::NoPhotograph`], [`TeachError::Io`].
    pub fn set_length(&mut self, length: Option<KnownLength>) -> Result<(), TeachError> {
        for (number, _) in length.iter().flat_map(|l| &l.ends) {
            self.check_number(*number)?;
        }
        if is_same(&self.known.state.length, &length) {
            return Ok(());
        }
        self.known.state.length = length;
        if self.known.state.world == World::Features {
            self.forget_from(Step::Poses);
        }
        self.save()
    }

    /// Whether a used photograph was added after the poses were found.
    pub(crate) fn lacks_poses(&self) -> bool {
        let lacks = |p: &crate::teaching::Photograph| {
            !p.left_out_by_person && p.left_out.is_none() && p.camera_from_board.is_none()
        };
        self.known.state.world == World::Features && self.photographs().iter().any(lacks)
    }

    /// Finds camera, poses and floor from features. In the progress, the features of a photograph count as much as all later steps
    /// for it.
    pub(crate) fn locate_by_features(&mut self, progress: &dyn Progress) -> Result<(), TeachError> {
        let used: Vec<usize> =
            (0..self.photographs().len()).filter(|i| !self.photographs()[*i].left_out_by_person).collect();
        let count = used.len();
        let length = self.length_of(&used)?;
        let depth_of = |i: usize| match &self.photographs()[used[i]].depth {
            Some((file, unit)) => Ok(Some(read_depth(&self.path("depth", file), *unit)?)),
            None => Ok(None),
        };
        // Check this before the slow steps.
        if length.is_none() && used.iter().all(|i| self.photographs()[*i].depth.is_none()) {
            return Err(TeachError::NoScale);
        }
        if let [number] = used[..]
            && let Some(depth) = depth_of(0)?
        {
            return self.locate_above_table(number, &depth);
        }
        let finder = KeypointFinder::shipped().map_err(|e| TeachError::Masks(e.into()))?;
        let mut seen = vec![];
        for (done, number) in used.iter().enumerate() {
            step(progress, done, 2 * count)?;
            let photograph = &self.photographs()[*number];
            let file = self.path("photographs", &photograph.file);
            let image = read_rgb(&file)?;
            let features = features_of(&finder, &image)?;
            let focal_length = ImageFile::new(&file).focal_length()?;
            let (name, size) = (photograph.name.clone(), image.size());
            seen.push(SeenFeatures { name, size, features, focal_length });
        }
        let rest =
            |done: usize, total: usize| progress.report(count + done * count / total.max(1), 2 * count);
        let camera = self.known.state.given_camera;
        let found = put_together(&seen, camera.as_ref(), length.as_ref(), &depth_of, &rest)?;
        self.keep_poses(&used, found)
    }

    /// The pose of a single photograph above the table that its depth shows.
    fn locate_above_table(&mut self, number: usize, depth: &DepthImage) -> Result<(), TeachError> {
        let file = self.photographs()[number].name.clone();
        let (width, height) = depth.size();
        let Some(camera) = self.known.state.given_camera else { return Err(TeachError::NoCamera { file }) };
        if (camera.width, camera.height) != (width, height) {
            let (camera_width, camera_height) = (camera.width, camera.height);
            return Err(TeachError::CameraSize { width, height, camera_width, camera_height });
        }
        let pose = camera_above_table(depth, &camera).ok_or(TeachError::NoTable { file })?;
        let found = PutTogether { camera, camera_from_world: vec![Ok(pose)], floor: Some(0.0), rms: 0.0 };
        self.keep_poses(&[number], found)
    }

    /// The length with the numbers of the photographs that are used.
    fn length_of(&self, used: &[usize]) -> Result<Option<KnownLength>, TeachError> {
        let Some(length) = &self.known.state.length else { return Ok(None) };
        let number = |i: &usize| used.iter().position(|number| number == i);
        let ends = length.ends.iter().filter_map(|(i, ends)| Some((number(i)?, *ends))).collect();
        Ok(Some(KnownLength { metres: length.metres, ends }))
    }

    fn keep_poses(&mut self, used: &[usize], found: PutTogether) -> Result<(), TeachError> {
        for (number, pose) in used.iter().zip(found.camera_from_world) {
            let (pose, reason) = match pose {
                Ok(pose) => (Some(pose.rows()), None),
                Err(reason) => (None, Some(reason)),
            };
            // This also replaces poses that a person had corrected: they were in another frame.
            let photograph = &mut self.known.state.photographs[*number];
            photograph.pose_by = pose.map(|_| By::Program);
            (photograph.camera_from_board, photograph.left_out) = (pose, reason);
        }
        self.known.state.floor = found.floor.map(|height| [0.0, 0.0, 1.0, height]);
        self.known.state.located = Some((None, found.camera, found.rms));
        self.save()
    }
}
