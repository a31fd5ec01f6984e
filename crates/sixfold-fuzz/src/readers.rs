//! The list of readers: a new reader needs a line here, a check in `checks.rs` and seeds in `seeds.rs`.

use crate::{checks, seeds};

/// A reader of files under test.
#[derive(Debug, Clone, Copy)]
pub struct Reader {
    /// Its name for `--reader`.
    pub name: &'static str,
    /// Files that it can read, to be mutated.
    pub seeds: fn() -> Vec<Vec<u8>>,
    /// Reads the bytes and asserts the invariants of the content.
    ///
    /// # Panics
    /// When an invariant does not hold, which is a finding.
    pub check: fn(&[u8]),
    /// Time of one input relative to one input of a fast reader.
    pub cost: usize,
    /// Whether the file ends in a checksum; then half of the inputs get a correct one.
    pub checksum: bool,
}

/// All readers of external files.
pub fn readers() -> Vec<Reader> {
    let fast = |name, seeds, check| Reader { name, seeds, check, cost: 1, checksum: false };
    let slow = |cost, reader: Reader| Reader { cost, ..reader };
    let summed = |reader: Reader| Reader { checksum: true, ..reader };
    #[cfg_attr(not(feature = "networks"), allow(unused_mut))]
    let mut all = vec![
        fast("ply", seeds::ply, checks::ply),
        fast("obj", seeds::obj, checks::obj),
        fast("stl", seeds::stl, checks::stl),
        fast("gltf", seeds::gltf, checks::gltf),
        fast("xyz", seeds::xyz, checks::xyz),
        fast("models-info", seeds::models_info, checks::models_info),
        fast("scene-files", seeds::scene_files, checks::scene_files),
        fast("coco", seeds::coco, checks::coco),
        fast("rle", seeds::rle, checks::rle),
        fast("results", seeds::results, checks::results),
        fast("pickle", seeds::pickle, checks::pickle),
        fast("hdf5", seeds::hdf5, checks::hdf5),
        fast("camera", seeds::camera, checks::camera),
        slow(2, fast("images", seeds::images, checks::images)),
        slow(20, summed(fast("ppf", seeds::ppf, checks::ppf))),
        slow(20, summed(fast("verification-mesh", seeds::verification_mesh, checks::verification_mesh))),
        slow(2, fast("object-record", seeds::object_record, checks::object_record)),
        slow(2, fast("object-mesh", seeds::object_mesh, checks::object_mesh)),
        fast("gripper", seeds::gripper, checks::gripper),
        fast("haf", seeds::haf, checks::haf),
    ];
    #[cfg(feature = "networks")]
    all.extend([
        fast("weights", seeds::weights, checks::weights),
        slow(2, summed(fast("templates", seeds::templates, checks::templates))),
        fast("training-log", seeds::training_log, checks::training_log),
        slow(10, fast("experience", seeds::experience, checks::experience)),
    ]);
    all
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::mutated;

    #[test]
    fn every_reader_has_a_name_of_its_own_and_seeds_and_holds_for_a_few_mutations() {
        let all = readers();
        assert_eq!(all.iter().map(|r| r.name).collect::<BTreeSet<_>>().len(), all.len());
        for reader in all {
            let seeds = (reader.seeds)();
            assert!(!seeds.is_empty(), "{}", reader.name);
            seeds.iter().for_each(|s| (reader.check)(s));
            let mut random = ChaCha8Rng::seed_from_u64(1);
            (0..20usize.div_ceil(reader.cost)).for_each(|_| (reader.check)(&mutated(&seeds, &mut random)));
        }
    }
}
