//! Depth of each view by comparison with its neighbours: planes swept through the hull (Collins 1996), windows compared by
//! normalised cross-correlation, kept where neighbours agree.

use rayon::prelude::*;
use sixfold_geometry::{DepthImage, Image};

use crate::silhouette::box_mean;
use crate::view::{View, bilinear};

/// Options of the sweep.
pub(crate) struct StereoOptions {
    /// Number of depth planes between front and back of the hull.
    pub planes: usize,
    /// Neighbours that a view is compared with.
    pub neighbours: usize,
    /// Half the side of a window, pixels.
    pub radius: usize,
    /// Minimum correlation for a depth to be accepted.
    pub correlation: f32,
    /// Standard deviation of grey levels in a window below which nothing can be compared.
    pub contrast: f32,
}

impl Default for StereoOptions {
    fn default() -> Self {
        // Chosen by hand on simulated captures of other objects than the reported ones.
        StereoOptions { planes: 48, neighbours: 4, radius: 3, correlation: 0.8, contrast: 7.0 }
    }
}

/// The range of depths at which each pixel's ray is inside the hull.
pub(crate) struct Reach {
    pub front: DepthImage,
    pub back: DepthImage,
}

/// A depth image for each view, 0 where no depth is accepted.
pub(crate) fn depths(views: &[View], reaches: &[Reach], options: &StereoOptions) -> Vec<DepthImage> {
    let greys: Vec<Image<f32>> = views.iter().map(|v| v.image.map(|c| luminance(*c))).collect();
    let swept: Vec<DepthImage> = (0..views.len())
        .into_par_iter()
        .map(|i| {
            let others = neighbours_of(views, i, options.neighbours);
            sweep(views, &greys, i, &others, &reaches[i], options)
        })
        .collect();
    (0..views.len()).into_par_iter().map(|i| agreed(views, &swept, i, options)).collect()
}

pub(crate) fn luminance([r, g, b]: [u8; 3]) -> f32 {
    0.299 * f32::from(r) + 0.587 * f32::from(g) + 0.114 * f32::from(b)
}

/// Views from directions 8 to 50 degrees away, nearest to 20 degrees first.
pub(crate) fn neighbours_of(views: &[View], i: usize, most: usize) -> Vec<usize> {
    let towards = |v: &View| v.camera_from_world.inverse().transform_direction(&sixfold_geometry::Vec3::z());
    let here = towards(&views[i]);
    let angle = |j: usize| here.dot(&towards(&views[j])).clamp(-1.0, 1.0).acos().to_degrees();
    let mut others: Vec<(f64, usize)> = (0..views.len())
        .filter(|j| *j != i)
        .map(|j| (angle(j), j))
        .filter(|(a, _)| (5.0..50.0).contains(a))
        .collect();
    others.sort_by(|a, b| (a.0 - 20.0).abs().total_cmp(&(b.0 - 20.0).abs()).then(a.1.cmp(&b.1)));
    others.into_iter().take(most).map(|(_, j)| j).collect()
}

fn sweep(
    views: &[View],
    greys: &[Image<f32>],
    i: usize,
    others: &[usize],
    reach: &Reach,
    options: &StereoOptions,
) -> DepthImage {
    let (w, h) = views[i].image.size();
    let mut best = vec![(0.0f32, 0.0f32, f32::NEG_INFINITY, f32::NEG_INFINITY); w * h];
    if others.is_empty() {
        return Image::filled(w, h, 0.0);
    }
    let own = Statistics::new(&greys[i], options.radius);
    let mut before: Vec<f32> = vec![f32::NEG_INFINITY; w * h];
    for plane in 0..=options.planes {
        let depth =
            Image::from_fn(w, h, |x, y| at_plane(reach, (x, y), plane as f32 / options.planes as f32));
        let correlations: Vec<Image<f32>> = others
            .iter()
            .map(|j| correlation(&own, &greys[i], &warped(views, greys, (i, *j), &depth), options))
            .collect();
        for k in 0..w * h {
            if depth.as_slice()[k] <= 0.0 {
                continue;
            }
            let score = best_half(correlations.iter().map(|c| c.as_slice()[k]));
            let (at, _, top, _) = best[k];
            if score > top {
                best[k] = (plane as f32, before[k], score, f32::NEG_INFINITY);
            } else if plane as f32 == at + 1.0 {
                best[k].3 = score;
            }
            before[k] = score;
        }
    }
    Image::from_fn(w, h, |x, y| {
        let k = y * w + x;
        let (plane, left, top, right) = best[k];
        if top < options.correlation || own.deviation.as_slice()[k] < options.contrast {
            return 0.0;
        }
        // The peak of the parabola through the three scores; a maximum at the end of the range is not a peak.
        if !(left.is_finite() && right.is_finite()) {
            return 0.0;
        }
        let bend = left - 2.0 * top + right;
        let shift = if bend < -1e-6 { (0.5 * (left - right) / bend).clamp(-0.5, 0.5) } else { 0.0 };
        at_plane(reach, (x, y), (plane + shift) / options.planes as f32)
    })
}

/// The depth at a fraction of the way from front to back, uniform in 1/depth; 0 outside the hull.
fn at_plane(reach: &Reach, pixel: (usize, usize), fraction: f32) -> f32 {
    let (front, back) = (reach.front[pixel], reach.back[pixel]);
    if front <= 0.0 || back <= front {
        return 0.0;
    }
    1.0 / ((1.0 - fraction) / front + fraction / back)
}

/// The mean of the better half, since the view of a neighbour may be occluded.
fn best_half(scores: impl Iterator<Item = f32>) -> f32 {
    let mut scores: Vec<f32> = scores.collect();
    scores.sort_by(|a, b| b.total_cmp(a));
    let half = scores.len().div_ceil(2);
    scores[..half].iter().sum::<f32>() / half as f32
}

/// The grey levels of another view at the points of this view's pixels with given depths; NaN for points outside its
/// image.
pub(crate) fn warped(
    views: &[View],
    greys: &[Image<f32>],
    (i, j): (usize, usize),
    depth: &DepthImage,
) -> Image<f32> {
    let (here, there) = (&views[i], &views[j]);
    let relative = there.camera_from_world.to_matrix() * here.camera_from_world.inverse().to_matrix();
    let m: [[f32; 4]; 3] = std::array::from_fn(|r| std::array::from_fn(|c| relative[(r, c)] as f32));
    let (fx, fy, cx, cy) =
        (here.camera.fx as f32, here.camera.fy as f32, here.camera.cx as f32, here.camera.cy as f32);
    let (gx, gy, dx, dy) =
        (there.camera.fx as f32, there.camera.fy as f32, there.camera.cx as f32, there.camera.cy as f32);
    let (w, h) = depth.size();
    let (right, bottom) = (there.camera.width as f32 - 1.0, there.camera.height as f32 - 1.0);
    Image::from_fn(w, h, |x, y| {
        let d = depth[(x, y)];
        if d <= 0.0 {
            return 0.0;
        }
        let p = [(x as f32 - cx) / fx * d, (y as f32 - cy) / fy * d, d];
        let q: [f32; 3] = std::array::from_fn(|r| m[r][0] * p[0] + m[r][1] * p[1] + m[r][2] * p[2] + m[r][3]);
        if q[2] <= 0.0 {
            return 0.0;
        }
        let (u, v) = (gx * q[0] / q[2] + dx, gy * q[1] / q[2] + dy);
        if !(u >= 0.0 && v >= 0.0 && u <= right && v <= bottom) {
            return 0.0;
        }
        bilinear(&greys[j], f64::from(u), f64::from(v))
    })
}

struct Statistics {
    mean: Image<f32>,
    deviation: Image<f32>,
    radius: usize,
}

impl Statistics {
    fn new(image: &Image<f32>, radius: usize) -> Statistics {
        let mean = box_mean(image, radius);
        let squares = box_mean(&image.map(|v| v * v), radius);
        let (w, h) = image.size();
        let deviation = Image::from_fn(w, h, |x, y| (squares[(x, y)] - mean[(x, y)].powi(2)).max(0.0).sqrt());
        Statistics { mean, deviation, radius }
    }
}

fn correlation(
    own: &Statistics,
    image: &Image<f32>,
    other: &Image<f32>,
    options: &StereoOptions,
) -> Image<f32> {
    let theirs = Statistics::new(other, own.radius);
    let (w, h) = image.size();
    let products = Image::from_fn(w, h, |x, y| image[(x, y)] * other[(x, y)]);
    let products = box_mean(&products, own.radius);
    Image::from_fn(w, h, |x, y| {
        let at = (x, y);
        let (a, b) = (own.deviation[at], theirs.deviation[at]);
        if a < options.contrast || b < 0.5 * options.contrast {
            return -1.0;
        }
        ((products[at] - own.mean[at] * theirs.mean[at]) / (a * b)).clamp(-1.0, 1.0)
    })
}

/// The depths of a view that two other views confirm within a fraction of the depth.
fn agreed(views: &[View], depths: &[DepthImage], i: usize, options: &StereoOptions) -> DepthImage {
    /// 1.5 mm at 50 cm.
    const SAME: f64 = 0.003;
    let others = neighbours_of(views, i, 2 * options.neighbours);
    let (w, h) = depths[i].size();
    Image::from_fn(w, h, |x, y| {
        let depth = depths[i][(x, y)];
        if depth <= 0.0 {
            return 0.0;
        }
        let point = views[i].unproject(x as f64, y as f64, f64::from(depth));
        let confirms = |j: &&usize| {
            views[**j].project(&point).is_some_and(|(pixel, z)| {
                let theirs = f64::from(depths[**j][(pixel.x.round() as usize, pixel.y.round() as usize)]);
                theirs > 0.0 && (theirs - z).abs() < SAME * z
            })
        };
        if others.iter().filter(confirms).count() >= 2 { depth } else { 0.0 }
    })
}
