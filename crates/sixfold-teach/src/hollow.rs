//! Hollows without texture: cups, bowls, and flat tops, by photo-consistency (Kutulakos and Seitz 2000) of whole shapes.
//!
//! The hull fills a cup up to its rim and beyond, and the comparison of small windows ([`crate::stereo`]) finds depth only where there
//! is texture. Here a few whole shapes are compared instead: the hull with a hollow that is open from above, with walls of one thickness,
//! down to one depth. The shape on which the photographs agree best is taken. A whole cup shows enough: the line between wall and
//! floor, shadows, stains.
//!
//! Agreement is `sum(w c) / sum(w)` over the pixels that the shapes show differently: `c` is the mean correlation of the window around a
//! pixel with the windows of the neighbours that see the same point, `cov(a, b) / sqrt((var a + n^2) (var b + n^2))` with noise `n`, and
//! `w = var a / (var a + n^2)`.

use rayon::prelude::*;
use sixfold_geometry::{DepthImage, Image, Mask, Vec3};

use crate::distance::squared_distances;
use crate::grid::Grid;
use crate::silhouette::box_mean;
use crate::standing::allowed_by;
use crate::stereo::{luminance, neighbours_of, warped};
use crate::surface::surface;
use crate::view::View;

// All numbers chosen by hand on simulated captures of two mugs, a bowl, a banana, a bottle and a box; neither the seed nor, but for the
// last two, the objects are those of the reported numbers.

/// Thickness of the walls while the depth is searched, metres.
const WALL: f64 = 0.005;
/// Other thicknesses that are tried, metres.
const WALLS: [f64; 5] = [0.002, 0.003, 0.004, 0.0065, 0.008];
/// Depths below the rim that are tried, as fractions of the height; 0 is a flat top.
const DEPTHS: [f64; 8] = [0.0, 0.06, 0.12, 0.25, 0.4, 0.6, 0.8, 1.0];
/// Changes of the best depth that are tried, as fractions of the height.
const CHANGES: [f64; 4] = [-0.1, -0.05, 0.05, 0.1];
/// Radius of the narrowest part of a hollow, metres: anything narrower would be inside a handle.
const NARROW: f64 = 0.008;
/// Of this many masks, one may reach above the rim.
const ONE_WRONG_OF: usize = 10;
/// How far below the rim the hull is continued upwards, metres.
const BELOW_RIM: f64 = 0.006;
/// By how much the photographs have to agree better on a hollow than on the shape without it.
const BETTER: f64 = 0.02;
/// Neighbours that a view is compared with.
const NEIGHBOURS: usize = 8;
/// Half the side of a window, pixels.
const RADIUS: usize = 5;
/// Standard deviation of an image's noise, grey levels.
const NOISE: f32 = 3.0;
/// Minimum part of a window that has to be visible in a neighbour.
const VISIBLE: f32 = 0.3;
/// Minimum change of a pixel's depth by the deepest hollow for it to be compared, metres.
const CHANGED: f32 = 0.003;
/// A point is visible if it is within this distance of the surface, metres.
const SAME: f64 = 0.004;

/// A hollow that is open from above; lengths in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Hollow {
    /// Thickness of the walls.
    wall: f64,
    /// Depth below the rim; 0 for a flat top.
    depth: f64,
}

/// The shape on which the photographs agree best: `carved`, which the comparison of windows carved from `hull`, or one of them with a
/// hollow. The object stands upright, with z up.
pub(crate) fn hollowed(carved: Grid, hull: Grid, views: &[View], masks: &[Mask]) -> Grid {
    let rims = rims(&hull, views, masks);
    let standing: Vec<Standing> = rims.iter().filter_map(|rim| Standing::of(&hull, *rim)).collect();
    // The lowest rim comes last: above it, and inside, all shapes may differ.
    let Some(lowest) = standing.last() else { return carved };
    let deepest = lowest.with(&carved, &Hollow { wall: WALLS[0], depth: lowest.height });
    let Some(compared) = Compared::new(views, masks, &hull, &deepest) else { return carved };
    let whole = compared.agreement(&hull);
    let mut most = compared.agreement(&carved) + BETTER;
    let mut best = carved.clone();
    let mut compare = |agreement: f64, shape: Grid| {
        if agreement > most {
            (most, best) = (agreement, shape);
        }
    };
    // Windows carve holes into thin walls, so the hollow is searched in the whole hull.
    for standing in &standing {
        if let Some((agreement, hollow)) = searched(standing, &hull, &compared, whole) {
            compare(agreement, standing.with(&hull, &hollow));
            let both = standing.with(&carved, &hollow);
            compare(compared.agreement(&both), both);
        }
    }
    compare(whole, hull);
    best
}

/// The hollow in a hull on which the photographs agree best, and how well; `None` if they agree better, or hardly less, on the whole hull,
/// which is given.
fn searched(standing: &Standing, hull: &Grid, compared: &Compared<'_>, whole: f64) -> Option<(f64, Hollow)> {
    let mut most = whole + BETTER;
    let mut best = None;
    let mut compare = |cavity: &Cavity, depth: f64| {
        let agreement = compared.agreement(&standing.emptied(hull, cavity, depth));
        if agreement > most {
            most = agreement;
            best = Some((agreement, Hollow { wall: cavity.wall, depth }));
        }
        best
    };
    let depth_of = |fraction: f64| fraction * standing.height;
    let cavity = standing.cavity(WALL);
    let mut found = None;
    for fraction in DEPTHS {
        found = compare(&cavity, depth_of(fraction));
    }
    let Some((_, at)) = found.filter(|(_, h)| h.depth > 0.0) else { return found };
    for wall in WALLS {
        found = compare(&standing.cavity(wall), at.depth);
    }
    let at = found.map_or(at, |(_, h)| h);
    let cavity = standing.cavity(at.wall);
    for change in CHANGES {
        found = compare(&cavity, at.depth + depth_of(change));
    }
    found
}

/// All that is more than a wall's thickness inside, open from above.
struct Cavity {
    wall: f64,
    /// Distance of each voxel to its middle part, metres: it ends at [`NARROW`].
    away: Vec<f32>,
}

/// The hull of an object that stands upright, continued above its rim.
struct Standing {
    /// Of the grid: voxels along each axis, and their distance, metres.
    size: [usize; 3],
    step: f64,
    /// Distance of each voxel to the outside, metres.
    inside: Vec<f32>,
    /// z of the rim.
    rim: f64,
    /// Height of the rim above the lowest point, metres.
    height: f64,
}

/// Heights (z) of the rim that are tried, highest first: the lowest plane that cuts nothing from any mask, and the lowest that cuts
/// nothing from all but a few. A mask with a bulge puts the former into the roof of the hull; masks that lack a rim in front of a ground
/// of the same colour put the latter below the rim.
fn rims(hull: &Grid, views: &[View], masks: &[Mask]) -> Vec<f64> {
    let down = -Vec3::z();
    let allowed = views.iter().zip(masks).filter_map(|(view, mask)| allowed_by(hull, view, mask, &down));
    let mut heights: Vec<f64> = allowed.map(|height| -height).collect();
    heights.sort_by(|a, b| b.total_cmp(a));
    let mut rims: Vec<f64> =
        [0, heights.len() / ONE_WRONG_OF].iter().filter_map(|i| heights.get(*i).copied()).collect();
    rims.dedup_by(|lower, higher| *higher - *lower < hull.step);
    rims
}

impl Standing {
    fn of(hull: &Grid, rim: f64) -> Option<Standing> {
        let [w, h, d] = hull.size;
        let area = w * h;
        let lowest = hull.values.iter().position(|v| *v < 0.0)? / area;
        let low = hull.low.z + lowest as f64 * hull.step;
        if !(rim.is_finite() && rim > low) {
            return None;
        }
        // Above, the hull is a roof: the walls go on as columns. They begin below the rim, whose height is not exact.
        let first = (((rim - BELOW_RIM - hull.low.z) / hull.step).max(0.0) as usize).min(d - 1);
        let mut is_inside: Vec<bool> = hull.values.iter().map(|v| *v < 0.0).collect();
        for i in (first + 1) * area..is_inside.len() {
            is_inside[i] |= is_inside[i - area];
        }
        let inside = distances(hull.size, hull.step, |i| !is_inside[i]);
        Some(Standing { size: hull.size, step: hull.step, inside, rim, height: rim - low })
    }

    fn cavity(&self, wall: f64) -> Cavity {
        let inner = (wall + NARROW) as f32;
        Cavity { wall, away: distances(self.size, self.step, |i| self.inside[i] > inner) }
    }

    /// A shape with a hollow, and nothing above its rim.
    fn with(&self, shape: &Grid, hollow: &Hollow) -> Grid {
        self.emptied(shape, &self.cavity(hollow.wall), hollow.depth)
    }

    /// A shape without the part of a cavity down to a depth below the rim, and nothing above its rim.
    fn emptied(&self, shape: &Grid, cavity: &Cavity, depth: f64) -> Grid {
        let area = shape.size[0] * shape.size[1];
        let mut emptied = shape.clone();
        emptied.values.par_iter_mut().enumerate().for_each(|(i, v)| {
            let above_rim = (shape.low.z + (i / area) as f64 * shape.step - self.rim) as f32;
            if depth > 0.0 {
                *v = v.max((NARROW as f32 - cavity.away[i]).min(above_rim + depth as f32));
            }
            *v = v.max(above_rim);
        });
        emptied
    }
}

/// The distance of each voxel to the nearest voxel of a set, metres; the diagonal of the grid if the set is empty.
fn distances(size: [usize; 3], step: f64, of: impl Fn(usize) -> bool) -> Vec<f32> {
    squared_distances(size, of).into_iter().map(|square| step as f32 * square.sqrt()).collect()
}

/// The pixels in which shapes are compared.
struct Compared<'a> {
    views: &'a [View],
    greys: Vec<Image<f32>>,
    /// For each view, those it is compared with.
    neighbours: Vec<Vec<usize>>,
    /// For each view the weights of its pixels: how much there is to see around them, 0 where all shapes are the same.
    weights: Vec<Vec<f32>>,
}

impl<'a> Compared<'a> {
    fn new(views: &'a [View], masks: &[Mask], filled: &Grid, deepest: &Grid) -> Option<Compared<'a>> {
        let (filled, deepest) = (surface(filled)?, surface(deepest)?);
        let greys: Vec<Image<f32>> = views.iter().map(|v| v.image.map(|c| luminance(*c))).collect();
        let weights_of = |(i, view): (usize, &View)| {
            let (mask, grey) = (&masks[i], greys[i].as_slice());
            let inside: Vec<f32> = mask.as_slice().iter().map(|m| f32::from(u8::from(*m))).collect();
            let windows = Windows::new(mask.size(), &inside, grey);
            let [full, empty] = [&filled, &deepest]
                .map(|mesh| sixfold_render::render_depth(mesh, &view.camera_from_world, &view.camera));
            let weight = |k: usize| {
                let at = (k % mask.width(), k / mask.width());
                let (near, far) = (full[at], empty[at]);
                let changes = near > 0.0 && (far == 0.0 || far - near > CHANGED);
                let variance = windows.variance(k);
                if mask[at] && changes && !view.is_hidden(at) {
                    variance / (variance + NOISE * NOISE)
                } else {
                    0.0
                }
            };
            (0..grey.len()).map(weight).collect()
        };
        let weights: Vec<Vec<f32>> = views.par_iter().enumerate().map(weights_of).collect();
        let neighbours = (0..views.len()).map(|i| neighbours_of(views, i, NEIGHBOURS)).collect();
        Some(Compared { views, greys, neighbours, weights })
    }

    /// How well the photographs agree on a shape: the mean correlation of windows between neighbours that see the same point, 0 where
    /// no neighbour does.
    fn agreement(&self, shape: &Grid) -> f64 {
        let Some(mesh) = surface(shape) else { return f64::NEG_INFINITY };
        let render = |v: &View| sixfold_render::render_depth(&mesh, &v.camera_from_world, &v.camera);
        let depths: Vec<DepthImage> = self.views.par_iter().map(render).collect();
        let sums: Vec<[f64; 2]> =
            (0..self.views.len()).into_par_iter().map(|i| self.agreement_of(i, &depths)).collect();
        let [sum, weight] = sums.into_iter().fold([0.0; 2], |a, b| [a[0] + b[0], a[1] + b[1]]);
        if weight > 0.0 { sum / weight } else { 0.0 }
    }

    /// The weighted sum of the correlations of a view with its neighbours, and the sum of its weights.
    fn agreement_of(&self, i: usize, depths: &[DepthImage]) -> [f64; 2] {
        let weights = &self.weights[i];
        let mut sums = vec![[0.0f32; 2]; weights.len()];
        for j in &self.neighbours[i] {
            let theirs = warped(self.views, &self.greys, (i, *j), &depths[i]);
            let visible = self.visible(i, *j, depths);
            let windows = Windows::new(theirs.size(), &visible, self.greys[i].as_slice());
            let pair = windows.compared(&visible, self.greys[i].as_slice(), theirs.as_slice());
            for k in (0..weights.len()).filter(|k| weights[*k] > 0.0 && visible[*k] > 0.0) {
                if let Some(correlation) = pair.correlation(&windows, k) {
                    sums[k] = [sums[k][0] + correlation, sums[k][1] + 1.0];
                }
            }
        }
        let mean = |k: usize| if sums[k][1] > 0.0 { sums[k][0] / sums[k][1] } else { 0.0 };
        let sum = (0..weights.len()).map(|k| f64::from(weights[k] * mean(k))).sum();
        [sum, weights.iter().map(|w| f64::from(*w)).sum()]
    }

    /// 1 for pixels of a view whose points its neighbour sees, else 0.
    fn visible(&self, i: usize, j: usize, depths: &[DepthImage]) -> Vec<f32> {
        let (here, there) = (&self.views[i], &self.views[j]);
        let relative = there.camera_from_world.to_matrix() * here.camera_from_world.inverse().to_matrix();
        let width = depths[i].width();
        let is_visible = |(k, depth): (usize, &f32)| {
            if *depth <= 0.0 {
                return false;
            }
            let pixel = sixfold_geometry::Vec2::new((k % width) as f64, (k / width) as f64);
            let p = here.camera.unproject(&pixel, f64::from(*depth));
            let q = (relative * p.push(1.0)).xyz();
            let Some(pixel) = there.camera.project(&q) else { return false };
            let nearest = crate::view::nearest_pixel(&pixel, depths[j].width(), depths[j].height())
                .map(|at| depths[j][at]);
            nearest.is_some_and(|d| d > 0.0 && (f64::from(d) - q.z).abs() < SAME)
        };
        depths[i].as_slice().iter().enumerate().map(|p| f32::from(u8::from(is_visible(p)))).collect()
    }
}

/// Means over a window around each pixel, of the pixels that count.
struct Windows {
    size: (usize, usize),
    count: Vec<f32>,
    mean: Vec<f32>,
    square: Vec<f32>,
}

impl Windows {
    fn new(size: (usize, usize), counted: &[f32], values: &[f32]) -> Windows {
        let count = windowed(size, |k| counted[k]);
        let mean = windowed(size, |k| counted[k] * values[k]);
        let square = windowed(size, |k| counted[k] * values[k] * values[k]);
        Windows { size, count, mean, square }
    }

    fn variance(&self, k: usize) -> f32 {
        let n = self.count[k].max(1e-6);
        (self.square[k] / n - (self.mean[k] / n).powi(2)).max(0.0)
    }

    /// The same with the values of another image at the same pixels.
    fn compared(&self, counted: &[f32], own: &[f32], others: &[f32]) -> Pair {
        let others_windows = Windows::new(self.size, counted, others);
        let product = windowed(self.size, |k| counted[k] * own[k] * others[k]);
        Pair { others: others_windows, product }
    }
}

/// Windows of another image, and of the product of both.
struct Pair {
    others: Windows,
    product: Vec<f32>,
}

impl Pair {
    /// The correlation around a pixel; noise lets it approach 0 where there is little to see. `None` if too little is visible.
    fn correlation(&self, own: &Windows, k: usize) -> Option<f32> {
        let n = own.count[k];
        if n < VISIBLE {
            return None;
        }
        let covariance = self.product[k] / n - own.mean[k] / n * (self.others.mean[k] / n);
        let noise = NOISE * NOISE;
        Some(covariance / ((own.variance(k) + noise) * (self.others.variance(k) + noise)).sqrt())
    }
}

fn windowed((width, height): (usize, usize), value: impl Fn(usize) -> f32) -> Vec<f32> {
    box_mean(&Image::from_fn(width, height, |x, y| value(y * width + x)), RADIUS).as_slice().to_vec()
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::Camera;
    use sixfold_mesh::Mesh;
    use sixfold_render::{Light, Material, SceneObject, VisibilityBuffer, shade};

    use super::*;
    use crate::hull::{Outlined, hull};
    use crate::simulation::looking_at;
    use crate::view::Volume;

    /// Rotates a profile of radii and heights about z. It starts and ends on the axis.
    fn lathed(profile: &[(f64, f64)]) -> Mesh {
        const SIDES: u32 = 48;
        let vertices = profile.iter().flat_map(|(r, z)| {
            (0..SIDES).map(move |s| {
                let angle = f64::from(s) / f64::from(SIDES) * std::f64::consts::TAU;
                Vec3::new(r * angle.cos(), r * angle.sin(), *z)
            })
        });
        let faces = (1..profile.len() as u32).flat_map(|row| {
            (0..SIDES).flat_map(move |s| {
                let at = |row: u32, s: u32| row * SIDES + s % SIDES;
                let (a, b, c, d) = (at(row - 1, s), at(row - 1, s + 1), at(row, s + 1), at(row, s));
                [[a, b, c], [a, c, d]]
            })
        });
        Mesh::new(vertices.collect(), faces.collect()).unwrap()
    }

    /// A cup of 70 mm with walls of 4 mm and a floor of 8 mm.
    fn cup() -> Mesh {
        cup_with(0.004, 0.008)
    }

    fn cup_with(wall: f64, floor: f64) -> Mesh {
        let inner = 0.035 - wall;
        lathed(&[(0.0, 0.0), (0.035, 0.0), (0.035, 0.07), (inner, 0.07), (inner, floor), (0.0, floor)])
    }

    /// Height of the floor at the axis, and radius at which the wall begins at a height, millimetres.
    fn floor_and_wall(cup: &Grid, z: f64) -> [usize; 2] {
        let first = |is_inside: &dyn Fn(f64) -> bool| (0..70).find(|i| is_inside(0.001 * *i as f64)).unwrap();
        let floor = first(&|height| !is_inside(cup, 0.0, height + 0.001));
        [floor + 1, first(&|radius| is_inside(cup, radius, z))]
    }

    fn cylinder() -> Mesh {
        lathed(&[(0.0, 0.0), (0.035, 0.0), (0.035, 0.07), (0.0, 0.07)])
    }

    /// Views in two circles, lit from two sides, and their masks.
    fn views_of(mesh: &Mesh) -> (Vec<View>, Vec<Mask>) {
        let camera =
            Camera { fx: 600.0, fy: 600.0, cx: 59.5, cy: 59.5, width: 120, height: 120, distortion: None };
        let lights = [(Vec3::new(0.6, 0.2, -0.8), 0.5), (Vec3::new(-0.3, -0.8, -0.3), 0.3)];
        let view = |i: usize| {
            let elevation = if i.is_multiple_of(2) { 35.0 } else { 60.0 };
            let pose = looking_at(&Vec3::new(0.0, 0.0, 0.03), 22.5 * i as f64, elevation, 0.5, 0.0);
            let mut all = vec![Light::Ambient { color: [0.2; 3] }];
            all.extend(lights.map(|(direction, strength)| Light::Directional {
                direction: pose.transform_direction(&direction),
                color: [strength; 3],
            }));
            let objects = [SceneObject { mesh, camera_from_object: pose }];
            let mut buffer = VisibilityBuffer::new(&camera);
            buffer.render(&objects, &Default::default());
            let image = shade(&buffer, &objects, &all, &Material::default(), None);
            let eye = pose.inverse().translation();
            let view =
                View { image, camera, camera_from_world: pose, eye, depth: None, mask: None, hidden: None };
            (view, buffer.mask(0))
        };
        (0..16).map(view).unzip()
    }

    fn hull_of(views: &[View], masks: &[Mask]) -> Grid {
        let outlined: Vec<Outlined<'_>> = views.iter().zip(masks).map(|(v, m)| Outlined::new(v, m)).collect();
        let volume = Volume { low: Vec3::new(-0.04, -0.04, -0.004), high: Vec3::new(0.04, 0.04, 0.1) };
        let floor = sixfold_geometry::Plane { normal: Vec3::z(), offset: 0.0 };
        hull(&outlined, &volume, 64, Some(floor))
    }

    /// The hull of a mesh, and what is left of it after something was carved from it.
    fn both(mesh: &Mesh, carve: impl Fn(&mut Grid)) -> [Grid; 2] {
        let (views, masks) = views_of(mesh);
        let hull = hull_of(&views, &masks);
        let mut carved = hull.clone();
        carve(&mut carved);
        let left = hollowed(carved, hull.clone(), &views, &masks);
        [hull, left]
    }

    fn is_inside(grid: &Grid, x: f64, z: f64) -> bool {
        grid.at(&Vec3::new(x, 0.0, z)).unwrap() < 0.0
    }

    #[test]
    fn a_cup_without_texture_is_emptied_and_keeps_its_walls() {
        let [hull, cup] = both(&cup(), |_| ());
        assert!(is_inside(&hull, 0.0, 0.08), "the hull fills the cup beyond its rim");
        for z in [0.02, 0.04, 0.066] {
            let [floor, wall] = floor_and_wall(&cup, z);
            assert!((6..=11).contains(&floor), "the floor is at {floor} mm");
            assert!((28..=33).contains(&wall), "the wall begins at {wall} mm at {z} m");
            assert!(is_inside(&cup, 0.0335, z));
        }
        assert!(!is_inside(&cup, 0.033, 0.074), "nothing is above the rim");
    }

    #[test]
    fn one_mask_with_a_bulge_does_not_raise_the_rim() {
        let (views, mut masks) = views_of(&cup());
        let rims = |masks: &[Mask]| rims(&hull_of(&views, masks), &views, masks);
        let before = rims(&masks);
        assert!(before.iter().all(|rim| (rim - 0.07).abs() < 0.002), "{before:?}");
        // Eight pixels upwards, from 35 degrees above the ground.
        let mask = masks[4].clone();
        masks[4] = Mask::from_fn(120, 120, |x, y| mask[(x, y)] || (y + 8 < 120 && mask[(x, y + 8)]));
        let [high, low] = rims(&masks)[..] else { panic!("two rims are tried") };
        assert!(high > 0.075 && (low - 0.07).abs() < 0.002, "{high}, {low}");
        let hull = hull_of(&views, &masks);
        let cup = hollowed(hull.clone(), hull, &views, &masks);
        assert!(!is_inside(&cup, 0.033, 0.074), "the photographs agree better on the lower one");
    }

    #[test]
    fn walls_have_the_thickness_that_the_photographs_show() {
        for (thickness, expected) in [(0.002, 30..=33), (0.0065, 26..=28)] {
            let [_, cup] = both(&cup_with(thickness, 0.01), |_| ());
            let [_, wall] = floor_and_wall(&cup, 0.04);
            assert!(expected.contains(&wall), "the wall of {thickness} m begins at {wall} mm");
        }
    }

    #[test]
    fn a_cavity_does_not_reach_into_a_handle() {
        // A solid cylinder of 60 mm with a fin 12 mm thick, which continues above the rim.
        let volume = Volume { low: Vec3::new(-0.05, -0.05, 0.0), high: Vec3::new(0.07, 0.05, 0.05) };
        let grid = Grid::new(&volume, 60, |p| {
            let body = p.x.hypot(p.y) - 0.03;
            let fin = (p.y.abs() - 0.006).max(-p.x).max(p.x - 0.06);
            body.min(fin) as f32
        });
        let inside = distances(grid.size, grid.step, |i| grid.values[i] >= 0.0);
        let standing = Standing { size: grid.size, step: grid.step, inside, rim: 0.05, height: 0.05 };
        let emptied = standing.emptied(&grid, &standing.cavity(0.003), 0.04);
        assert!(is_inside(&grid, 0.045, 0.03) && is_inside(&emptied, 0.045, 0.03), "the fin is solid");
        assert!(!is_inside(&emptied, 0.0, 0.03) && is_inside(&emptied, 0.0, 0.005));
    }

    #[test]
    fn a_hole_that_was_carved_into_a_wall_is_closed() {
        // Everything within 15 mm of a point of the wall.
        let wall = Vec3::new(0.033, 0.0, 0.04);
        let carve = |grid: &mut Grid| {
            for i in 0..grid.values.len() {
                let inside = 0.015 - (grid.point(grid.place(i)) - wall).norm();
                grid.values[i] = grid.values[i].max(inside as f32);
            }
        };
        let [_, cup] = both(&cup(), carve);
        assert!(is_inside(&cup, 0.0335, 0.04) && is_inside(&cup, 0.0335, 0.035));
        assert!(!is_inside(&cup, 0.0, 0.04) && !is_inside(&cup, 0.025, 0.04));
    }

    #[test]
    fn a_solid_with_a_pattern_keeps_its_inside() {
        let color = |v: &Vec3| [(128.0 + 100.0 * (300.0 * v.x + 200.0 * v.y).sin()) as u8; 3];
        // Patterns are in the vertices, so the top needs some.
        let rings: Vec<(f64, f64)> = (0..20).map(|i| (0.035 - 0.035 / 19.0 * f64::from(i), 0.07)).collect();
        let mesh = lathed(&[vec![(0.0, 0.0), (0.035, 0.0)], rings].concat());
        let colors = mesh.vertices().iter().map(color).collect();
        let [_, solid] = both(&mesh.with_colors(colors).unwrap(), |_| ());
        for z in [0.01, 0.03, 0.06] {
            assert!(is_inside(&solid, 0.0, z) && is_inside(&solid, 0.025, z), "{z}");
        }
        let [_, plain] = both(&cylinder(), |_| ());
        assert!(is_inside(&plain, 0.0, 0.06) && is_inside(&plain, 0.025, 0.05));
    }
}
