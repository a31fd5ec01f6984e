//! The motion of the camera between two photographs from an essential matrix (Hartley and Zisserman 2004, section 9.6), and its
//! refinement by Sampson's error (equation 11.9) over all inliers.

use sixfold_geometry::nalgebra::{Matrix5, Rotation3, UnitQuaternion, Vector5};
use sixfold_geometry::{Mat3, Pose, Vec2, Vec3};

/// The essential matrix of a motion.
pub(crate) fn essential(motion: &Pose) -> Mat3 {
    let t = motion.translation();
    Mat3::new(0.0, -t.z, t.y, t.z, 0.0, -t.x, -t.y, t.x, 0.0) * motion.rotation_matrix()
}

/// Sampson's signed error, on the planes `z = 1`.
pub(crate) fn sampson(e: &Mat3, (a, b): &(Vec2, Vec2)) -> f64 {
    let (a, b) = (a.push(1.0), b.push(1.0));
    let (line, back) = (e * a, e.tr_mul(&b));
    let slope = line.xy().norm_squared() + back.xy().norm_squared();
    b.dot(&line) / slope.max(1e-300).sqrt()
}

/// The depths of a point in both cameras, at the nearest points of the rays; `None` for parallel rays.
fn depths(motion: &Pose, (a, b): &(Vec2, Vec2)) -> Option<(f64, f64)> {
    // d2 b = d1 R a + t, by least squares.
    let (u, v, t) = (motion.transform_direction(&a.push(1.0)), b.push(1.0), motion.translation());
    let (uu, uv, vv) = (u.norm_squared(), u.dot(&v), v.norm_squared());
    let determinant = uu * vv - uv * uv;
    if !(determinant > 1e-14 * uu * vv) {
        return None;
    }
    let (ut, vt) = (u.dot(&t), v.dot(&t));
    Some(((uv * vt - vv * ut) / determinant, (uu * vt - uv * ut) / determinant))
}

/// Number of points in front of both cameras.
pub(crate) fn before_both(motion: &Pose, pairs: &[(Vec2, Vec2)]) -> usize {
    pairs
        .iter()
        .filter(|p| depths(motion, p).is_some_and(|(first, second)| first > 0.0 && second > 0.0))
        .count()
}

/// The angle between the two rays to a point, radians.
pub(crate) fn parallax(motion: &Pose, (a, b): &(Vec2, Vec2)) -> f64 {
    let (u, v) = (motion.transform_direction(&a.push(1.0)), b.push(1.0));
    u.cross(&v).norm().atan2(u.dot(&v))
}

/// The one of the four motions of an essential matrix with most points in front of both cameras; its translation has length 1.
pub(crate) fn motion_of(e: &Mat3, pairs: &[(Vec2, Vec2)]) -> Option<Pose> {
    let svd = e.svd(true, true);
    let (mut u, mut v) = (svd.u?, svd.v_t?);
    // Sort so that the smallest singular value is last.
    let mut order = [0, 1, 2];
    order.sort_by(|a, b| svd.singular_values[*b].total_cmp(&svd.singular_values[*a]));
    u = Mat3::from_columns(&order.map(|i| u.column(i).into_owned()));
    v = Mat3::from_rows(&order.map(|i| v.row(i).into_owned()));
    if u.determinant() < 0.0 {
        u = -u;
    }
    if v.determinant() < 0.0 {
        v = -v;
    }
    let w = Mat3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    let t: Vec3 = u.column(2).into_owned();
    let rotation =
        |w: &Mat3| UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(u * w * v));
    let (r1, r2) = (rotation(&w), rotation(&w.transpose()));
    [Pose::new(r1, t), Pose::new(r1, -t), Pose::new(r2, t), Pose::new(r2, -t)]
        .into_iter()
        .map(|motion| (before_both(&motion, pairs), motion))
        .reduce(|best, other| if other.0 > best.0 { other } else { best })
        .map(|(_, motion)| motion)
}

fn moved(motion: &Pose, step: &Vector5<f64>) -> Pose {
    let t = motion.translation();
    let axis = if t.x.abs() < 0.6 { Vec3::x() } else { Vec3::y() };
    let u = t.cross(&axis).normalize();
    let v = t.cross(&u);
    let rotation = UnitQuaternion::from_scaled_axis(Vec3::new(step[0], step[1], step[2])) * motion.rotation();
    Pose::new(rotation, (t + u * step[3] + v * step[4]).normalize())
}

/// The motion near a start with the smallest sum of squared Sampson errors, each counted up to `limit` (Levenberg-Marquardt).
pub(crate) fn refined(start: &Pose, pairs: &[(Vec2, Vec2)], limit: f64, iterations: usize) -> Pose {
    let cost = |motion: &Pose| {
        let e = essential(motion);
        pairs.iter().map(|p| sampson(&e, p).powi(2).min(limit * limit)).sum::<f64>()
    };
    let (mut motion, mut now, mut damping) = (*start, cost(start), 1e-4);
    for _ in 0..iterations {
        let step = |k: usize, size: f64| {
            let mut s = Vector5::zeros();
            s[k] = size;
            essential(&moved(&motion, &s))
        };
        let size = 1e-6;
        let changed: [(Mat3, Mat3); 5] = std::array::from_fn(|k| (step(k, size), step(k, -size)));
        let e = essential(&motion);
        let (mut h, mut g) = (Matrix5::zeros(), Vector5::zeros());
        for pair in pairs {
            let r = sampson(&e, pair);
            if r.abs() >= limit {
                continue;
            }
            let j = Vector5::from_fn(|k, _| {
                (sampson(&changed[k].0, pair) - sampson(&changed[k].1, pair)) / (2.0 * size)
            });
            h += j * j.transpose();
            g += j * r;
        }
        let mut better = false;
        while damping < 1e6 {
            let damped = h + Matrix5::from_diagonal(&h.diagonal()) * damping + Matrix5::identity() * 1e-15;
            let next = damped.cholesky().map(|c| moved(&motion, &c.solve(&-g)));
            if let Some((next, then)) = next.map(|n| (n, cost(&n))).filter(|(_, then)| *then < now) {
                better = now - then > 1e-9 * now;
                (motion, now) = (next, then);
                damping = (0.2 * damping).max(1e-12);
                break;
            }
            damping *= 10.0;
        }
        if !better {
            break;
        }
    }
    motion
}
