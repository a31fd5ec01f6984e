//! Lines across the rendered outline, and the border of the object found on each (Stoiber et al. 2020). In addition to their term,
//! the odds of the pixels on either side, edges of the image support a border (ours): `w g^2 / (g^2 + EDGE^2)` is added to its log
//! likelihood, where `g` is the change of colour across it and `w` the weight of [`Outline::with_edges`].

use sixfold_geometry::{Camera, NormalEquations, Pose, Rect, Vec2, Vec3};
use sixfold_mesh::{Mesh, simplify};
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};
use sixfold_synth::augment::{Coverage, Patch};

/// Fewest lines that determine a pose: twice its six degrees of freedom.
pub const MIN_LINES: usize = 12;

/// Maximum number of faces of a mesh that is rendered only for its outline; chosen by hand, not swept.
const OUTLINE_FACES: usize = 4000;

/// Standard deviation of the blur of the silhouette whose gradient is the outline's normal, pixels; chosen by hand, not swept.
const SILHOUETTE_BLUR: f32 = 1.5;
/// Pixels at the crop's border that are not searched for the outline: its normal would depend on pixels outside.
const CROP_MARGIN: usize = 2;
/// Where the blurred silhouette changes by less than this per pixel there is no normal (thin parts); chosen by hand, not swept.
const MIN_STEEPNESS: f64 = 0.05;
/// Range of the outline's position relative to the centre of its pixel along the normal, pixels, inwards and outwards; chosen by
/// hand, not swept.
const SUBPIXEL: (f64, f64) = (-1.0, 1.5);
/// Distance of samples on a line, pixels; chosen by hand, not swept.
const STEP: f64 = 0.5;
/// There is a border on a line only if the mean log odds of its inner third are at least this and those of its outer third at most
/// the negative of this: a probability of 0.62. Chosen by hand; not swept.
const MIN_ODDS: f32 = 0.5;
/// Smallest variance of a border's position, squared pixels, so that no line outweighs all others; chosen by hand, not swept.
const MIN_VARIANCE: f64 = 0.1;
/// From the median of absolute deviations to the standard deviation of a normal distribution.
const DEVIATION_FROM_MEDIAN: f64 = 1.4826;
/// Smallest standard deviation of all lines for the robust weights, pixels; chosen by hand, not swept.
const MIN_DEVIATION: f64 = 0.5;
/// Variance added to that of every line's border, squared pixels: that of the rendered outline. Chosen by hand; not swept.
const LINE_VARIANCE: f64 = 0.5;
/// A border at `reach` counts as a residual of this many standard deviations: those at the end of a line have a weight of about two
/// thirds. Chosen by hand; not swept.
const REACH_DEVIATIONS: f64 = 2.0;
/// Tuning constant of Tukey's biweight, in standard deviations: 95 % efficiency for normal noise (Holland and Welsch 1977).
const TUKEY: f64 = 4.685;

/// The mesh simplified to the faces that its outline needs: scans have tens of thousands, and rendering them takes longer than
/// everything else.
pub fn outline_mesh(mesh: &Mesh) -> Mesh {
    if mesh.faces().len() > OUTLINE_FACES { simplify(mesh, OUTLINE_FACES) } else { mesh.clone() }
}

/// The bounding box of a posed mesh in the image; `None` if a part of it is behind the camera.
pub fn projected_box(mesh: &Mesh, camera: &Camera, pose: &Pose) -> Option<Rect> {
    let (mut low, mut high) = (Vec2::repeat(f64::INFINITY), Vec2::repeat(f64::NEG_INFINITY));
    for vertex in mesh.vertices() {
        let pixel = camera.project(&pose.transform_point(vertex))?;
        (low, high) = (low.inf(&pixel), high.sup(&pixel));
    }
    let size = high - low;
    (size.x >= 2.0 && size.y >= 2.0).then_some(Rect { x: low.x, y: low.y, width: size.x, height: size.y })
}

/// Value of a square map at pixel `(x, y)`.
pub fn sample(map: &[f32], side: usize, x: f64, y: f64) -> f32 {
    let (first, fx, fy) = cell(side, x, y);
    let (fx, fy) = (fx as f32, fy as f32);
    let at = |dx: usize, dy: usize| map[first + dy * side + dx];
    (1.0 - fy) * ((1.0 - fx) * at(0, 0) + fx * at(1, 0)) + fy * ((1.0 - fx) * at(0, 1) + fx * at(1, 1))
}

/// The first of the four pixels around a position in a square map, and the offset of the position from it along both axes, 0 to 1.
fn cell(side: usize, x: f64, y: f64) -> (usize, f64, f64) {
    let last = (side - 1) as f64;
    let (x, y) = (x.clamp(0.0, last), y.clamp(0.0, last));
    let (x0, y0) = (x.floor().min(last - 1.0), y.floor().min(last - 1.0));
    (y0 as usize * side + x0 as usize, x - x0, y - y0)
}

/// A line across the outline on which the border was found.
#[derive(Debug, Clone, Copy)]
pub struct Line {
    /// Point of the outline in the camera's frame, metres.
    pub point: Vec3,
    /// Outward normal in the crop.
    pub normal: Vec2,
    /// Distance from the outline to the border along the normal, crop pixels.
    pub offset: f64,
    /// Variance of the offset.
    pub variance: f64,
}

/// A mesh whose outline is searched in one crop.
#[derive(Debug)]
pub struct Outline<'a> {
    mesh: &'a Mesh,
    frame: VisibilityBuffer,
    crop: Camera,
    odds: Vec<f32>,
    /// Colour gradient along x and y at every pixel, and its weight.
    edges: Option<(Vec<[f32; 2]>, f64)>,
    side: usize,
}

impl<'a> Outline<'a> {
    /// `odds` are the log odds of the object at every pixel of a square crop, row by row ([`log_odds`](super::log_odds)); `mesh`
    /// should come from [`outline_mesh`].
    ///
    /// # Panics
    /// If `odds` does not have one number per pixel of the crop.
    pub fn new(mesh: &'a Mesh, crop: &Camera, odds: Vec<f32>) -> Self {
        assert_eq!(odds.len(), crop.width * crop.height, "one number per pixel of a square crop");
        Outline { mesh, frame: VisibilityBuffer::new(crop), crop: *crop, odds, edges: None, side: crop.width }
    }

    /// The same, but borders are more likely where colours change: `weight` is added to the log likelihood of a border at a sharp
    /// edge of the image, which has the pixels of the odds.
    pub fn with_edges(mut self, patch: &Patch, weight: f64) -> Self {
        if weight > 0.0 {
            self.edges = Some((gradients(patch), weight));
        }
        self
    }

    /// Lines across the rendered outline, with the most likely border on each.
    pub fn lines(&mut self, reach: f64, pose: &Pose) -> Vec<Line> {
        let objects = [SceneObject { mesh: self.mesh, camera_from_object: *pose }];
        self.frame.render(&objects, &RenderOptions::default());
        let side = self.side;
        let inverse_depth = self.frame.inverse_depth();
        let mut soft = Coverage::from_fn(side, side, |x, y| f32::from(inverse_depth[y * side + x] > 0.0));
        soft.blur(SILHOUETTE_BLUR);
        let soft = &soft.data;
        let mut lines = Vec::new();
        let margin = CROP_MARGIN;
        for y in margin..side - margin {
            for x in margin..side - margin {
                let i = y * side + x;
                let border = inverse_depth[i] > 0.0
                    && [i - 1, i + 1, i - side, i + side].into_iter().any(|j| inverse_depth[j] <= 0.0);
                if !border {
                    continue;
                }
                let gradient = Vec2::new(
                    f64::from(soft[i + 1] - soft[i - 1]) * 0.5,
                    f64::from(soft[i + side] - soft[i - side]) * 0.5,
                );
                let steep = gradient.norm();
                if steep < MIN_STEEPNESS {
                    continue;
                }
                let normal = -gradient / steep;
                // The outline is where the blurred silhouette is one half.
                let start = Vec2::new(x as f64, y as f64)
                    + normal * ((f64::from(soft[i]) - 0.5) / steep).clamp(SUBPIXEL.0, SUBPIXEL.1);
                if let Some((offset, variance)) = self.border(&start, &normal, reach) {
                    let depth = 1.0 / f64::from(inverse_depth[i]);
                    lines.push(Line { point: self.crop.unproject(&start, depth), normal, offset, variance });
                }
            }
        }
        lines
    }

    /// Mean and variance of the border's position on a line through `start` along the outward normal.
    fn border(&self, start: &Vec2, normal: &Vec2, reach: f64) -> Option<(f64, f64)> {
        let count = (2.0 * reach / STEP) as usize + 1;
        let at = |k: usize| k as f64 * STEP - reach;
        let odds: Vec<f32> = (0..count)
            .map(|k| {
                let p = start + normal * at(k);
                sample(&self.odds, self.side, p.x, p.y)
            })
            .collect();
        // The object is occluded here, or there is no border within reach.
        let third = count / 3;
        let mean = |part: &[f32]| part.iter().sum::<f32>() / part.len() as f32;
        if mean(&odds[..third]) < MIN_ODDS || mean(&odds[count - third..]) > -MIN_ODDS {
            return None;
        }
        // Log likelihood of a border before sample k: object before it, background after it.
        let mut likelihood = Vec::with_capacity(count + 1);
        let mut sum = 0.0;
        likelihood.push(0.0);
        for o in &odds {
            sum += f64::from(*o) * STEP;
            likelihood.push(sum);
        }
        if let Some((gradients, weight)) = &self.edges {
            for (k, l) in likelihood.iter_mut().enumerate() {
                let p = start + normal * (at(k) - 0.5 * STEP);
                let change = change_along(gradients, self.side, &p, normal);
                *l += weight * change * change / (change * change + EDGE * EDGE);
            }
        }
        let best = likelihood.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let (mut total, mut first, mut second) = (0.0, 0.0, 0.0);
        for (k, l) in likelihood.iter().enumerate() {
            let weight = (l - best).exp();
            let place = at(k) - 0.5 * STEP;
            total += weight;
            first += weight * place;
            second += weight * place * place;
        }
        let mean = first / total;
        Some((mean, (second / total - mean * mean).max(MIN_VARIANCE)))
    }
}

/// Change from one pixel to the next, in the channel that changes most (0 to 1), that counts as half an edge; chosen by hand, not
/// swept.
const EDGE: f64 = 0.06;

/// The change along x and y of the channel that changes most, at every pixel.
fn gradients(patch: &Patch) -> Vec<[f32; 2]> {
    let (width, height) = (patch.width, patch.height);
    let area = width * height;
    (0..area)
        .map(|i| {
            let (x, y) = (i % width, i / width);
            let (left, right) = (i - usize::from(x > 0), i + usize::from(x + 1 < width));
            let (above, below) =
                (if y > 0 { i - width } else { i }, if y + 1 < height { i + width } else { i });
            (0..3)
                .map(|c| {
                    let plane = &patch.data[c * area..(c + 1) * area];
                    [0.5 * (plane[right] - plane[left]), 0.5 * (plane[below] - plane[above])]
                })
                .max_by(|a, b| (a[0] * a[0] + a[1] * a[1]).total_cmp(&(b[0] * b[0] + b[1] * b[1])))
                .unwrap_or_default()
        })
        .collect()
}

/// Gradient along a direction at a position between pixels.
fn change_along(gradients: &[[f32; 2]], side: usize, p: &Vec2, normal: &Vec2) -> f64 {
    let (first, fx, fy) = cell(side, p.x, p.y);
    let at = |dx: usize, dy: usize| {
        let [gx, gy] = gradients[first + dy * side + dx];
        (f64::from(gx) * normal.x + f64::from(gy) * normal.y).abs()
    };
    (1.0 - fy) * ((1.0 - fx) * at(0, 0) + fx * at(1, 0)) + fy * ((1.0 - fx) * at(0, 1) + fx * at(1, 1))
}

/// Adds the distances of lines to the normal equations of a twist about `centre` (camera frame). `line` is the weight of a line in
/// independent measurements; the weight of a line decreases with the distance of its border, in units of `robust` standard
/// deviations of all lines (Tukey's biweight; 0 for equal weights).
pub fn add_lines(
    equations: &mut NormalEquations,
    lines: &[Line],
    crop: &Camera,
    centre: &Vec3,
    reach: f64,
    line_weight: f64,
    robust: f64,
) {
    if lines.is_empty() {
        return;
    }
    let mut offsets: Vec<f64> = lines.iter().map(|line| line.offset.abs()).collect();
    let half = offsets.len() / 2;
    let deviation = DEVIATION_FROM_MEDIAN * *offsets.select_nth_unstable_by(half, f64::total_cmp).1;
    let robust = robust * deviation.max(MIN_DEVIATION);
    for line in lines {
        let rows = motion(crop, &line.point, centre);
        let jacobian: [f64; 6] =
            std::array::from_fn(|k| line.normal.x * rows[0][k] + line.normal.y * rows[1][k]);
        let mut weight =
            line_weight * tukey(REACH_DEVIATIONS * line.offset / reach) / (line.variance + LINE_VARIANCE);
        if robust > 0.0 {
            weight *= tukey(line.offset / robust);
        }
        equations.add(&jacobian, -line.offset, weight);
    }
}

/// Derivative of a point's pixel with respect to a twist `(v, w)` about `centre`, pixels per metre and radian.
pub fn motion(camera: &Camera, point: &Vec3, centre: &Vec3) -> [[f64; 6]; 2] {
    let (x, y, z) = (point.x, point.y, point.z);
    let rows = [
        Vec3::new(camera.fx / z, 0.0, -camera.fx * x / (z * z)),
        Vec3::new(0.0, camera.fy / z, -camera.fy * y / (z * z)),
    ];
    let arm = point - centre;
    rows.map(|row| {
        // d(w x arm) = row . (w x arm) = w . (arm x row)
        let turn = arm.cross(&row);
        [row.x, row.y, row.z, turn.x, turn.y, turn.z]
    })
}

/// Weight of a residual in units of its noise (Tukey's biweight, tuned to 95 % efficiency).
pub fn tukey(r: f64) -> f64 {
    let t = r / TUKEY;
    if t.abs() >= 1.0 { 0.0 } else { (1.0 - t * t).powi(2) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A square plate at 1 m that covers the crop's pixels 20 to 59.
    fn plate() -> (Mesh, Camera) {
        let camera = Camera::new(400.0, 400.0, 39.5, 39.5, 80, 80).unwrap();
        let corner = |x: f64, y: f64| Vec3::new(x * 0.05, y * 0.05, 0.0);
        let vertices = vec![corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)];
        (Mesh::new(vertices, vec![[0, 2, 1], [0, 3, 2], [0, 1, 2], [0, 2, 3]]).unwrap(), camera)
    }

    /// Mean outward distance of the borders found, if odds change `odds` pixels outside the outline and colours `colors` pixels
    /// outside.
    fn found(odds: f64, colors: f64, weight: f64) -> f64 {
        let (mesh, camera) = plate();
        let outside = |i: usize, by: f64| {
            let (x, y) = ((i % 80) as f64 - 39.5, (i / 80) as f64 - 39.5);
            x.abs().max(y.abs()) > 20.0 + by
        };
        // Odds like those of a network or a histogram: uncertain near the border.
        let map: Vec<f32> = (0..80 * 80)
            .map(|i| {
                let (x, y) = ((i % 80) as f64 - 39.5, (i / 80) as f64 - 39.5);
                (20.0 + odds - x.abs().max(y.abs())).clamp(-3.0, 3.0) as f32 * 0.7
            })
            .collect();
        let mut patch = Patch::filled(80, 80, [0.6; 3]);
        for i in (0..80 * 80).filter(|i| outside(*i, colors)) {
            patch.data[80 * 80 + i] = 0.2;
        }
        let mut outline = Outline::new(&mesh, &camera, map).with_edges(&patch, weight);
        let lines = outline.lines(5.0, &Pose::from_translation(Vec3::new(0.0, 0.0, 1.0)));
        assert!(lines.len() > 100, "{}", lines.len());
        lines.iter().map(|line| line.offset).sum::<f64>() / lines.len() as f64
    }

    #[test]
    fn an_edge_near_the_border_of_the_log_odds_shifts_the_border() {
        // With odds alone the border is where they change their sign.
        let alone = found(2.0, 0.0, 0.0);
        assert!((alone - 2.0).abs() < 0.3, "{alone}");
        // The edge two pixels further inside shifts it there, and more with a larger weight.
        let (little, much) = (found(2.0, 0.0, 2.0), found(2.0, 0.0, 8.0));
        assert!(much < little && little < alone && much.abs() < 0.4, "{alone} {little} {much}");
        // An edge far away does not.
        let far = found(0.0, 15.0, 8.0);
        assert!(far.abs() < 0.3, "{far}");
    }
}
