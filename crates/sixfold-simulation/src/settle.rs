//! The pose at which an object comes to rest on the table.

use sixfold_geometry::{Pose, Vec3};
use sixfold_mesh::Mesh;

use crate::ConvexParts;
use crate::world::{body_pose, insert_object, world};

/// Lets an object fall onto the table from a pose above it (its lowest point starts 2 mm above the table) and returns its pose at
/// rest; `None` when it still moves after four seconds or rolled further than half a metre. Its rotation is damped, so that round
/// objects do not roll forever.
pub(crate) fn settle(parts: &ConvexParts, world_from_object: &Pose) -> Option<Pose> {
    const STEP: f64 = 0.002;
    let lowest = parts
        .parts()
        .iter()
        .flatten()
        .map(|p| world_from_object.transform_point(p).z)
        .fold(f64::INFINITY, f64::min);
    let start =
        world_from_object.with_translation(world_from_object.translation() + Vec3::z() * (0.002 - lowest));
    let mut world = world(STEP, 60.0, 0.8);
    let (object, _) = insert_object(&mut world, parts, &start, 0.2, 4.0);
    // A body with many contacts jitters and creeps by micrometres per step forever: the test is its motion over 0.2 s.
    let mut last = start;
    for _ in 0..20 {
        for _ in 0..100 {
            world.step();
        }
        let pose = body_pose(&world, object);
        if pose.distance_to(&last) < 0.001 && pose.rotation_angle_to(&last) < 0.01 {
            let there = pose.translation() - start.translation();
            return (there.xy().norm() < 0.5 && pose.translation().z > -0.1).then_some(pose);
        }
        last = pose;
    }
    None
}

/// As `settle`, with the mesh from which the parts were made; the object is then moved back to the centre of the table.
pub fn settle_at_centre(mesh: &Mesh, parts: &ConvexParts, world_from_object: &Pose) -> Option<Pose> {
    let rest = settle(parts, world_from_object)?;
    let (low, high) = mesh.transformed(&rest).bounding_box();
    let centre = (low + high) * 0.5;
    Some(rest.with_translation(rest.translation() - Vec3::new(centre.x, centre.y, 0.0)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_synth::primitives as shapes;

    #[test]
    fn a_tilted_box_comes_to_lie_on_a_side() {
        let parts = ConvexParts::of_convex(&shapes::cuboid(Vec3::new(0.1, 0.06, 0.04)).unwrap()).unwrap();
        let tilted = Pose::exp(&[0.0, 0.0, 0.2, 0.3, 0.1, 0.5].into());
        let rest = settle(&parts, &tilted).unwrap();
        assert!((rest.translation().z - 0.02).abs() < 0.001, "{:?}", rest.translation());
        assert!(rest.transform_direction(&Vec3::z()).z > 0.999);
        assert_eq!(settle(&parts, &tilted).unwrap(), rest);
    }
}
