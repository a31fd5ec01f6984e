//! Direct alignment of a pose: the object is rendered, small windows of the render are compared with the crop, and Gauss-Newton
//! over all windows together moves the pose (Lucas and Kanade 1981, with the pose as the motion; windows normalised in brightness
//! and contrast): minimised is the sum over windows of w |(I(x + d(pose)) - mean) / contrast - T(x)|^2, T the normalised render. Where the object has no edges or texture, nothing changes.

use sixfold_align::outline::motion;
use sixfold_geometry::{Camera, NormalEquations, Pose, Vec2, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::VisibilityBuffer;
use sixfold_synth::augment::{Coverage, Patch};

use crate::templates::render;

/// From coarse to fine: standard deviation of the blur, half the side of a window, and the distance of windows, pixels.
const LEVELS: [(f32, usize, usize); 3] = [(2.5, 8, 8), (1.4, 7, 7), (0.8, 6, 6)];
/// Renders at each level.
const RENDERS: usize = 2;
/// Steps for each render.
const STEPS: usize = 6;
/// Contrasts below this are not amplified, of 1.
const MIN_CONTRAST: f32 = 0.04;
/// Smallest fraction of a window that shows the object.
const MIN_SHOWN: f32 = 0.5;
/// Correlation of a window and the crop below which the window has no weight.
const UNRELATED: f32 = 0.3;
/// Smallest variance of a residual.
const LEAST_NOISE: f32 = 0.2;
/// Independent measurements per pixel of a window, for residuals of unit variance.
const INFORMATION: f64 = 0.1;
/// Standard deviations of the pose before: pixels, fraction of the distance, radians.
const BEFORE: [f64; 3] = [3.0, 0.04, 0.08];
/// Smallest mean correlation of the windows with the crop before, at the coarsest level.
const MIN_BEFORE: f32 = 0.25;
/// The steps for a render stop when no window moves by more than this, pixels.
const CONVERGED: f64 = 0.01;
/// Smallest mean of the squared normalised values of a window, over all channels.
const MIN_ENERGY: f32 = 0.3;
/// Numbers that are added up side by side.
const LANES: usize = 16;
/// Fewest windows.
const MIN_WINDOWS: usize = 4;

/// A window of a render.
struct Window {
    /// Its centre, and the object's point there.
    centre: Vec2,
    point: Vec3,
    /// Half its side, pixels.
    half: usize,
    /// 1 for its pixels that show the object and their neighbours do, row by row, with zeros up to a multiple of [`LANES`].
    mask: Vec<f32>,
    /// The sum of the mask.
    shown: f32,
    /// For each channel the normalised values, their derivatives by x, and those by y; 0 where the mask is.
    values: Vec<f32>,
    /// Sum of the squared values.
    energy: f32,
}

/// A window and the crop.
struct Compared {
    /// Sums of the products of the derivatives: xx, xy, yy.
    gradients: [f32; 3],
    /// Sums of the products of derivatives and differences: x, y.
    sums: [f32; 2],
    correlation: f32,
}

/// Aligns poses in one crop.
pub(crate) struct Direct<'a> {
    mesh: &'a Mesh,
    camera: &'a Camera,
    /// The crop, blurred for each level.
    blurred: Vec<Patch>,
    /// The object's centre.
    centre: Vec3,
}

impl<'a> Direct<'a> {
    pub(crate) fn new(mesh: &'a Mesh, camera: &'a Camera, crop: &Patch) -> Direct<'a> {
        let blurred = LEVELS.map(|(sigma, ..)| {
            let mut patch = crop.clone();
            patch.blur(sigma);
            patch
        });
        let (low, high) = mesh.bounding_box();
        Direct { mesh, camera, blurred: blurred.to_vec(), centre: (low + high) * 0.5 }
    }

    /// The aligned pose, and the mean correlation of its windows with the crop; `None` if the crop hardly shows what is drawn on the
    /// object.
    pub(crate) fn run(&self, start: &Pose) -> Option<(Pose, f64)> {
        let mut frame = VisibilityBuffer::new(self.camera);
        let mut pose = *start;
        let mut agreement = None;
        for (level, crop) in LEVELS.iter().zip(&self.blurred) {
            for _ in 0..RENDERS {
                let windows = self.windows(&mut frame, &pose, *level);
                if agreement.is_none() && self.agreement(&windows, crop, &pose) < MIN_BEFORE {
                    return None;
                }
                for _ in 0..STEPS {
                    let (next, moved) = self.step(&windows, crop, start, &pose)?;
                    pose = next;
                    if moved < CONVERGED {
                        break;
                    }
                }
                agreement = Some(self.agreement(&windows, crop, &pose));
            }
        }
        Some((pose, f64::from(agreement?)))
    }

    /// Mean correlation of windows at a pose with the crop.
    fn agreement(&self, windows: &[Window], crop: &Patch, pose: &Pose) -> f32 {
        let mut seen = Vec::new();
        let correlation = |window: &Window| {
            let pixel = self.camera.project(&pose.transform_point(&window.point))?;
            Some(window.compared(crop, &(pixel - window.centre), &mut seen)?.correlation)
        };
        windows.iter().filter_map(correlation).sum::<f32>() / windows.len().max(1) as f32
    }

    /// The windows of the object rendered at a pose.
    fn windows(&self, frame: &mut VisibilityBuffer, pose: &Pose, level: (f32, usize, usize)) -> Vec<Window> {
        let (sigma, half, step) = level;
        let rendered = render(frame, self.mesh, pose, None);
        let side = self.camera.width;
        let mut mask =
            Coverage::from_fn(side, side, |x, y| f32::from(!rendered.coordinates[(x, y)][0].is_nan()));
        let shown: Vec<bool> = mask.data.iter().map(|v| *v > 0.5).collect();
        let mut image = Patch::from_rgb(&rendered.image);
        for plane in image.planes_mut() {
            plane.iter_mut().zip(&shown).filter(|(_, shown)| !**shown).for_each(|(v, _)| *v = 0.0);
        }
        image.blur(sigma);
        mask.blur(sigma);
        for plane in image.planes_mut() {
            plane.iter_mut().zip(&mask.data).for_each(|(v, m)| *v /= m.max(1e-3));
        }
        // Pixels whose neighbours are on the object and not mixed with the background by the blur.
        let drawn = Coverage::from_fn(side, side, |x, y| {
            let i = y * side + x;
            let border = x == 0 || y == 0 || x + 1 == side || y + 1 == side;
            let inside = !border && mask.data[i] > 0.9;
            f32::from(inside && shown[i - 1] && shown[i + 1] && shown[i - side] && shown[i + side])
        });
        let mut windows = Vec::new();
        for cy in (half + 1..side.saturating_sub(half + 1)).step_by(step) {
            for cx in (half + 1..side.saturating_sub(half + 1)).step_by(step) {
                let point = rendered.coordinates[(cx, cy)];
                if point[0].is_nan() {
                    continue;
                }
                windows.extend(Window::new([cx, cy], point, half, &image, &drawn));
            }
        }
        windows
    }

    /// The next pose, and the largest motion of a window, pixels.
    fn step(&self, windows: &[Window], crop: &Patch, start: &Pose, pose: &Pose) -> Option<(Pose, f64)> {
        let centre = pose.transform_point(&self.centre);
        let mut equations = NormalEquations::default();
        let (mut used, mut seen) = (Vec::new(), Vec::new());
        for window in windows {
            let point = pose.transform_point(&window.point);
            let Some(pixel) = self.camera.project(&point) else { continue };
            let shift = pixel - window.centre;
            let Some(compared) = window.compared(crop, &shift, &mut seen) else { continue };
            let correlation = compared.correlation;
            let related = ((correlation - UNRELATED) / (1.0 - UNRELATED)).max(0.0).powi(2);
            let weight = related / (2.0 * (1.0 - correlation) + LEAST_NOISE);
            if weight <= 0.0 {
                continue;
            }
            // The normal equations of the shift as two independent residuals.
            let [xx, xy, yy] = compared.gradients.map(|v| f64::from(v) + 1e-9);
            let [bx, by] = compared.sums.map(f64::from);
            let first = xx.sqrt();
            let mixed = xy / first;
            let second = (yy - mixed * mixed).max(1e-9).sqrt();
            let [row_x, row_y] = motion(self.camera, &point, &centre);
            let e = bx / first;
            let weight = INFORMATION * f64::from(weight);
            let both: [f64; 6] = std::array::from_fn(|k| first * row_x[k] + mixed * row_y[k]);
            equations.add(&both, e, weight);
            equations.add(&row_y.map(|v| second * v), (by - mixed * e) / second, weight);
            used.push((point, pixel));
        }
        if used.len() < MIN_WINDOWS {
            return None;
        }
        self.add_start(&mut equations, start, pose, &centre)?;
        let step = equations.solve(1e-3)?;
        let about = Pose::from_translation(centre);
        let change = about * Pose::exp(&step) * about.inverse();
        let next = change * *pose;
        let t = next.translation();
        if !(t.z > 0.01 && t.iter().all(|v| v.is_finite())) {
            return None;
        }
        let moved = used.iter().filter_map(|(point, pixel)| {
            Some((self.camera.project(&change.transform_point(point))? - pixel).norm())
        });
        Some((next, moved.fold(0.0, f64::max)))
    }

    /// The pose before as measurements.
    fn add_start(
        &self,
        equations: &mut NormalEquations,
        start: &Pose,
        pose: &Pose,
        centre: &Vec3,
    ) -> Option<()> {
        let before = start.transform_point(&self.centre);
        let [pixels, depth, angle] = BEFORE;
        let off = self.camera.project(centre)? - self.camera.project(&before)?;
        let [row_x, row_y] = motion(self.camera, centre, centre);
        equations.add(&row_x, off.x, pixels.powi(-2));
        equations.add(&row_y, off.y, pixels.powi(-2));
        let nearer = (centre.z / before.z).ln();
        equations.add(&[0.0, 0.0, 1.0 / centre.z, 0.0, 0.0, 0.0], nearer, depth.powi(-2));
        let rotated = (pose.rotation() * start.rotation().inverse()).scaled_axis();
        for axis in 0..3 {
            let mut row = [0.0; 6];
            row[3 + axis] = 1.0;
            equations.add(&row, rotated[axis], angle.powi(-2));
        }
        Some(())
    }
}

sixfold_nn::vectorised! {
    /// Mean of the values where the mask is 1, and the factor to unit variance.
    fn normalisation(values: &[f32], mask: &[f32], shown: f32) -> [f32; 2] {
        let (values, _) = values.as_chunks::<LANES>();
        let (masks, _) = mask.as_chunks::<LANES>();
        let mut sums = [0.0f32; LANES];
        for (values, masks) in values.iter().zip(masks) {
            for l in 0..LANES {
                sums[l] += masks[l] * values[l];
            }
        }
        let mean = sums.iter().sum::<f32>() / shown;
        let mut squares = [0.0f32; LANES];
        for (values, masks) in values.iter().zip(masks) {
            for l in 0..LANES {
                squares[l] += masks[l] * (values[l] - mean) * (values[l] - mean);
            }
        }
        let variance = squares.iter().sum::<f32>() / shown;
        [mean, 1.0 / variance.sqrt().max(MIN_CONTRAST)]
    }
}

sixfold_nn::vectorised! {
    /// Interpolates a window of `wide` x `wide` pixels of a plane, the first pixel of which has number `start`.
    fn interpolate(out: &mut [f32], plane: &[f32], side: usize, start: usize, wide: usize, weights: [f32; 4]) {
        for (row, out) in out.chunks_exact_mut(wide).take(wide).enumerate() {
            let above = &plane[start + row * side..][..wide + 1];
            let below = &plane[start + (row + 1) * side..][..wide + 1];
            for x in 0..wide {
                out[x] = weights[0] * above[x] + weights[1] * above[x + 1] + weights[2] * below[x] + weights[3] * below[x + 1];
            }
        }
    }
}

sixfold_nn::vectorised! {
    /// Sums over one channel of a window: products of the derivatives (xx, xy, yy), of derivatives and differences (x, y), of the values seen
    /// and drawn, and of those seen with themselves.
    fn products(seen: &[f32], mask: &[f32], values: &[f32], mean: f32, scale: f32) -> [f32; 7] {
        let count = mask.len();
        let (drawn, derivatives) = values.split_at(count);
        let (dx, dy) = derivatives.split_at(count);
        let (seen, _) = seen.as_chunks::<LANES>();
        let (masks, _) = mask.as_chunks::<LANES>();
        let (drawn, _) = drawn.as_chunks::<LANES>();
        let (dx, _) = dx.as_chunks::<LANES>();
        let (dy, _) = dy.as_chunks::<LANES>();
        let mut sums = [[0.0f32; LANES]; 7];
        for ((((seen, mask), drawn), dx), dy) in seen.iter().zip(masks).zip(drawn).zip(dx).zip(dy) {
            for l in 0..LANES {
                let v = mask[l] * (seen[l] - mean) * scale;
                let difference = v - drawn[l];
                sums[0][l] += dx[l] * dx[l];
                sums[1][l] += dx[l] * dy[l];
                sums[2][l] += dy[l] * dy[l];
                sums[3][l] += dx[l] * difference;
                sums[4][l] += dy[l] * difference;
                sums[5][l] += v * drawn[l];
                sums[6][l] += v * v;
            }
        }
        sums.map(|lanes| lanes.iter().sum())
    }
}

impl Window {
    /// The window of a render around a pixel that shows `point`, with half a side of `half` pixels; `drawn` is 1 for pixels
    /// that have neighbours on the object. `None` if it is hardly on the object or has one colour.
    fn new(
        [cx, cy]: [usize; 2],
        point: [f32; 3],
        half: usize,
        image: &Patch,
        drawn: &Coverage,
    ) -> Option<Window> {
        let (side, wide) = (image.width, 2 * half + 1);
        let area = wide * wide;
        let padded = area.next_multiple_of(LANES);
        let first = (cy - half) * side + cx - half;
        let mut mask = vec![0.0f32; padded];
        for (row, mask) in mask.chunks_exact_mut(wide).take(wide).enumerate() {
            mask.copy_from_slice(&drawn.data[first + row * side..][..wide]);
        }
        let shown: f32 = mask.iter().sum();
        if shown < MIN_SHOWN * area as f32 {
            return None;
        }
        let mut values = vec![0.0; 9 * padded];
        let mut energy = 0.0;
        let mut own = vec![0.0; padded];
        for (plane, values) in image.data.chunks_exact(side * side).zip(values.chunks_exact_mut(3 * padded)) {
            for (row, own) in own.chunks_exact_mut(wide).take(wide).enumerate() {
                own.copy_from_slice(&plane[first + row * side..][..wide]);
            }
            let [mean, scale] = normalisation(&own, &mask, shown);
            let (drawn, derivatives) = values.split_at_mut(padded);
            let (dx, dy) = derivatives.split_at_mut(padded);
            for row in 0..wide {
                let (i, k) = (first + row * side, row * wide);
                let around =
                    [-1, 1, -(side as i64), side as i64].map(|o| &plane[(i as i64 + o) as usize..][..wide]);
                let pixels = own[k..].iter().zip(&mask[k..]).take(wide);
                for (x, (v, m)) in pixels.enumerate() {
                    let value = m * (v - mean) * scale;
                    energy += value * value;
                    drawn[k + x] = value;
                    dx[k + x] = m * 0.5 * scale * (around[1][x] - around[0][x]);
                    dy[k + x] = m * 0.5 * scale * (around[3][x] - around[2][x]);
                }
            }
        }
        let centre = Vec2::new(cx as f64, cy as f64);
        let point = Vec3::from(point.map(f64::from));
        (energy > MIN_ENERGY * shown).then_some(Window { centre, point, half, mask, shown, values, energy })
    }

    /// The window and the crop at a shift; `None` if the crop does not contain it. `seen` is a buffer.
    fn compared(&self, crop: &Patch, shift: &Vec2, seen: &mut Vec<f32>) -> Option<Compared> {
        let side = crop.width;
        let at = self.centre + shift;
        let (x0, y0) = (at.x.floor(), at.y.floor());
        let (fx, fy) = ((at.x - x0) as f32, (at.y - y0) as f32);
        let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
        let (half, wide) = (self.half as f64, 2 * self.half + 1);
        let last = side as f64 - 1.0 - half;
        if !(x0 >= half && y0 >= half && x0 < last && y0 < last) {
            return None;
        }
        let start = (y0 as usize - self.half) * side + x0 as usize - self.half;
        let count = self.mask.len();
        seen.clear();
        seen.resize(count, 0.0);
        let mut sums = [0.0f32; 7];
        for (plane, values) in crop.data.chunks_exact(side * side).zip(self.values.chunks_exact(3 * count)) {
            interpolate(seen, plane, side, start, wide, weights);
            let [mean, scale] = normalisation(seen, &self.mask, self.shown);
            let more = products(seen, &self.mask, values, mean, scale);
            sums.iter_mut().zip(more).for_each(|(sum, more)| *sum += more);
        }
        let [xx, xy, yy, x, y, product, energy] = sums;
        let correlation = product / (energy * self.energy).sqrt().max(1e-6);
        Some(Compared { gradients: [xx, xy, yy], sums: [x, y], correlation })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::tests::cuboid;
    use crate::printed::tests::{photograph, printed_box};
    use sixfold_geometry::RgbImage;

    const SIDE: usize = 224;

    fn camera() -> Camera {
        let middle = 0.5 * (SIDE as f64 - 1.0);
        Camera::new(1100.0, 1100.0, middle, middle, SIDE, SIDE).unwrap()
    }

    fn truth() -> Pose {
        Pose::exp(&[0.0, 0.0, 0.0, 0.9, -0.7, 2.6].into()).with_translation(Vec3::new(0.005, -0.004, 0.6))
    }

    /// A crop in which the object is darker to the right, has less contrast, and is blurred; `hide` covers pixels.
    fn crop(mesh: &Mesh, hide: impl Fn(usize, usize) -> bool) -> Patch {
        let image = photograph(mesh, &truth(), &camera());
        let changed = RgbImage::from_fn(SIDE, SIDE, |x, y| {
            if hide(x, y) {
                return [(x * 31 + y * 57) as u8; 3];
            }
            let gain = 0.6 - 0.3 * x as f64 / SIDE as f64;
            image[(x, y)].map(|v| (30.0 + gain * f64::from(v)) as u8)
        });
        let mut patch = Patch::from_rgb(&changed);
        patch.blur(0.8);
        patch
    }

    /// Distance in metres and angle in degrees.
    fn errors(pose: &Pose) -> [f64; 2] {
        [pose.distance_to(&truth()), pose.rotation_angle_to(&truth()).to_degrees()]
    }

    /// 12 mm farther, 2 pixels aside, 3 degrees.
    fn near() -> Pose {
        let moved = Pose::exp(&[0.0, 0.0, 0.0, 0.03, -0.03, 0.03].into()) * truth();
        moved.with_translation(truth().translation() * 1.02 + Vec3::new(0.001, -0.001, 0.0))
    }

    #[test]
    fn a_printed_object_is_aligned_to_a_fraction_of_a_pixel_in_other_light() {
        let mesh = printed_box();
        let before = errors(&near());
        assert!(before[0] > 0.012 && before[1] > 2.5, "{before:?}");
        let photograph = crop(&mesh, |_, _| false);
        let (pose, drawn) = Direct::new(&mesh, &camera(), &photograph).run(&near()).unwrap();
        let after = errors(&pose);
        // A millimetre of distance moves the box's border by 0.15 pixels.
        assert!(after[0] < 0.001 && after[1] < 0.2, "{after:?}");
        assert!(drawn > 0.8, "{drawn}");
        let hidden = crop(&mesh, |x, _| x < SIDE / 2);
        let (pose, less) = Direct::new(&mesh, &camera(), &hidden).run(&near()).unwrap();
        let after = errors(&pose);
        assert!(after[0] < 0.002 && after[1] < 0.4, "{after:?}");
        assert!(less < drawn, "{less} {drawn}");
    }

    #[test]
    fn without_a_common_print_there_is_no_alignment() {
        let mesh = printed_box();
        let nothing = crop(&mesh, |_, _| true);
        assert_eq!(Direct::new(&mesh, &camera(), &nothing).run(&near()), None);
        // One colour from all sides in plain light.
        let plain = cuboid([-0.05, -0.03, -0.02], [0.05, 0.03, 0.02], [90, 90, 90]);
        let flat = Patch::filled(SIDE, SIDE, [0.5; 3]);
        assert_eq!(Direct::new(&plain, &camera(), &flat).run(&near()), None);
    }

    #[test]
    fn a_window_is_compared_by_sums_over_its_pixels_on_the_object() {
        let side = 40;
        let noise = |seed: usize| {
            let mut patch = Patch::filled(side, side, [0.0; 3]);
            let values = patch.data.iter_mut().enumerate();
            values.for_each(|(i, v)| *v = ((i * 7919 + seed) % 997) as f32 / 997.0);
            patch
        };
        let (image, crop) = (noise(1), noise(500));
        let drawn = Coverage::from_fn(side, side, |x, y| f32::from((x + y) % 5 != 0));
        let window = Window::new([20, 18], [0.0; 3], 6, &image, &drawn).unwrap();
        let found = window.compared(&crop, &Vec2::new(1.25, -0.5), &mut Vec::new()).unwrap();
        let all = (12..=24).flat_map(|y| (14..=26).map(move |x| (x, y)));
        let pixels: Vec<(usize, usize)> = all.filter(|(x, y)| (x + y) % 5 != 0).collect();
        // Values less their mean, and the factor to unit variance.
        let normalised = |at: &dyn Fn(usize, usize) -> f64| {
            let values: Vec<f64> = pixels.iter().map(|(x, y)| at(*x, *y)).collect();
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64;
            let scale = 1.0 / variance.sqrt();
            (values.into_iter().map(|v| (v - mean) * scale).collect::<Vec<f64>>(), scale)
        };
        let mut sums = [0.0; 7];
        for channel in 0..3 {
            let of = |patch: &Patch, x: usize, y: usize| {
                f64::from(patch.data[channel * side * side + y * side + x])
            };
            let (template, scale) = normalised(&|x, y| of(&image, x, y));
            // The shift is a pixel and a quarter to the right, half a pixel up.
            let seen = |x: usize, y: usize| {
                let row = |y: usize| 0.75 * of(&crop, x + 1, y) + 0.25 * of(&crop, x + 2, y);
                0.5 * (row(y - 1) + row(y))
            };
            for (((x, y), t), v) in pixels.iter().zip(template).zip(normalised(&seen).0) {
                let dx = 0.5 * scale * (of(&image, x + 1, *y) - of(&image, x - 1, *y));
                let dy = 0.5 * scale * (of(&image, *x, y + 1) - of(&image, *x, y - 1));
                let terms = [dx * dx, dx * dy, dy * dy, dx * (v - t), dy * (v - t), v * t, t * t];
                sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
            }
        }
        let [xx, xy, yy, x, y, product, energy] = sums;
        let right = [xx, xy, yy, x, y, product / energy];
        let [a, b, c] = found.gradients;
        let [d, e] = found.sums;
        for (found, right) in [a, b, c, d, e, found.correlation].into_iter().zip(right) {
            assert!((f64::from(found) - right).abs() < 1e-3 * right.abs().max(1.0), "{found} {right}");
        }
        assert!(xy.abs() > 1.0, "the noise has no mixed gradient: {xy}");
        // A window that is not inside the crop.
        assert!(window.compared(&crop, &Vec2::new(15.0, 0.0), &mut Vec::new()).is_none());
    }
}
