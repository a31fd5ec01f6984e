//! Parameters of the dissertation's experiments: pools of symmetric poses (appendix A.1), outlier thresholds (A.2) and occluded
//! fractions in training (table 3.3).

use std::f64::consts::{FRAC_PI_2, PI};

use sixfold_geometry::{Pose, Vec3};
use sixfold_mesh::{ContinuousSymmetry, ModelInfo};
use sixfold_nn::choice::Choice;

use crate::object::BOP_THRESHOLDS;

/// One experiment of the dissertation. Objects have their BOP ids.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Preset {
    /// The entries to the BOP challenges of 2019 and 2020 (section 3.4.5): three thresholds for every object, symmetries as stated
    /// by the dataset.
    Bop,
    /// LineMOD (section 3.4.2), 13 objects.
    Linemod,
    /// LineMOD Occlusion (section 3.4.3), eight objects.
    Lmo,
    /// T-LESS (section 3.4.4), 30 objects.
    Tless,
}

/// Rotations under which an object looks the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Turns {
    None,
    /// Half a turn about y.
    HalfY,
    /// Half a turn about z.
    HalfZ,
    /// Quarter turns about z.
    QuarterZ,
    /// Any rotation about z.
    AnyZ,
}

/// Table A.2.3.
const TLESS_THRESHOLDS: [f32; 30] = [
    0.1, 0.1, 0.1, 0.3, 0.2, 0.3, 0.3, 0.3, 0.3, 0.2, //
    0.3, 0.3, 0.2, 0.2, 0.2, 0.3, 0.3, 0.2, 0.3, 0.3, //
    0.2, 0.2, 0.3, 0.1, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3,
];

impl Choice for Preset {
    const ALL: &'static [Preset] = &[Preset::Bop, Preset::Linemod, Preset::Lmo, Preset::Tless];

    fn name(self) -> &'static str {
        match self {
            Preset::Bop => "bop",
            Preset::Linemod => "linemod",
            Preset::Lmo => "lmo",
            Preset::Tless => "tless",
        }
    }

    fn help(self) -> &'static str {
        match self {
            Preset::Bop => "The entries to the BOP challenges: three thresholds, symmetries of the dataset",
            Preset::Linemod => "LineMOD",
            Preset::Lmo => "LineMOD Occlusion",
            Preset::Tless => "T-LESS",
        }
    }
}

impl Preset {
    /// The objects of the experiment, for messages.
    pub fn objects(self) -> &'static str {
        match self {
            Preset::Bop => "any object",
            Preset::Linemod => "objects of LineMOD as in the dissertation: 1, 2, 4 to 6, 8 to 15",
            Preset::Lmo => "objects of LineMOD Occlusion: 1, 5, 6, 8 to 12",
            Preset::Tless => "objects of T-LESS: 1 to 30",
        }
    }

    /// The outlier thresholds of an object that are tried (tables A.2.1 to A.2.3); `None` for an object that the experiment
    /// does not have.
    pub fn thresholds(self, id: u32) -> Option<Vec<f32>> {
        let one = match (self, id) {
            (Preset::Bop, _) => return Some(BOP_THRESHOLDS.to_vec()),
            // Ape and duck.
            (Preset::Linemod, 1 | 9) => 0.1,
            // Without bowl (3) and cup (7).
            (Preset::Linemod, 2 | 4..=6 | 8 | 10..=15) => 0.2,
            (Preset::Lmo, 1 | 9 | 10) => 0.2,
            (Preset::Lmo, 5 | 6 | 8 | 11 | 12) => 0.3,
            (Preset::Tless, 1..=30) => TLESS_THRESHOLDS[id as usize - 1],
            _ => return None,
        };
        Some(vec![one])
    }

    /// Smallest and largest fraction of an object that occluders hide in training (table 3.3). The dissertation gives no range for
    /// the entries to BOP; that of the datasets with occlusion is used.
    pub fn occlusion(self) -> [f32; 2] {
        match self {
            Preset::Linemod => [0.0, 0.1],
            Preset::Bop | Preset::Lmo | Preset::Tless => [0.04, 0.5],
        }
    }

    /// The object's information with the pool of symmetric poses of appendix A.1 instead of the stated symmetries. The pool's
    /// rotations are about axes through the centre of the object's bounding box. [`Preset::Bop`] keeps the stated symmetries.
    pub(crate) fn with_pool(self, id: u32, info: &ModelInfo) -> ModelInfo {
        let turns = match (self, id) {
            (Preset::Bop, _) => return info.clone(),
            (Preset::Linemod | Preset::Lmo, 10 | 11) => Turns::HalfZ,
            (Preset::Tless, 5..=12 | 25 | 26 | 28 | 29) => Turns::HalfZ,
            (Preset::Tless, 19 | 20) => Turns::HalfY,
            (Preset::Tless, 27) => Turns::QuarterZ,
            (Preset::Tless, 1..=4 | 13..=18 | 24 | 30) => Turns::AnyZ,
            _ => Turns::None,
        };
        let centre = info.min + 0.5 * info.size;
        let rotated = |axis: Vec3, angle: f64| {
            let turn = Pose::exp(&[0.0, 0.0, 0.0, angle * axis.x, angle * axis.y, angle * axis.z].into());
            Pose::from_translation(centre) * turn * Pose::from_translation(-centre)
        };
        let symmetries_discrete = match turns {
            Turns::None | Turns::AnyZ => vec![],
            Turns::HalfY => vec![rotated(Vec3::y(), PI)],
            Turns::HalfZ => vec![rotated(Vec3::z(), PI)],
            Turns::QuarterZ => [1.0, 2.0, 3.0].map(|n| rotated(Vec3::z(), n * FRAC_PI_2)).to_vec(),
        };
        let any = ContinuousSymmetry { axis: Vec3::z(), offset: centre };
        let symmetries_continuous = if turns == Turns::AnyZ { vec![any] } else { vec![] };
        ModelInfo { symmetries_discrete, symmetries_continuous, ..info.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn info() -> ModelInfo {
        ModelInfo {
            diameter: 0.2,
            min: Vec3::new(-0.01, 0.02, 0.0),
            size: Vec3::new(0.1, 0.06, 0.04),
            symmetries_discrete: vec![],
            symmetries_continuous: vec![],
        }
    }

    /// Appendix A.1 and tables A.2.1 to A.2.3, typed independently: id, fold of the symmetry (0: any rotation, -2: half a turn
    /// about y), threshold in tenths.
    const LINEMOD: &str =
        "1 1 1, 2 1 2, 4 1 2, 5 1 2, 6 1 2, 8 1 2, 9 1 1, 10 2 2, 11 2 2, 12 1 2, 13 1 2, 14 1 2, 15 1 2";
    const LMO: &str = "1 1 2, 5 1 3, 6 1 3, 8 1 3, 9 1 2, 10 2 2, 11 2 3, 12 1 3";
    const TLESS: &str = "1 0 1, 2 0 1, 3 0 1, 4 0 3, 5 2 2, 6 2 3, 7 2 3, 8 2 3, 9 2 3, 10 2 2, 11 2 3, 12 2 3, 13 0 2, \
         14 0 2, 15 0 2, 16 0 3, 17 0 3, 18 0 2, 19 -2 3, 20 -2 3, 21 1 2, 22 1 2, 23 1 3, 24 0 1, 25 2 3, 26 2 3, 27 4 3, \
         28 2 3, 29 2 3, 30 0 3";

    #[test]
    fn pools_and_thresholds_are_those_of_appendix_a() {
        for (preset, table) in [(Preset::Linemod, LINEMOD), (Preset::Lmo, LMO), (Preset::Tless, TLESS)] {
            let rows: Vec<Vec<i32>> = table
                .split(',')
                .map(|row| row.split_whitespace().map(|n| n.parse().unwrap()).collect())
                .collect();
            for id in 0..40 {
                let row = rows.iter().find(|row| row[0] == id as i32);
                let threshold = row.map(|row| vec![row[2] as f32 / 10.0]);
                assert_eq!(preset.thresholds(id), threshold, "{preset:?} {id}");
                let Some(row) = row else { continue };
                let pool = preset.with_pool(id, &info());
                let (discrete, continuous) = match row[1] {
                    0 => (0, 1),
                    -2 => (1, 0),
                    fold => (fold as usize - 1, 0),
                };
                let found = (pool.symmetries_discrete.len(), pool.symmetries_continuous.len());
                assert_eq!(found, (discrete, continuous), "{preset:?} {id}");
            }
        }
        assert_eq!(Preset::Bop.thresholds(77), Some(vec![0.15, 0.25, 0.35]));
        for &preset in Preset::ALL {
            assert_eq!(Preset::named(preset.name()), Some(preset));
        }
    }

    #[test]
    fn rotations_are_about_the_centre_of_the_box() {
        let info = info();
        let centre = info.min + 0.5 * info.size;
        let point = centre + Vec3::new(0.03, 0.01, 0.02);
        let moved = |preset: Preset, id, n: usize| {
            preset.with_pool(id, &info).symmetries_discrete[n].transform_point(&point) - centre
        };
        assert!((moved(Preset::Lmo, 10, 0) - Vec3::new(-0.03, -0.01, 0.02)).norm() < 1e-12);
        assert!((moved(Preset::Tless, 19, 0) - Vec3::new(-0.03, 0.01, -0.02)).norm() < 1e-12);
        assert!((moved(Preset::Tless, 27, 0) - Vec3::new(-0.01, 0.03, 0.02)).norm() < 1e-12);
        assert!((moved(Preset::Tless, 27, 2) - Vec3::new(0.01, -0.03, 0.02)).norm() < 1e-12);
        let any = Preset::Tless.with_pool(30, &info).symmetries_continuous[0];
        assert_eq!((any.axis, any.offset), (Vec3::z(), centre));
        // Only the preset of the challenge keeps the stated symmetries.
        let stated = ModelInfo { symmetries_discrete: vec![Pose::identity()], ..info.clone() };
        assert_eq!(Preset::Bop.with_pool(1, &stated), stated);
        assert_eq!(Preset::Lmo.with_pool(1, &stated), info);
    }
}
