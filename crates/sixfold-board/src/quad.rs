//! Quadrangles around dark regions, and their corners with subpixel accuracy.

use sixfold_geometry::{Image, Vec2};

/// Shortest side of a tag, pixels: fewer than one and a half pixels per cell cannot be read.
const SHORTEST: f64 = 11.0;
/// The quadrangle may be larger than the convex hull by this fraction: corners are rounded by blur.
const ADDED_AREA: f64 = 0.25;

/// Corners clockwise as seen.
pub(crate) type Quad = [Vec2; 4];

fn cross(a: Vec2, b: Vec2) -> f64 {
    a.x * b.y - a.y * b.x
}

/// Convex hull, clockwise as seen with y down (Andrew 1979).
pub(crate) fn convex_hull(points: &mut Vec<(i32, i32)>) -> Vec<Vec2> {
    points.sort_unstable();
    points.dedup();
    let turn = |a: (i32, i32), b: (i32, i32), c: (i32, i32)| {
        i64::from(b.0 - a.0) * i64::from(c.1 - a.1) - i64::from(b.1 - a.1) * i64::from(c.0 - a.0)
    };
    let half = |points: &mut dyn Iterator<Item = (i32, i32)>| {
        let mut hull: Vec<(i32, i32)> = vec![];
        for p in points {
            while hull.len() >= 2 && turn(hull[hull.len() - 2], hull[hull.len() - 1], p) <= 0 {
                hull.pop();
            }
            hull.push(p);
        }
        hull.pop();
        hull
    };
    let mut hull = half(&mut points.iter().copied());
    hull.extend(half(&mut points.iter().rev().copied()));
    hull.iter().map(|p| Vec2::new(f64::from(p.0), f64::from(p.1))).collect()
}

fn area(polygon: &[Vec2]) -> f64 {
    0.5 * (0..polygon.len()).map(|i| cross(polygon[i], polygon[(i + 1) % polygon.len()])).sum::<f64>()
}

fn intersection(a: Vec2, along_a: Vec2, b: Vec2, along_b: Vec2) -> Option<Vec2> {
    let det = cross(along_a, along_b);
    let scale = along_a.norm() * along_b.norm();
    (det.abs() > 1e-3 * scale).then(|| a + along_a * (cross(b - a, along_b) / det))
}

/// The quadrangle around a convex polygon: sides are removed one by one, each time the side whose removal adds the smallest area;
/// `None` if the result does not have the shape of a tag.
pub(crate) fn around(hull: &[Vec2]) -> Option<Quad> {
    let mut polygon = hull.to_vec();
    let before = area(&polygon);
    if polygon.len() < 4 || !(before > 0.5 * SHORTEST * SHORTEST) {
        return None;
    }
    while polygon.len() > 4 {
        let n = polygon.len();
        let mut best: Option<(f64, usize, Vec2)> = None;
        for i in 0..n {
            // The side from i to i + 1 is removed; the sides before and after it are extended until they meet.
            let (a, b, c, d) =
                (polygon[(i + n - 1) % n], polygon[i], polygon[(i + 1) % n], polygon[(i + 2) % n]);
            let Some(meet) = intersection(b, b - a, c, c - d) else { continue };
            // The intersection has to be beyond both ends; otherwise the sides diverge.
            if (meet - b).dot(&(b - a)) < 0.0 || (meet - c).dot(&(c - d)) < 0.0 {
                continue;
            }
            let added = 0.5 * cross(meet - b, c - b).abs();
            if best.is_none_or(|(minimum, ..)| added < minimum) {
                best = Some((added, i, meet));
            }
        }
        let (_, i, meet) = best?;
        polygon[i] = meet;
        polygon.remove((i + 1) % n);
    }
    let quad: Quad = polygon.try_into().ok()?;
    (area(&quad) <= (1.0 + ADDED_AREA) * before && is_tag_shaped(&quad)).then_some(quad)
}

fn is_tag_shaped(quad: &Quad) -> bool {
    let side = |i: usize| quad[(i + 1) % 4] - quad[i];
    (0..4).all(|i| side(i).norm() >= SHORTEST && cross(side(i), side((i + 1) % 4)) > 0.0)
        && (0..4).all(|i| side(i).norm() < 8.0 * side((i + 1) % 4).norm())
}

/// Interpolated brightness; `None` outside the image.
pub(crate) fn brightness(image: &Image<u8>, p: &Vec2) -> Option<f64> {
    let (x, y) = (p.x.floor(), p.y.floor());
    if !(x >= 0.0 && y >= 0.0 && x + 1.0 < image.width() as f64 && y + 1.0 < image.height() as f64) {
        return None;
    }
    let (i, j, u, v) = (x as usize, y as usize, p.x - x, p.y - y);
    let at = |i: usize, j: usize| f64::from(image[(i, j)]);
    let upper = at(i, j) * (1.0 - u) + at(i + 1, j) * u;
    let lower = at(i, j + 1) * (1.0 - u) + at(i + 1, j + 1) * u;
    Some(upper * (1.0 - v) + lower * v)
}

/// A line along an edge from bright (outside) to dark: a point, a direction, and the steepness of the edge in grey levels per
/// pixel.
fn edge(image: &Image<u8>, from: Vec2, to: Vec2, outside: Vec2, reach: f64) -> Option<(Vec2, Vec2, f64)> {
    let length = (to - from).norm();
    let samples = (length.round() as usize).clamp(12, 160);
    let steps = (reach / 0.25).round() as i32;
    let mut points = vec![];
    let mut slopes = vec![];
    for k in 0..samples {
        // Avoid the corners, which are rounded.
        let along = 0.12 + 0.76 * (k as f64 + 0.5) / samples as f64;
        let base = from + (to - from) * along;
        let profile = |offset: f64| brightness(image, &(base + outside * offset));
        let (mut sum, mut moment, mut steepest) = (0.0, 0.0, 0.0f64);
        for step in -steps..=steps {
            let offset = 0.25 * f64::from(step);
            let (Some(outer), Some(inner)) = (profile(offset + 1.0), profile(offset - 1.0)) else { continue };
            let gradient = 0.5 * (outer - inner);
            if gradient > 0.0 {
                sum += gradient * gradient;
                moment += gradient * gradient * offset;
                steepest = steepest.max(gradient);
            }
        }
        if steepest > 4.0 {
            points.push(base + outside * (moment / sum));
            slopes.push(steepest);
        }
    }
    let (point, along) = fitted_line(&points, samples / 2)?;
    slopes.sort_by(f64::total_cmp);
    Some((point, along, slopes[slopes.len() / 2]))
}

/// The line fitted to at least `minimum` points; outliers are left out.
fn fitted_line(points: &[Vec2], minimum: usize) -> Option<(Vec2, Vec2)> {
    let mut kept: Vec<Vec2> = points.to_vec();
    let mut line = None;
    for _ in 0..3 {
        if kept.len() < minimum.max(4) {
            return None;
        }
        let mean = kept.iter().sum::<Vec2>() / kept.len() as f64;
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for p in &kept {
            let d = p - mean;
            xx += d.x * d.x;
            xy += d.x * d.y;
            yy += d.y * d.y;
        }
        let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
        let along = Vec2::new(angle.cos(), angle.sin());
        let off = |p: &Vec2| cross(along, p - mean).abs();
        let mut offs: Vec<f64> = kept.iter().map(off).collect();
        offs.sort_by(f64::total_cmp);
        let maximum = 3.0 * offs[offs.len() / 2] + 0.05;
        line = Some((mean, along));
        kept.retain(|p| off(p) <= maximum);
    }
    line
}

/// The intersections of the lines along the quadrangle's edges, and the steepness of the two flattest edges in grey levels per
/// pixel (motion blurs only the edges across it). `None` if there are no edges from bright outside to dark inside.
pub(crate) fn refined(image: &Image<u8>, quad: &Quad) -> Option<(Quad, f64)> {
    let mut quad = *quad;
    let mut slope = 0.0;
    for pass in 0..3 {
        let mut lines = vec![];
        let mut slopes = vec![];
        for i in 0..4 {
            let (from, to) = (quad[i], quad[(i + 1) % 4]);
            let along = (to - from).try_normalize(1e-9)?;
            // Clockwise with y down: the inside is to the right of the direction, the outside to the left.
            let outside = Vec2::new(along.y, -along.x);
            let side = (to - from).norm();
            let reach =
                if pass == 0 { (0.06 * side).clamp(2.0, 10.0) } else { (0.04 * side).clamp(2.0, 5.0) };
            let (point, direction, steepness) = edge(image, from, to, outside, reach)?;
            lines.push((point, direction));
            slopes.push(steepness);
        }
        let mut next = quad;
        for i in 0..4 {
            let ((a, along_a), (b, along_b)) = (lines[(i + 3) % 4], lines[i]);
            next[i] = intersection(a, along_a, b, along_b)?;
            // A corner that moves far away has followed another edge.
            let side = (quad[(i + 1) % 4] - quad[i]).norm();
            if (next[i] - quad[i]).norm() > 0.15 * side + 2.0 {
                return None;
            }
        }
        quad = next;
        slopes.sort_by(f64::total_cmp);
        slope = 0.5 * (slopes[0] + slopes[1]);
    }
    is_tag_shaped(&quad).then_some((quad, slope))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hull_with_rounded_corners_becomes_its_quadrangle() {
        let corners =
            [Vec2::new(10.0, 12.0), Vec2::new(90.0, 20.0), Vec2::new(84.0, 95.0), Vec2::new(15.0, 80.0)];
        let mut hull = vec![];
        for i in 0..4 {
            let (here, next, before) = (corners[i], corners[(i + 1) % 4], corners[(i + 3) % 4]);
            hull.push(here + (before - here).normalize() * 4.0);
            hull.push(here + (next - here).normalize() * 4.0);
        }
        let mut found = around(&hull).unwrap().to_vec();
        for corner in corners {
            let at = found.iter().position(|c| (c - corner).norm() < 1e-6);
            found.remove(at.expect("every corner is found"));
        }
    }

    #[test]
    fn triangles_and_slivers_are_no_tags() {
        let triangle = [Vec2::new(0.0, 0.0), Vec2::new(60.0, 0.0), Vec2::new(0.0, 60.0)];
        assert_eq!(around(&triangle), None);
        let sliver =
            [Vec2::new(0.0, 0.0), Vec2::new(200.0, 0.0), Vec2::new(200.0, 12.0), Vec2::new(0.0, 12.0)];
        assert_eq!(around(&sliver), None);
    }

    #[test]
    fn the_hull_is_clockwise_as_seen() {
        let mut points = vec![(0, 0), (4, 0), (4, 4), (0, 4), (2, 2), (4, 2)];
        let hull = convex_hull(&mut points);
        assert_eq!(hull.len(), 4);
        assert!(area(&hull) > 0.0);
    }
}
