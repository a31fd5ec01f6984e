//! The network's descriptors of an object's templates, and the search for those nearest to a region.

use std::path::Path;
use std::sync::Arc;

use rayon::prelude::*;
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::{Pose, Vec3};
use sixfold_io::fnv1a;

use crate::descriptor_file;
use crate::error::StoreError;
use crate::matching::Entry;
use crate::model::{Descriptor, Encoded, MttmModel, PairOutput};
use crate::network::DESCRIPTOR;
use crate::patch::{Patch, REACH, TemplateSurface};
use crate::regions::shared_diameter;
use crate::template::ObjectTemplates;

/// The network, and its descriptors of every template at every in-plane rotation.
#[derive(Debug, Clone)]
pub struct Learned {
    model: Arc<MttmModel>,
    surfaces: Vec<TemplateSurface>,
    descriptors: Vec<Descriptor>,
    size: f64,
}

impl Learned {
    /// Describes templates; `entries` are the views with their in-plane rotations.
    pub fn new(model: Arc<MttmModel>, object: &ObjectTemplates, entries: &[Entry]) -> Learned {
        let mut learned = Learned::without_descriptors(model, object);
        learned.descriptors = learned.model.describe_templates(entries.len(), |i| learned.patch(entries[i]));
        learned
    }

    /// The same, with descriptors read from `path` if the file belongs to this network and these templates, otherwise computed and
    /// written there. The second value says why they could not be read or written.
    pub fn cached(
        path: &Path,
        model: Arc<MttmModel>,
        object: &ObjectTemplates,
        entries: &[Entry],
    ) -> (Learned, Option<StoreError>) {
        let made_from = [model.fingerprint(), fnv1a(&object.to_bytes())];
        let mut note = None;
        match descriptor_file::read(path, made_from) {
            Ok(descriptors) if descriptors.len() == entries.len() => {
                let learned = Learned::without_descriptors(model, object);
                return (Learned { descriptors, ..learned }, None);
            }
            Ok(_) => {}
            Err(StoreError::Io { source, .. }) if source.kind() == std::io::ErrorKind::NotFound => {}
            Err(StoreError::OtherInput { .. }) => {}
            Err(error) => note = Some(error),
        }
        let learned = Learned::new(model, object, entries);
        if let Err(error) = descriptor_file::write(path, made_from, &learned.descriptors) {
            note = Some(error);
        }
        (learned, note)
    }

    fn without_descriptors(model: Arc<MttmModel>, object: &ObjectTemplates) -> Learned {
        let surfaces = object.templates.par_iter().map(|t| TemplateSurface::new(t, object.size)).collect();
        Learned { model, surfaces, descriptors: vec![], size: REACH * shared_diameter(object.diameter) }
    }

    /// The network.
    pub fn model(&self) -> &MttmModel {
        &self.model
    }

    /// Side of a region, metres.
    pub fn size(&self) -> f64 {
        self.size
    }

    /// A template at a rotation.
    pub fn patch(&self, entry: Entry) -> Patch {
        self.surfaces[entry.template].patch(entry.turn, self.size, self.model.side())
    }

    /// Maps of templates at their in-plane rotations, for comparison with regions.
    pub fn templates(&self, entries: &[Entry]) -> Encoded {
        let patches: Vec<Patch> = entries.iter().map(|e| self.patch(*e)).collect();
        self.model.encode_templates(&patches)
    }

    /// Squared distance and number of the nearest entry for every descriptor, by exhaustive search.
    pub fn nearest(&self, regions: &[Descriptor]) -> Vec<(f32, usize)> {
        regions
            .par_iter()
            .map(|r| {
                let mut best = (f32::INFINITY, 0);
                for (i, d) in self.descriptors.iter().enumerate() {
                    let distance = squared_distance(r, d);
                    if distance < best.0 {
                        best = (distance, i);
                    }
                }
                best
            })
            .collect()
    }

    /// [`Learned::nearest`], and the numbers of the descriptors, those with the nearest entry first.
    pub(crate) fn nearest_first(&self, regions: &[Descriptor]) -> (Vec<(f32, usize)>, Vec<usize>) {
        let nearest = self.nearest(regions);
        let mut order: Vec<usize> = (0..regions.len()).collect();
        order.sort_by(|&a, &b| nearest[a].0.total_cmp(&nearest[b].0).then(a.cmp(&b)));
        (nearest, order)
    }

    /// All entries, nearest first.
    pub fn ranked(&self, region: &Descriptor) -> Vec<(f32, usize)> {
        let mut all: Vec<(f32, usize)> =
            self.descriptors.iter().enumerate().map(|(i, d)| (squared_distance(region, d), i)).collect();
        all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        all
    }

    /// The pose that the network predicts for a template in the camera frame: rotation, and position of the reference point; `None`
    /// if the network was not trained to predict the position.
    pub fn camera_from_view(&self, camera_from_roi: &Pose, turn: f64, output: &PairOutput) -> Option<Pose> {
        let rotated = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), turn);
        let place = Vec3::from(output.offset?) * self.size;
        Some(*camera_from_roi * Pose::new(output.rotation * rotated, place))
    }
}

fn squared_distance(a: &Descriptor, b: &Descriptor) -> f32 {
    const LANES: usize = 16;
    let mut sums = [0f32; LANES];
    for (a, b) in a.as_chunks::<LANES>().0.iter().zip(b.as_chunks::<LANES>().0) {
        for l in 0..LANES {
            let off = a[l] - b[l];
            sums[l] += off * off;
        }
    }
    const { assert!(DESCRIPTOR.is_multiple_of(LANES)) };
    sums.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::matching::{MatchOptions, Matcher};
    use crate::network::{CompactConfig, Network};
    use crate::template::TemplateOptions;
    use burn::tensor::Device;
    use sixfold_mesh::Mesh;
    use sixfold_nn::weights::ModelCard;

    fn learned_from(seed: u64) -> (Arc<MttmModel>, ObjectTemplates, Vec<Entry>) {
        let corners = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.07, 0.0], [0.0, 0.0, 0.05]];
        let faces = vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
        let mesh = Mesh::new(corners.map(Vec3::from).to_vec(), faces).unwrap();
        let object = ObjectTemplates::from_mesh(&mesh, &TemplateOptions::default()).unwrap();
        let entries = Matcher::new(&object, &MatchOptions::default()).entries()[..40].to_vec();
        let network = Network::Compact(CompactConfig.init(seed, &Device::flex()));
        let card = ModelCard { seed, ..ModelCard::new("", "test") };
        (Arc::new(MttmModel::new(network, card)), object, entries)
    }

    #[test]
    fn a_template_is_its_own_nearest() {
        let (model, object, entries) = learned_from(1);
        let learned = Learned::new(model, &object, &entries);
        let own = learned.descriptors.clone();
        for (i, (distance, found)) in learned.nearest(&own).into_iter().enumerate() {
            assert!(distance < 1e-6 && (found == i || own[found] == own[i]), "{i} {found} {distance}");
            assert_eq!(learned.ranked(&own[i])[0], (distance, found));
        }
    }

    #[test]
    fn kept_descriptors_belong_to_one_network_and_its_templates() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("templates.descriptors");
        let (model, object, entries) = learned_from(1);
        let (first, note) = Learned::cached(&path, model.clone(), &object, &entries);
        assert!(note.is_none() && path.is_file());
        let written = std::fs::metadata(&path).unwrap().modified().unwrap();
        let (again, note) = Learned::cached(&path, model, &object, &entries);
        assert!(note.is_none());
        assert_eq!(first.descriptors, again.descriptors);
        assert_eq!(std::fs::metadata(&path).unwrap().modified().unwrap(), written);
        let (other, note) = Learned::cached(&path, learned_from(2).0, &object, &entries);
        assert!(note.is_none());
        assert_ne!(first.descriptors, other.descriptors);
        // A damaged file is reported and computed again.
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        let (_, note) = Learned::cached(&path, learned_from(2).0, &object, &entries);
        assert!(note.unwrap().to_string().contains("templates.descriptors"));
        assert_eq!(std::fs::read(&path).unwrap(), bytes);
    }
}
