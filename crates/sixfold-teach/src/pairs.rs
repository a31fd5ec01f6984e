//! A photograph's pose from points that a person marked: three with AP3P (Ke and Roumeliotis 2017), more with RANSAC over it.

use sixfold_geometry::{Camera, PnpOptions, Pose, Vec2, Vec3, p3p, pnp_ransac};

use crate::error::TeachError;

/// Largest error of a marked point, in pixels of an image of 1000 pixels.
const CLICK: f64 = 8.0;
/// Two poses whose camera centres are nearer than this are the same, metres.
const SAME: f64 = 1e-3;

/// The pose of a photograph from points of the board's frame (metres) and their marked pixels in its pinhole camera. Three points
/// allow up to four poses: the one nearest to `near` is taken, if `near` is given, otherwise the only one above the board.
///
/// # Errors
/// [`TeachError::Pairs`].
pub fn pose_of_points(
    points: &[Vec3],
    pixels: &[Vec2],
    camera: &Camera,
    near: Option<&Pose>,
) -> Result<Pose, TeachError> {
    let refused = |what: String| TeachError::Pairs { what };
    if points.len() != pixels.len() || points.len() < 3 {
        let (n, m) = (points.len(), pixels.len());
        return Err(refused(format!("found {n} points and {m} pixels, expected three pairs or more")));
    }
    let finite = points.iter().all(|p| p.iter().all(|v| v.is_finite()))
        && pixels.iter().all(|p| p.x.is_finite() && p.y.is_finite());
    if !finite {
        return Err(refused("found a number that is not finite, expected metres and pixels".to_owned()));
    }
    let nothing = || {
        let what = "no pose explains these points: expected points that are not collinear, each at its own \
             pixel";
        refused(what.to_owned())
    };
    let ([a, b, c], [u, v, w]) = (points, pixels) else {
        let threshold_px = CLICK * camera.width.max(camera.height) as f64 / 1000.0;
        let options = PnpOptions { threshold_px, ..PnpOptions::default() };
        let found = pnp_ransac(points, pixels, camera, &options).map_err(|_| nothing())?;
        return Ok(found.camera_from_object);
    };
    let rays = [u, v, w].map(|pixel| camera.unproject(pixel, 1.0));
    let mut poses = p3p(&rays, &[*a, *b, *c]);
    let eye = |pose: &Pose| pose.inverse().translation();
    if let Some(near) = near {
        let far = |pose: &Pose| (eye(pose) - eye(near)).norm() + 0.3 * pose.rotation_angle_to(near);
        return poses.into_iter().min_by(|a, b| far(a).total_cmp(&far(b))).ok_or_else(nothing);
    }
    poses.retain(|pose| eye(pose).z > 0.0);
    let first = *poses.first().ok_or_else(nothing)?;
    if poses.iter().any(|pose| (eye(pose) - eye(&first)).norm() > SAME) {
        return Err(refused(format!("three points allow {} poses: mark a fourth point", poses.len())));
    }
    Ok(first)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::looking_at;

    #[test]
    fn marked_points_give_the_pose() {
        let camera = Camera::new(600.0, 600.0, 320.0, 240.0, 640, 480).unwrap();
        let truth = looking_at(&Vec3::new(0.0, 0.0, 0.03), 40.0, 35.0, 0.5, 5.0);
        let points =
            [[0.0, 0.0, 0.0], [0.08, 0.01, 0.0], [-0.02, 0.07, 0.05], [0.03, -0.06, 0.09]].map(Vec3::from);
        let pixels = points.map(|p| camera.project(&truth.transform_point(&p)).unwrap());
        let near = looking_at(&Vec3::new(0.01, 0.0, 0.03), 30.0, 40.0, 0.55, 0.0);
        let found = pose_of_points(&points[..3], &pixels[..3], &camera, Some(&near)).unwrap();
        assert!(found.distance_to(&truth) < 1e-6 && found.rotation_angle_to(&truth) < 1e-6);
        // People do not mark pixels exactly.
        let rough = pixels.map(|p| p + Vec2::new(0.7, -0.4));
        let found = pose_of_points(&points, &rough, &camera, None).unwrap();
        assert!(found.distance_to(&truth) < 0.01 && found.rotation_angle_to(&truth) < 0.02);
        // Without a nearby pose, three points give a pose or an error.
        match pose_of_points(&points[..3], &pixels[..3], &camera, None) {
            Ok(found) => assert!(found.distance_to(&truth) < 1e-6),
            Err(error) => assert!(error.to_string().contains("fourth"), "{error}"),
        }
        let line = [0.0, 1.0, 2.0].map(|x| Vec3::new(0.03 * x, 0.0, 0.0));
        for (points, pixels) in [(&line[..], &pixels[..3]), (&points[..2], &pixels[..2])] {
            assert!(matches!(pose_of_points(points, pixels, &camera, None), Err(TeachError::Pairs { .. })));
        }
        let broken = [Vec2::new(f64::NAN, 0.0), pixels[1], pixels[2]];
        assert!(pose_of_points(&points[..3], &broken, &camera, None).is_err());
    }
}
