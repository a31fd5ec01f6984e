//! Symmetries of scanned and reconstructed objects, if they are available (`SIXFOLD_DATA`, or `../shared/data` beside the
//! workspace). The expected symmetries were read from the images of `sixfold object symmetries --out`.

mod support;

use std::path::Path;

use sixfold_geometry::Vec3;
use sixfold_mesh::{FoundSymmetry, ModelsInfo, SymmetryOptions, Unit, Verdict, find_symmetries, read_mesh};

use support::data;

fn find(path: &Path, unit: Unit, noise: f64) -> Vec<FoundSymmetry> {
    let mesh = read_mesh(path, unit).unwrap_or_else(|error| panic!("{error}"));
    let start = std::time::Instant::now();
    let found = find_symmetries(&mesh, &SymmetryOptions { noise, ..SymmetryOptions::default() }).unwrap();
    eprintln!("{}: {} faces, {:?}", path.display(), mesh.faces().len(), start.elapsed());
    for s in &found {
        eprintln!(
            "  order {:?} about {:?}, 95 % within {:.2} mm, max {:.2} mm, colours {:?}: {}, {}",
            s.order,
            s.axis.data.0[0],
            1e3 * s.deviation.p95,
            1e3 * s.deviation.max,
            s.color.map(|c| c.p95),
            s.by_shape.name(),
            s.by_shape_and_color.name()
        );
    }
    found
}

/// The angle between two lines, degrees.
fn degrees(a: &Vec3, b: &Vec3) -> f64 {
    a.cross(b).norm().atan2(a.dot(b).abs()).to_degrees()
}

#[test]
fn models_of_lmo_have_the_symmetries_of_their_models_info() {
    let Some(data) = data() else { return };
    let infos = ModelsInfo::read(data.join("lmo/models/models_info.json")).unwrap();
    let mut symmetric = 0;
    for id in [1, 5, 6, 8, 9, 10, 11, 12] {
        let info = &infos.0[&id];
        for noise in [0.0, 0.001] {
            let found = find(&data.join(format!("lmo/models/obj_{id:06}.ply")), Unit::Millimetre, noise);
            assert!(info.symmetries_continuous.is_empty());
            assert_eq!(found.len(), info.symmetries_discrete.len(), "object {id}: {found:#?}");
            for (s, truth) in found.iter().zip(&info.symmetries_discrete) {
                // Reconstructed from depth images, and a knob on one side: proposed, not stored.
                assert!(s.order == Some(2) && s.by_shape >= Verdict::Likely, "object {id}: {s:?}");
                let axis = truth.rotation().axis().unwrap();
                let angle = degrees(&s.axis, &axis);
                // The difference of both half turns at the object's centroid.
                let off = (truth.transform_point(&s.point) - s.point).norm() / 2.0;
                eprintln!(
                    "object {id}: axis {angle:.2} degrees and {:.2} mm from that of the file",
                    1e3 * off
                );
                assert!(angle < 1.5 && off < 0.003, "object {id}: {angle} degrees, {off} m");
                symmetric += 1;
            }
        }
    }
    assert_eq!(symmetric, 4);
}

/// The symmetry of a scanned object's shape, as inspected: continuous about z, or half turns about this many axes.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Seen {
    Nothing,
    Round,
    /// Round, and the same upside down.
    Can,
    HalfTurns(usize),
}

fn check(name: &str, found: &[FoundSymmetry], seen: Seen) {
    let sure: Vec<&FoundSymmetry> = found.iter().filter(|s| s.by_shape == Verdict::Sure).collect();
    let about_z = |s: &&&FoundSymmetry| degrees(&s.axis, &Vec3::z()) < 2.5;
    let (round, half): (Vec<&FoundSymmetry>, Vec<&FoundSymmetry>) =
        sure.iter().partition(|s| s.order.is_none());
    assert!(half.iter().all(|s| s.order == Some(2)), "{name}: {found:#?}");
    let (rounds, halves) = match seen {
        Seen::Nothing => (0, 0),
        Seen::Round => (1, 0),
        Seen::Can => (1, 1),
        Seen::HalfTurns(n) => (0, n),
    };
    assert_eq!((round.len(), half.len()), (rounds, halves), "{name}: {found:#?}");
    assert_eq!(round.iter().filter(about_z).count(), rounds, "{name}: {found:#?}");
}

#[test]
fn scanned_bowls_are_round_and_mugs_are_not() {
    let Some(data) = data() else { return };
    let objects = [
        ("akita_black_bowl", Seen::Round),
        ("glazed_rim_porcelain_ramekin", Seen::Round),
        ("plate", Seen::Round),
        ("white_bowl", Seen::Round),
        ("libero_mug", Seen::Nothing),
        ("porcelain_mug", Seen::Nothing),
        ("red_coffee_mug", Seen::Nothing),
        ("white_yellow_mug", Seen::Nothing),
    ];
    for (name, seen) in objects {
        let unit = if name == "libero_mug" { Unit::Centimetre } else { Unit::Metre };
        for noise in [0.0, 0.001] {
            let found = find(&data.join("meshes").join(name).join("textured.obj"), unit, noise);
            check(name, &found, seen);
            // A mug is not even nearly symmetric.
            assert!(seen != Seen::Nothing || found.is_empty(), "{name}: {found:#?}");
            // Its swirls have different sizes.
            let with_color = found.iter().filter(|s| s.by_shape_and_color == Verdict::Sure).count();
            match name {
                "akita_black_bowl" => assert_eq!(with_color, 0, "{found:#?}"),
                "white_bowl" | "glazed_rim_porcelain_ramekin" => assert_eq!(with_color, 1, "{found:#?}"),
                _ => {}
            }
        }
    }
}

#[test]
fn scanned_household_objects() {
    let Some(data) = data() else { return };
    let objects = [
        ("Banana", Seen::Nothing),
        // Three holes in one side: only half turns about its normal.
        ("FoamBrick", Seen::HalfTurns(1)),
        ("GelatinBox", Seen::HalfTurns(3)),
        ("MasterChefCan", Seen::Can),
        ("MustardBottle", Seen::HalfTurns(1)),
        // Wider at the lid than at the bottom.
        ("PottedMeatCan", Seen::HalfTurns(1)),
        ("PowerDrill", Seen::Nothing),
        // One loop of the handle is longer: likely at most.
        ("Scissors", Seen::Nothing),
    ];
    for (name, seen) in objects {
        let found = find(&data.join("meshes/ycb").join(name).with_extension("ply"), Unit::Millimetre, 0.001);
        check(name, &found, seen);
    }
    // A carton with bulging sides and a dented can: proposed.
    for (name, count) in [("CrackerBox", 3), ("TomatoSoupCan", 2)] {
        let found = find(&data.join("meshes/ycb").join(name).with_extension("ply"), Unit::Millimetre, 0.001);
        assert_eq!(found.len(), count, "{name}: {found:#?}");
        assert_eq!(found.iter().filter(|s| s.order.is_none()).count(), usize::from(name == "TomatoSoupCan"));
    }
}
