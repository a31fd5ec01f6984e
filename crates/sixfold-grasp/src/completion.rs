//! Completion of the unseen part of an object by symmetry.
//!
//! One view shows half of an object, but a gripper also touches the other half. Most objects on tables are symmetric about a
//! vertical plane, so the visible points are mirrored at the plane that contradicts the image least: a mirrored point may be behind
//! the measured surface, but not in front of it (Bohg et al. 2011, "Mind the gap: robotic grasping under incomplete observation",
//! ICRA). A second plane about perpendicular to the first is used if it agrees as well.

use std::collections::BTreeMap;

use sixfold_geometry::{KdTree, Plane, PointCloud, Vec3};

use crate::GraspView;

/// How mirror planes are searched.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CompletionOptions {
    /// Number of directions of vertical planes tried.
    pub directions: usize,
    /// Distance between the planes tried in one direction, metres.
    pub step: f64,
    /// Largest shift of planes from the centre of the visible points, in steps to each side.
    pub shifts: i32,
    /// A mirrored point this far in front of the measured surface contradicts the image, metres.
    pub tolerance: f64,
    /// Largest fraction of mirrored points that may contradict the image.
    pub max_contradiction: f64,
    /// Minimum agreement of a second plane: the fraction of mirrored points that were measured (less with increasing distance),
    /// plus half the fraction of hidden ones.
    pub min_agreement: f64,
}

impl Default for CompletionOptions {
    fn default() -> Self {
        CompletionOptions {
            directions: 24,
            step: 0.006,
            shifts: 6,
            tolerance: 0.01,
            max_contradiction: 0.08,
            min_agreement: 0.3,
        }
    }
}

/// The object's points, seen and assumed, in the camera's frame.
#[derive(Debug, Clone, Default)]
pub struct CompletedObject {
    /// Points and their normals; the seen ones come first.
    pub cloud: PointCloud,
    /// Number of seen points.
    pub observed: usize,
    /// The mirror planes used, at most two.
    pub planes: Vec<Plane>,
}

/// Result of comparing an assumed point with the image.
#[derive(Clone, Copy, PartialEq)]
enum Verdict {
    /// Something further away was measured there.
    Contradicted,
    /// The object's surface was measured there, at this distance (metres).
    Supported(f64),
    /// The point is behind the object's visible surface.
    Hidden,
    /// The image does not decide.
    Unknown,
}

/// Completes the object of a view. Without a table the vertical is unknown, and nothing is assumed.
pub fn complete_by_mirrors(view: &GraspView, options: &CompletionOptions) -> CompletedObject {
    let mut done =
        CompletedObject { cloud: view.object.clone(), observed: view.object.len(), planes: vec![] };
    let Some(table) = view.table else { return done };
    if view.object.normals.len() != view.object.len() || view.object.is_empty() {
        return done;
    }
    let any = if table.normal.x.abs() < 0.8 { Vec3::x() } else { Vec3::y() };
    let u = table.normal.cross(&any).normalize();
    let v = table.normal.cross(&u);
    let stride = view.object.len().div_ceil(400).max(1);
    let probes: Vec<Vec3> = view.object.points.iter().step_by(stride).copied().collect();
    let mut found: Vec<(f64, Plane)> = vec![];
    for k in 0..options.directions {
        let angle = std::f64::consts::PI * k as f64 / options.directions as f64;
        let normal = u * angle.cos() + v * angle.sin();
        let mut along: Vec<f64> = probes.iter().map(|p| normal.dot(p)).collect();
        along.sort_by(f64::total_cmp);
        let at = |fraction: f64| along[(fraction * (along.len() - 1) as f64) as usize];
        let centre = 0.5 * (at(0.02) + at(0.98));
        let best = (-options.shifts..=options.shifts)
            .filter_map(|shift| {
                let plane = Plane { normal, offset: centre + f64::from(shift) * options.step };
                judge(view, &probes, &plane, options).map(|score| (score, plane))
            })
            .fold(None, |best: Option<(f64, Plane)>, next| match best {
                Some(b) if b.0 >= next.0 => Some(b),
                _ => Some(next),
            });
        found.extend(best);
    }
    let best = |found: &[(f64, Plane)], other: Option<&Plane>| {
        found.iter().filter(|(_, p)| other.is_none_or(|o| p.normal.dot(&o.normal).abs() < 0.35)).fold(
            None,
            |best: Option<(f64, Plane)>, next| match best {
                Some(b) if b.0 >= next.0 => Some(b),
                _ => Some(*next),
            },
        )
    };
    let Some((_, first)) = best(&found, None) else { return done };
    done.planes.push(first);
    if let Some((score, second)) = best(&found, Some(&first))
        && score > options.min_agreement
    {
        done.planes.push(second);
    }
    let planes = done.planes.clone();
    for plane in &planes {
        add_mirrored(view, &mut done, plane, options);
    }
    done
}

/// How well the image agrees with the mirrored points; `None` when it contradicts them.
fn judge(view: &GraspView, probes: &[Vec3], plane: &Plane, options: &CompletionOptions) -> Option<f64> {
    let (mut contradicted, mut supported, mut hidden) = (0.0, 0.0, 0.0);
    for p in probes {
        match verdict(view, &plane.mirrored(p), options.tolerance) {
            Verdict::Contradicted => contradicted += 1.0,
            Verdict::Supported(off) => supported += 1.0 - off / options.tolerance,
            Verdict::Hidden => hidden += 1.0,
            Verdict::Unknown => {}
        }
    }
    let fraction = |count: f64| count / probes.len() as f64;
    // Hidden points agree with any plane, so they count less than measured ones.
    (fraction(contradicted) <= options.max_contradiction)
        .then(|| fraction(supported) + 0.5 * fraction(hidden) - 2.0 * fraction(contradicted))
}

fn verdict(view: &GraspView, p: &Vec3, tolerance: f64) -> Verdict {
    let Some(pixel) = view.camera.project(p) else { return Verdict::Unknown };
    let (x, y) = (pixel.x.round(), pixel.y.round());
    if x < 0.0 || y < 0.0 || x >= view.depth.width() as f64 || y >= view.depth.height() as f64 {
        return Verdict::Unknown;
    }
    let at = (x as usize, y as usize);
    let measured = f64::from(view.depth[at]);
    if measured <= 0.0 {
        return Verdict::Unknown;
    }
    if measured - p.z > tolerance {
        return Verdict::Contradicted;
    }
    if !view.mask[at] {
        // In front of the table or another object by less than the tolerance, or behind another object.
        return Verdict::Unknown;
    }
    if p.z - measured > tolerance { Verdict::Hidden } else { Verdict::Supported((p.z - measured).abs()) }
}

/// Adds vertical walls below the outline of seen and mirrored points, down to the table: an assumption for low objects whose sides
/// are not visible from above (a banana, a pair of scissors). Their normals are horizontal and point outwards. Points that
/// contradict the image or coincide with known points are left out, so a second call adds nothing. Does nothing without a table.
pub(crate) fn assume_walls(view: &GraspView, object: &mut CompletedObject, options: &CompletionOptions) {
    let Some(table) = view.table else { return };
    let cell = view.step.max(1e-4);
    let any = if table.normal.x.abs() < 0.8 { Vec3::x() } else { Vec3::y() };
    let u = table.normal.cross(&any).normalize();
    let v = table.normal.cross(&u);
    // The highest point above each cell of the table, in the order of the cells.
    let mut heights: BTreeMap<(i64, i64), f64> = BTreeMap::new();
    for p in &object.cloud.points {
        let key = ((u.dot(p) / cell).floor() as i64, (v.dot(p) / cell).floor() as i64);
        let height = heights.entry(key).or_insert(0.0);
        *height = height.max(table.distance(p));
    }
    let near = |(a, b): (i64, i64), reach: i64| {
        (-reach..=reach).flat_map(move |i| (-reach..=reach).map(move |j| (a + i, b + j, i, j)))
    };
    let tree = KdTree::new(&object.cloud.points);
    let mut points = vec![];
    let mut normals = vec![];
    for (&(a, b), &top) in &heights {
        if [(1, 0), (-1, 0), (0, 1), (0, -1)].iter().all(|(i, j)| heights.contains_key(&(a + i, b + j))) {
            continue;
        }
        // The outward direction points away from the occupied cells around; holes of the cloud have such cells on all sides and get
        // no wall.
        let inwards = near((a, b), 3)
            .filter(|(x, y, _, _)| heights.contains_key(&(*x, *y)))
            .fold((0.0, 0.0), |sum, (_, _, i, j)| (sum.0 + i as f64, sum.1 + j as f64));
        let around = near((a, b), 3).filter(|(x, y, _, _)| heights.contains_key(&(*x, *y))).count();
        let Some(outwards) = (-(u * inwards.0 + v * inwards.1)).try_normalize(0.5 * around as f64) else {
            continue;
        };
        let foot =
            u * ((a as f64 + 0.5) * cell) + v * ((b as f64 + 0.5) * cell) + table.normal * table.offset;
        let mut height = cell;
        while height < top {
            let p = foot + table.normal * height;
            let known = tree.nearest(&p).is_some_and(|n| n.distance < cell);
            if !known && verdict(view, &p, options.tolerance) != Verdict::Contradicted {
                points.push(p);
                normals.push(outwards);
            }
            height += cell;
        }
    }
    object.cloud.points.extend(points);
    object.cloud.normals.extend(normals);
}

/// Adds the mirror images of all points where no point was measured.
fn add_mirrored(view: &GraspView, done: &mut CompletedObject, plane: &Plane, options: &CompletionOptions) {
    let tree = KdTree::new(&done.cloud.points);
    let mut points = vec![];
    let mut normals = vec![];
    for (p, n) in done.cloud.points.iter().zip(&done.cloud.normals) {
        let q = plane.mirrored(p);
        let verdict = verdict(view, &q, options.tolerance);
        let known = tree.nearest(&q).is_some_and(|near| near.distance < 0.006);
        if verdict == Verdict::Contradicted || known {
            continue;
        }
        points.push(q);
        normals.push(n - plane.normal * (2.0 * plane.normal.dot(n)));
    }
    done.cloud.points.extend(points);
    done.cloud.normals.extend(normals);
}
