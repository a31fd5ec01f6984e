//! A summary of a training set in words and hashes: equal for equal pixels, poses and meshes in whatever files they are, different
//! as soon as one of them differs.

use std::sync::Arc;

use sixfold_geometry::{Camera, FrameId, Pose, RgbImage, Vec3};
use sixfold_io::Fnv1a;

use crate::posed_image::PosedImage;
use crate::training_set::{TrainingObject, TrainingSet};

/// Up to this many frames are named one by one.
const NAMED: usize = 8;

impl TrainingSet {
    /// Names and contents of the training data: ids and frames in words; each object (its mesh, diameter and symmetries) and all
    /// images (pixels, cameras, poses and masks) as hashes.
    pub fn contents(&self) -> Vec<(String, String)> {
        let ids: Vec<String> = self.objects.iter().map(|o| o.id.to_string()).collect();
        let mut contents =
            vec![("ids".to_owned(), ids.join(", ")), ("frames".to_owned(), frames_in_words(&self.frames))];
        for object in &self.objects {
            contents
                .push((format!("mesh of object {}", object.id), format!("{:016x}", hash_of_object(object))));
        }
        let images = match self.images.len() {
            0 => "none".to_owned(),
            count => format!("{count} instances, hash {:016x}", hash_of_images(&self.images)),
        };
        contents.push(("photographs".to_owned(), images));
        contents
    }
}

fn frames_in_words(frames: &[FrameId]) -> String {
    if frames.len() <= NAMED {
        let names: Vec<String> = frames.iter().map(FrameId::to_string).collect();
        return if names.is_empty() { "none".to_owned() } else { names.join(" ") };
    }
    let mut hash = Hash::default();
    frames.iter().for_each(|frame| hash.frame(frame));
    format!("{} frames, hash {:016x}", frames.len(), hash.0.value())
}

fn hash_of_object(object: &TrainingObject) -> u64 {
    let TrainingObject { id, mesh, info, scale } = object;
    let mut hash = Hash::default();
    hash.count(*id as usize);
    [mesh.contents_hash(), info.contents_hash()].iter().for_each(|h| hash.0.write(&h.to_le_bytes()));
    hash.point(&scale.centre);
    hash.point(&scale.half_size);
    hash.0.value()
}

fn hash_of_images(images: &[PosedImage]) -> u64 {
    let mut all = Hash::default();
    // Instances of one frame share its image, and follow each other.
    let mut last: Option<(&Arc<RgbImage>, u64)> = None;
    for posed in images {
        let pixels = match last {
            Some((image, hash)) if Arc::ptr_eq(image, posed.image()) => hash,
            _ => {
                let mut hash = Hash::default();
                hash.image(posed.image());
                hash.0.value()
            }
        };
        last = Some((posed.image(), pixels));
        all.0.write(&pixels.to_le_bytes());
        all.count(posed.object_id() as usize);
        if let Some(frame) = posed.frame() {
            all.frame(&frame);
        }
        all.camera(posed.camera());
        all.pose(posed.camera_from_object());
        all.number(posed.visible_fraction().unwrap_or(-1.0));
        match posed.mask() {
            Some(mask) => mask.parts().iter().for_each(|part| all.0.write(part)),
            None => all.count(0),
        }
    }
    all.0.value()
}

/// Hashes values by their bytes.
#[derive(Default)]
struct Hash(Fnv1a);

impl Hash {
    fn count(&mut self, count: usize) {
        self.0.write(&(count as u64).to_le_bytes());
    }

    fn number(&mut self, number: f64) {
        self.0.write(&number.to_le_bytes());
    }

    fn point(&mut self, point: &Vec3) {
        point.iter().for_each(|c| self.number(*c));
    }

    fn pose(&mut self, pose: &Pose) {
        pose.to_matrix().iter().for_each(|c| self.number(*c));
    }

    fn frame(&mut self, frame: &FrameId) {
        self.count(frame.scene_id as usize);
        self.count(frame.im_id as usize);
    }

    fn camera(&mut self, camera: &Camera) {
        [camera.fx, camera.fy, camera.cx, camera.cy].iter().for_each(|v| self.number(*v));
        self.count(camera.width);
        self.count(camera.height);
    }

    fn image(&mut self, image: &RgbImage) {
        self.count(image.width());
        self.count(image.height());
        self.0.write(image.as_slice().as_flattened());
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use sixfold_geometry::Mask;
    use sixfold_mesh::{Mesh, ModelInfo};

    use super::*;

    fn set() -> TrainingSet {
        let corners = vec![Vec3::zeros(), Vec3::x() * 0.05, Vec3::y() * 0.05, Vec3::z() * 0.05];
        let mesh = Mesh::new(corners, vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]).unwrap();
        let camera = Camera::new(60.0, 60.0, 15.5, 11.5, 32, 24).unwrap();
        let pose = Pose::from_translation(Vec3::new(0.0, 0.0, 0.6));
        let image = Arc::new(RgbImage::from_fn(32, 24, |x, y| [x as u8, y as u8, 7]));
        let frame = FrameId::new(2, 36);
        let posed = |id| PosedImage::of_frame(frame, id, image.clone(), camera, pose).unwrap();
        let mask = Mask::from_fn(32, 24, |x, _| x > 4);
        let info = ModelInfo::of_mesh(&mesh);
        TrainingSet {
            objects: vec![
                TrainingObject::new(5, mesh.clone(), info.clone()),
                TrainingObject::new(8, mesh, info),
            ],
            images: vec![posed(5).with_mask(&mask).unwrap(), posed(8)],
            frames: vec![frame],
            description: "anything".to_owned(),
        }
    }

    /// The names of the entries that a change of the set changes.
    fn changed(by: impl FnOnce(&mut TrainingSet)) -> Vec<String> {
        let mut other = set();
        by(&mut other);
        let was: BTreeMap<String, String> = set().contents().into_iter().collect();
        other.contents().into_iter().filter(|(n, v)| was.get(n) != Some(v)).map(|(n, _)| n).collect()
    }

    #[test]
    fn every_change_of_the_training_data_is_detected() {
        assert!(changed(|s| s.description.clear()).is_empty());
        assert_eq!(changed(|s| s.objects.reverse()), ["ids"]);
        assert_eq!(changed(|s| s.frames.push(FrameId::new(2, 37))), ["frames"]);
        let mesh = |s: &mut TrainingSet| s.objects[1].mesh = s.objects[1].mesh.scaled(1.01);
        assert_eq!(changed(mesh), ["mesh of object 8"]);
        let turn = |s: &mut TrainingSet| s.objects[0].info.symmetries_discrete.push(Pose::identity());
        assert_eq!(changed(turn), ["mesh of object 5"]);
        let colors = |s: &mut TrainingSet| {
            s.objects[0].mesh = s.objects[0].mesh.clone().with_colors(vec![[1, 2, 3]; 4]).unwrap();
        };
        assert_eq!(changed(colors), ["mesh of object 5"]);
        let pose = |s: &mut TrainingSet| {
            let moved = Pose::from_translation(Vec3::new(0.0, 0.0, 0.601));
            s.images[1] = s.images[1].with_pose(moved).unwrap();
        };
        let mask = |s: &mut TrainingSet| {
            s.images[0] =
                s.images[0].clone().with_mask(&Mask::from_fn(32, 24, |x, y| x > 4 && y > 0)).unwrap();
        };
        let pixel = |s: &mut TrainingSet| {
            let mut image = s.images[1].image().as_ref().clone();
            image.as_mut_slice()[700][2] = 8;
            let (frame, camera) = (s.frames[0], *s.images[1].camera());
            let pose = *s.images[1].camera_from_object();
            s.images[1] = PosedImage::of_frame(frame, 8, Arc::new(image), camera, pose).unwrap();
        };
        assert_eq!(changed(pose), ["photographs"]);
        assert_eq!(changed(mask), ["photographs"]);
        assert_eq!(changed(pixel), ["photographs"]);
        assert_eq!(changed(|s| s.images.truncate(1)), ["photographs"]);
    }

    #[test]
    fn many_frames_are_counted() {
        let frames: Vec<FrameId> = (0..40).map(|i| FrameId::new(1, i)).collect();
        assert!(frames_in_words(&frames).starts_with("40 frames, hash "));
        assert_ne!(frames_in_words(&frames), frames_in_words(&frames[..39]));
        assert_eq!(frames_in_words(&frames[..2]), "1/0 1/1");
    }
}
