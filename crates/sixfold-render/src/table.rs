//! The table under a set of posed objects: the plane that most of them touch from above. Ground truth of real scenes contains
//! the objects but not the table; simulated depth needs both.

use sixfold_geometry::{Camera, DepthImage, Plane, Pose, Vec2, Vec3, sphere_directions};
use sixfold_mesh::Mesh;

use crate::raster::{RenderOptions, SceneObject, VisibilityBuffer};
use crate::sensor::{DepthSensor, simulate_depth};

/// Limit of the gap between an object and the plane, metres. Larger gaps count the same: the object does not stand on the plane.
const GAP_LIMIT: f64 = 0.02;

/// The plane most objects stand on, in the camera frame, its normal up (to the side of the objects). The camera is assumed to be
/// upright (its y axis points down, within 80 degrees) and above the table. `None` when there is no object.
pub fn support_plane(objects: &[SceneObject<'_>]) -> Option<Plane> {
    let directions = sphere_directions(1500);
    // The relevant points: each object's extreme vertices over many directions.
    let extremes: Vec<Vec<Vec3>> = objects
        .iter()
        .map(|o| {
            let points: Vec<Vec3> =
                o.mesh.vertices().iter().map(|v| o.camera_from_object.transform_point(v)).collect();
            let mut chosen: Vec<usize> = directions
                .iter()
                .step_by(3)
                .map(|d| {
                    (0..points.len())
                        .min_by(|&a, &b| d.dot(&points[a]).total_cmp(&d.dot(&points[b])))
                        .unwrap_or(0)
                })
                .collect();
            chosen.sort_unstable();
            chosen.dedup();
            chosen.into_iter().map(|i| points[i]).collect()
        })
        .collect();
    if extremes.is_empty() {
        return None;
    }
    let judge = |n: &Vec3| -> (f64, f64) {
        let lowest: Vec<f64> = extremes
            .iter()
            .map(|points| points.iter().map(|p| n.dot(p)).fold(f64::INFINITY, f64::min))
            .collect();
        lowest
            .iter()
            .map(|&offset| {
                let cost = lowest.iter().map(|h| (h - offset).abs().min(GAP_LIMIT)).sum::<f64>();
                (cost, offset)
            })
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .unwrap_or((f64::INFINITY, 0.0))
    };
    // Up in the image and, as the camera looks down on the table, towards the camera.
    let plausible = |n: &Vec3, offset: f64| n.y < -0.17 && offset < -0.02;
    let mut best: Option<(f64, Vec3, f64)> = None;
    let consider = |n: Vec3, best: &mut Option<(f64, Vec3, f64)>| {
        let (cost, offset) = judge(&n);
        if plausible(&n, offset) && best.is_none_or(|b| cost < b.0) {
            *best = Some((cost, n, offset));
        }
    };
    for n in &directions {
        consider(*n, &mut best);
    }
    let mut reach = 0.06;
    while reach > 2e-4 {
        let (_, centre, _) = best?;
        let u = centre.cross(&Vec3::x()).normalize();
        let v = centre.cross(&u);
        for i in -3..=3 {
            for j in -3..=3 {
                let n = centre + u * (reach * f64::from(i) / 3.0) + v * (reach * f64::from(j) / 3.0);
                consider(n.normalize(), &mut best);
            }
        }
        reach *= 0.5;
    }
    best.map(|(_, normal, offset)| Plane { normal, offset })
}

/// A square of the plane as a mesh in the camera frame, `size` metres wide, centred where the camera's axis meets it.
pub(crate) fn plane_mesh(plane: &Plane, camera: &Camera, size: f64) -> Option<Mesh> {
    let ray = camera.unproject(&Vec2::new(camera.width as f64 / 2.0, camera.height as f64 / 2.0), 1.0);
    let along = plane.normal.dot(&ray);
    let centre = if along.abs() > 1e-6 { ray * (plane.offset / along) } else { plane.normal * plane.offset };
    let u = plane.normal.cross(&Vec3::x()).try_normalize(1e-9)? * (size / 2.0);
    let v = plane.normal.cross(&u);
    let corners = vec![centre - u - v, centre + u - v, centre + u + v, centre - u + v];
    Mesh::new(corners, vec![[0, 1, 2], [0, 2, 3]]).ok()
}

/// Width of the table of [`depth_on_table`], metres.
const TABLE: f64 = 3.0;

/// The depth of objects, on a table if there is one.
pub struct DepthOnTable {
    /// Ideal depth, without noise.
    pub ideal: DepthImage,
    /// Depth as the depth camera measures it.
    pub measured: DepthImage,
    /// Whether there is a table: it was requested, and there is a plane under the objects.
    pub has_table: bool,
}

/// Simulated depth of posed objects, on a table if requested; `sensor` is the camera's noise with a seed.
pub fn depth_on_table(
    posed: &[(&Mesh, Pose)],
    camera: &Camera,
    with_table: bool,
    sensor: Option<(&DepthSensor, u64)>,
) -> DepthOnTable {
    let mut objects: Vec<SceneObject<'_>> =
        posed.iter().map(|(mesh, pose)| SceneObject { mesh, camera_from_object: *pose }).collect();
    let plane = if with_table { support_plane(&objects) } else { None };
    let table = plane.and_then(|p| plane_mesh(&p, camera, TABLE));
    if let Some(mesh) = &table {
        objects.push(SceneObject { mesh, camera_from_object: Pose::identity() });
    }
    let mut frame = VisibilityBuffer::new(camera);
    frame.render(&objects, &RenderOptions { parallel: true, ..RenderOptions::default() });
    let ideal = frame.depth();
    let measured = match sensor {
        None => ideal.clone(),
        Some((sensor, seed)) => simulate_depth(&ideal, &frame.normals(&objects), sensor, seed),
    };
    DepthOnTable { ideal, measured, has_table: table.is_some() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cube() -> Mesh {
        let vertices = (0..8)
            .map(|k| Vec3::new(f64::from(k & 1), f64::from(k >> 1 & 1), f64::from(k >> 2 & 1)) * 0.1)
            .collect();
        Mesh::new(vertices, vec![[0, 1, 3]]).unwrap()
    }

    #[test]
    fn cubes_on_a_tilted_table() {
        let mesh = cube();
        // Table frame: z up; the camera looks down at 45 degrees.
        let camera_from_table = Pose::from_translation(Vec3::new(0.0, 0.0, 1.0))
            * Pose::exp(&[0.0, 0.0, 0.0, 0.75 * std::f64::consts::PI, 0.0, 0.0].into());
        let up = camera_from_table.transform_direction(&Vec3::z());
        assert!(up.y < -0.5 && up.z < -0.5, "{up:?}");
        let spots = [(0.0, 0.0), (0.3, 0.1), (-0.2, 0.25), (0.1, -0.3)];
        let objects: Vec<_> = spots
            .iter()
            .map(|&(x, y)| SceneObject {
                mesh: &mesh,
                camera_from_object: camera_from_table * Pose::exp(&[x, y, 0.0, 0.0, 0.0, x].into()),
            })
            .collect();
        let plane = support_plane(&objects).unwrap();
        assert!(plane.normal.dot(&up) > 0.9999, "{plane:?} {up:?}");
        assert!((plane.offset - up.dot(&camera_from_table.translation())).abs() < 0.001);
        assert!(support_plane(&[]).is_none());
    }
}
