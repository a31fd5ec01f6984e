//! The symmetries that follow from the construction of a family's members are found in their meshes.

use sixfold_geometry::Vec3;
use sixfold_geometry::random::stream;
use sixfold_mesh::{FoundSymmetry, SymmetryOptions, Verdict, find_symmetries};
use sixfold_synth::shapes::{Family, member};

/// The angle between two lines, degrees.
fn degrees(a: &Vec3, b: &Vec3) -> f64 {
    a.cross(b).norm().atan2(a.dot(b).abs()).to_degrees()
}

#[test]
fn families_have_the_symmetries_of_their_construction() {
    for family in Family::ALL {
        for number in 0..3 {
            let member = member(family, &mut stream(5, number)).unwrap();
            let info = member.info();
            let found = find_symmetries(&member.mesh, &SymmetryOptions::default()).unwrap();
            let sure: Vec<&FoundSymmetry> = found.iter().filter(|s| s.by_shape == Verdict::Sure).collect();
            let name = format!("{} {number}", family.name());
            if !info.is_symmetric() {
                assert!(sure.is_empty(), "{name}: {sure:#?}");
            }
            for axis in &info.symmetries_continuous {
                let same = |s: &&&FoundSymmetry| s.order.is_none() && degrees(&s.axis, &axis.axis) < 0.5;
                let s = sure.iter().find(same).unwrap_or_else(|| panic!("{name}: {found:#?}"));
                assert!((s.point - axis.offset).cross(&axis.axis).norm() < 5e-4, "{name}: {s:?}");
            }
            for pose in &info.symmetries_discrete {
                let axis = pose.rotation().axis().unwrap();
                // An even order, or any rotation, includes a half turn.
                let holds = |s: &&&FoundSymmetry| {
                    s.order.is_none_or(|n| n.is_multiple_of(2)) && degrees(&s.axis, &axis) < 0.5
                };
                let s = sure.iter().find(holds).unwrap_or_else(|| panic!("{name}: {pose:?} {found:#?}"));
                assert!((pose.transform_point(&s.point) - s.point).norm() < 1e-3, "{name}: {s:?}");
            }
            eprintln!("{name}: {} sure of {} found", sure.len(), found.len());
        }
    }
}
