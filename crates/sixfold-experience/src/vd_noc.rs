//! View-dependent normalised object coordinates, VD-NOC (dissertation, equation 6.1): the visible points of an object, shifted by
//! the centre of their extent and divided by half the extent, axis by axis, with z negated so that nearer points have larger
//! values.

use sixfold_geometry::Vec3;

/// The extent of an object in one view, which converts points to VD-NOC and back.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extent {
    /// The midpoint of the largest and smallest coordinates, metres, in the camera's frame.
    pub centre: Vec3,
    /// Half the difference between largest and smallest coordinates, metres, each positive.
    pub half: Vec3,
}

impl Extent {
    /// Lower bound of half extents, metres: a plane seen face-on has no thickness to divide by.
    const MIN_HALF: f64 = 0.002;

    /// The extent of points in metres. `trim` is the fraction of points that is left out at both ends of each axis (flying pixels):
    /// 0 for equation 6.1 as published. `None` without points.
    pub fn of(points: &[Vec3], trim: f64) -> Option<Extent> {
        if points.is_empty() {
            return None;
        }
        let cut = (trim.clamp(0.0, 0.49) * points.len() as f64) as usize;
        let mut low = Vec3::zeros();
        let mut high = Vec3::zeros();
        for axis in 0..3 {
            let mut values: Vec<f64> = points.iter().map(|p| p[axis]).collect();
            values.sort_by(f64::total_cmp);
            low[axis] = values[cut];
            high[axis] = values[values.len() - 1 - cut];
        }
        Some(Extent {
            centre: (low + high) * 0.5,
            half: ((high - low) * 0.5).sup(&Vec3::repeat(Self::MIN_HALF)),
        })
    }

    /// The VD-NOC of a point of the camera's frame; -1 to 1 for points within the extent.
    pub fn normalise(&self, point: &Vec3) -> Vec3 {
        let n = (point - self.centre).component_div(&self.half);
        Vec3::new(n.x, n.y, -n.z)
    }

    /// The point of a VD-NOC, metres.
    pub fn restore(&self, n: &Vec3) -> Vec3 {
        Vec3::new(n.x, n.y, -n.z).component_mul(&self.half) + self.centre
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equation_6_1_by_hand() {
        let points = [Vec3::new(0.1, -0.2, 1.0), Vec3::new(0.3, 0.2, 1.2), Vec3::new(0.15, 0.1, 1.05)];
        let extent = Extent::of(&points, 0.0).unwrap();
        assert!((extent.centre - Vec3::new(0.2, 0.0, 1.1)).norm() < 1e-12);
        // Every axis has its own factor, and the nearest point has z = +1.
        assert!((extent.normalise(&points[0]) - Vec3::new(-1.0, -1.0, 1.0)).norm() < 1e-12);
        assert!((extent.normalise(&points[1]) - Vec3::new(1.0, 1.0, -1.0)).norm() < 1e-12);
        assert!((extent.normalise(&points[2]) - Vec3::new(-0.5, 0.5, 0.5)).norm() < 1e-12);
        assert!((extent.restore(&extent.normalise(&points[2])) - points[2]).norm() < 1e-12);
    }

    #[test]
    fn flying_pixels_can_be_left_out_and_planes_do_not_divide_by_zero() {
        let mut points: Vec<Vec3> = (0..200).map(|i| Vec3::new(f64::from(i) * 1e-3, 0.0, 1.0)).collect();
        points.push(Vec3::new(5.0, 0.0, 1.0));
        assert!(Extent::of(&points, 0.01).unwrap().half.x < 0.11);
        assert!(Extent::of(&points, 0.0).unwrap().half.x > 2.0);
        assert!(Extent::of(&points, 0.0).unwrap().normalise(&points[3]).iter().all(|v| v.is_finite()));
        assert!(Extent::of(&[], 0.0).is_none());
    }
}
