//! From which sides images show an object (dissertation, table 4.2).

use serde::Serialize;
use sixfold_geometry::Pose;

/// The images of an object, and the directions of the camera as seen from it. Angles are in degrees, in the object's frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ViewRange {
    /// Number of its poses.
    pub images: usize,
    /// The smallest interval with all azimuths about the z axis, from the x axis: it starts at -180 or later and below 180, and may
    /// end above 180. `[-180, 180]` where no gap is wider than 15 degrees.
    pub azimuth: [f64; 2],
    /// The smallest and largest elevation over the xy plane.
    pub elevation: [f64; 2],
}

/// A wider gap between neighbouring azimuths, degrees, means that not all of the circle is seen. Chosen by hand; not swept.
const MAX_GAP: f64 = 15.0;

impl ViewRange {
    /// The range of these poses; `None` without any.
    pub fn of(camera_from_object: &[Pose]) -> Option<ViewRange> {
        let mut azimuths = vec![];
        let mut elevation = [f64::INFINITY, f64::NEG_INFINITY];
        for pose in camera_from_object {
            let camera = pose.inverse().translation();
            azimuths.push(camera.y.atan2(camera.x).to_degrees());
            let over = camera.z.atan2(camera.x.hypot(camera.y)).to_degrees();
            elevation = [elevation[0].min(over), elevation[1].max(over)];
        }
        azimuths.sort_by(f64::total_cmp);
        let (first, last) = (*azimuths.first()?, *azimuths.last()?);
        // The interval is what the widest gap leaves of the circle; at first that from the last azimuth to the first.
        let (mut widest, mut azimuth) = (first + 360.0 - last, [first, last]);
        for pair in azimuths.windows(2) {
            if pair[1] - pair[0] > widest {
                (widest, azimuth) = (pair[1] - pair[0], [pair[1], pair[0] + 360.0]);
            }
        }
        if widest <= MAX_GAP {
            azimuth = [-180.0, 180.0];
        }
        Some(ViewRange { images: camera_from_object.len(), azimuth, elevation })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::Vec3;

    fn seen_from(azimuth: f64, elevation: f64) -> Pose {
        let (a, e) = (azimuth.to_radians(), elevation.to_radians());
        let camera = Vec3::new(a.cos() * e.cos(), a.sin() * e.cos(), e.sin()) * 0.8;
        // Its orientation is of no account.
        Pose::from_translation(-camera)
    }

    fn range(azimuths: &[f64]) -> [f64; 2] {
        let poses: Vec<Pose> = azimuths.iter().map(|a| seen_from(*a, 20.0)).collect();
        ViewRange::of(&poses).unwrap().azimuth.map(|a| (1e6 * a).round() / 1e6)
    }

    #[test]
    fn intervals_of_azimuths_may_cross_180_degrees() {
        assert_eq!(range(&[10.0, -30.0, 50.0]), [-30.0, 50.0]);
        assert_eq!(range(&[170.0, -170.0, 150.0]), [150.0, 190.0]);
        assert_eq!(range(&[42.0]), [42.0, 42.0]);
        let around: Vec<f64> = (0..36).map(|k| 10.0 * f64::from(k) - 175.0).collect();
        assert_eq!(range(&around), [-180.0, 180.0]);
        assert_eq!(range(&around[..30]), [-175.0, 115.0]);
    }

    #[test]
    fn elevations_are_over_the_xy_plane() {
        let poses = [seen_from(0.0, 8.0), seen_from(90.0, 42.0), seen_from(20.0, -5.0)];
        let found = ViewRange::of(&poses).unwrap();
        assert_eq!(found.images, 3);
        assert!((found.elevation[0] + 5.0).abs() < 1e-9 && (found.elevation[1] - 42.0).abs() < 1e-9);
        assert!(ViewRange::of(&[]).is_none());
    }
}
