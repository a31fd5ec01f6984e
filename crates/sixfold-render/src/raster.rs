//! The rasteriser: renders triangles to a visibility buffer of inverse depth and triangle index.
//!
//! Edge functions after Pineda (1988) in integers; depth from the plane through the triangle, for which
//! `1/z` is linear in the pixel coordinates.

use rayon::prelude::*;
use sixfold_geometry::{Camera, DepthImage, Image, Mask, Pose, Rect, Vec3};
use sixfold_mesh::Mesh;

/// Steps of the sub-pixel grid per pixel.
const SUBPIXEL_BITS: u32 = 12;
const SUBPIXEL: f64 = (1u32 << SUBPIXEL_BITS) as f64;
/// Projected corners further out than this many pixels are clipped before they are rounded.
const GUARD: f64 = (1u32 << 16) as f64;
/// Marks a pixel without a triangle.
const NOTHING: u32 = u32::MAX;
/// Triangles of at most this many pixels in width and height are filled without branches; their edge functions fit 32 bits.
const SMALL: u32 = 24;
/// Rows per parallel band.
const BAND: usize = 16;

/// Which sides of a triangle are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Culling {
    /// Both sides: right for scans with holes and inconsistent winding.
    #[default]
    None,
    /// Only triangles whose corners run counter-clockwise seen from the camera.
    Back,
}

/// Options of the rasteriser.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RenderOptions {
    /// Distance of the near plane in metres; nearer parts are clipped.
    pub near: f64,
    /// Which sides are drawn.
    pub culling: Culling,
    /// Whether all of rayon's threads are used for one image; the result is the same either way.
    pub parallel: bool,
}

impl Default for RenderOptions {
    fn default() -> Self {
        RenderOptions { near: 0.01, culling: Culling::None, parallel: false }
    }
}

/// A mesh at a pose.
#[derive(Debug, Clone, Copy)]
pub struct SceneObject<'a> {
    /// The mesh, in its own frame, metres.
    pub mesh: &'a Mesh,
    /// Its pose.
    pub camera_from_object: Pose,
}

/// The visibility buffer of one image, to be reused: [`VisibilityBuffer::render`] clears only the pixels that the last image
/// covered.
#[derive(Debug, Clone)]
pub struct VisibilityBuffer {
    pub(crate) camera: Camera,
    width: usize,
    height: usize,
    /// 1/z, 0 where nothing was rendered.
    inverse_depth: Vec<f32>,
    /// Index of the triangle, counted over all objects in order; [`NOTHING`] where nothing was rendered.
    triangle: Vec<u32>,
    /// Index of the first triangle of each object, and the end.
    starts: Vec<u32>,
    /// Covered columns and rows of the last image, half open.
    dirty: [usize; 4],
    corners: Vec<Corner>,
    extra: Vec<ClippedTriangle>,
}

/// A vertex after projection.
#[derive(Debug, Clone, Copy)]
struct Corner {
    /// In the camera frame.
    point: [f64; 3],
    /// 1/z.
    inverse: f64,
    /// Rounded to the sub-pixel grid; meaningless when `clip`.
    x: i32,
    y: i32,
    /// Nearer than the near plane or outside the guard band.
    clip: bool,
}

/// A piece of a triangle that had to be clipped: its number, its own plane, and three rounded corners.
#[derive(Debug, Clone, Copy)]
struct ClippedTriangle {
    number: u32,
    plane: Plane,
    corners: [(i32, i32); 3],
}

/// `1/z = a x + b y + c` at pixel `(x, y)`, kept between `low` and `high`.
#[derive(Debug, Clone, Copy)]
struct Plane {
    a: f64,
    b: f64,
    c: f64,
    low: f32,
    high: f32,
}

impl Plane {
    /// The plane through three points in the camera frame whose 1/z lie between `low` and `high`.
    fn through(camera: &Camera, focal_inverse: [f64; 2], p: [&[f64; 3]; 3], low: f64, high: f64) -> Plane {
        let e1 = sub(p[1], p[0]);
        let e2 = sub(p[2], p[0]);
        let n = [e1[1] * e2[2] - e1[2] * e2[1], e1[2] * e2[0] - e1[0] * e2[2], e1[0] * e2[1] - e1[1] * e2[0]];
        let d = n[0] * p[0][0] + n[1] * p[0][1] + n[2] * p[0][2];
        // The triangle is seen exactly edge-on: no pixel's ray meets the plane in one point, so use the mean.
        let scale = 1.0 / d;
        if !scale.is_finite() {
            return Plane { a: 0.0, b: 0.0, c: 0.5 * (low + high), low: low as f32, high: high as f32 };
        }
        let a = n[0] * scale * focal_inverse[0];
        let b = n[1] * scale * focal_inverse[1];
        let c = n[2] * scale - a * camera.cx - b * camera.cy;
        Plane { a, b, c, low: low as f32, high: high as f32 }
    }
}

fn sub(a: &[f64; 3], b: &[f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// An image that is reused for rendering: only the pixels that the last rendering covered are cleared, and its memory is
/// kept. For a small object in a large image, clearing and allocating would be most of the cost.
#[derive(Debug, Clone)]
pub struct Canvas<T> {
    image: Image<T>,
    empty: T,
    /// Columns and rows that may differ from `empty`, half open.
    drawn: [usize; 4],
}

impl<T: Copy> Canvas<T> {
    /// An image in which every pixel is `empty`. [`VisibilityBuffer::depth_into`] and similar functions resize it.
    pub fn new(width: usize, height: usize, empty: T) -> Canvas<T> {
        Canvas { image: Image::filled(width, height, empty), empty, drawn: [0; 4] }
    }

    /// The last rendered image.
    pub fn image(&self) -> &Image<T> {
        &self.image
    }

    /// The last rendered image, by value.
    pub(crate) fn into_image(self) -> Image<T> {
        self.image
    }

    /// Sets the image's size and clears the pixels that the last rendering covered and the next one does not; the caller
    /// writes every pixel of `next` (`[x0, y0, x1, y1]`).
    pub(crate) fn begin(&mut self, width: usize, height: usize, next: [usize; 4]) -> &mut [T] {
        if self.image.size() != (width, height) {
            *self = Canvas::new(width, height, self.empty);
        }
        let [x0, y0, x1, y1] = self.drawn;
        for y in y0..y1 {
            let row = &mut self.image.as_mut_slice()[y * width..(y + 1) * width];
            if y < next[1] || y >= next[3] {
                row[x0..x1].fill(self.empty);
            } else {
                row[x0..x1.min(next[0]).max(x0)].fill(self.empty);
                row[x0.max(next[2]).min(x1)..x1].fill(self.empty);
            }
        }
        self.drawn = next;
        self.image.as_mut_slice()
    }
}

impl VisibilityBuffer {
    /// An empty buffer for images of `camera`'s size.
    pub fn new(camera: &Camera) -> VisibilityBuffer {
        let pixels = camera.width * camera.height;
        VisibilityBuffer {
            camera: camera.without_distortion(),
            width: camera.width,
            height: camera.height,
            inverse_depth: vec![0.0; pixels],
            triangle: vec![NOTHING; pixels],
            starts: vec![0],
            dirty: [0; 4],
            corners: Vec::new(),
            extra: Vec::new(),
        }
    }

    /// Adapts the buffer to another camera, keeping its memory if possible.
    pub fn set_camera(&mut self, camera: &Camera) {
        if (camera.width, camera.height) == (self.width, self.height) {
            self.camera = camera.without_distortion();
            return;
        }
        self.camera = camera.without_distortion();
        self.width = camera.width;
        self.height = camera.height;
        self.inverse_depth.clear();
        self.inverse_depth.resize(camera.width * camera.height, 0.0);
        self.triangle.clear();
        self.triangle.resize(camera.width * camera.height, NOTHING);
        self.dirty = [0; 4];
    }

    /// Renders the objects and replaces the previous content. Where two surfaces are equally near, the first object and
    /// triangle is kept.
    pub fn render(&mut self, objects: &[SceneObject<'_>], options: &RenderOptions) {
        self.clear();
        self.starts.clear();
        self.starts.push(0);
        let mut first = 0u32;
        for object in objects {
            self.draw(object, first, options);
            first += object.mesh.faces().len() as u32;
            self.starts.push(first);
        }
    }

    fn clear(&mut self) {
        let [x0, y0, x1, y1] = self.dirty;
        for y in y0..y1 {
            let row = y * self.width;
            self.inverse_depth[row + x0..row + x1].fill(0.0);
            self.triangle[row + x0..row + x1].fill(NOTHING);
        }
        self.dirty = [self.width, self.height, 0, 0];
    }

    fn draw(&mut self, object: &SceneObject<'_>, first: u32, options: &RenderOptions) {
        let camera = self.camera;
        let rotation = object.camera_from_object.rotation_matrix();
        let t = object.camera_from_object.translation();
        let r: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| rotation[(i, j)]));
        let near = options.near.max(1e-6);
        let mut any_clip = false;
        let mut corners = std::mem::take(&mut self.corners);
        corners.clear();
        corners.extend(object.mesh.vertices().iter().map(|v| {
            let point = [
                r[0][0] * v.x + r[0][1] * v.y + r[0][2] * v.z + t.x,
                r[1][0] * v.x + r[1][1] * v.y + r[1][2] * v.z + t.y,
                r[2][0] * v.x + r[2][1] * v.y + r[2][2] * v.z + t.z,
            ];
            let inverse = 1.0 / point[2];
            let x = camera.fx * point[0] * inverse + camera.cx;
            let y = camera.fy * point[1] * inverse + camera.cy;
            let clip = !(point[2] >= near && x.abs() < GUARD && y.abs() < GUARD);
            any_clip |= clip;
            if clip {
                Corner { point, inverse, x: 0, y: 0, clip }
            } else {
                Corner { point, inverse, x: to_grid(x), y: to_grid(y), clip }
            }
        }));
        let mut extra = std::mem::take(&mut self.extra);
        extra.clear();
        if any_clip {
            for (face, f) in object.mesh.faces().iter().enumerate() {
                let c = f.map(|i| &corners[i as usize]);
                if c.iter().any(|c| c.clip) {
                    clip_triangle(&camera, near, c, first + face as u32, &mut extra);
                }
            }
        }
        let work = Work {
            camera: &camera,
            focal_inverse: [1.0 / camera.fx, 1.0 / camera.fy],
            corners: &corners,
            faces: object.mesh.faces(),
            first,
            extra: &extra,
            culling: options.culling,
        };
        let width = self.width;
        let dirty = if options.parallel && self.height > BAND {
            self.inverse_depth
                .par_chunks_mut(BAND * width)
                .zip(self.triangle.par_chunks_mut(BAND * width))
                .enumerate()
                .map(|(band, (inverse_depth, triangle))| {
                    work.draw_rows(band * BAND, width, inverse_depth, triangle)
                })
                .reduce(|| [usize::MAX, usize::MAX, 0, 0], union)
        } else {
            work.draw_rows(0, width, &mut self.inverse_depth, &mut self.triangle)
        };
        self.dirty = union(self.dirty, dirty);
        self.corners = corners;
        self.extra = extra;
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// The camera the buffer is for.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// `[x0, y0, x1, y1]`, half open: a rectangle outside which nothing was rendered.
    pub fn covered(&self) -> [usize; 4] {
        let [x0, y0, x1, y1] = self.dirty;
        if x1 <= x0 || y1 <= y0 { [0; 4] } else { self.dirty }
    }

    /// 1/depth per pixel in 1/metres, row by row; 0 where nothing was rendered.
    pub fn inverse_depth(&self) -> &[f32] {
        &self.inverse_depth
    }

    /// Object and face rendered at pixel `index` (`y * width + x`).
    pub fn surface_at(&self, index: usize) -> Option<(usize, usize)> {
        let number = self.triangle[index];
        if number == NOTHING {
            return None;
        }
        let object = self.starts.partition_point(|&s| s <= number) - 1;
        Some((object, (number - self.starts[object]) as usize))
    }

    /// Depth in metres, 0 where nothing was rendered.
    pub fn depth(&self) -> DepthImage {
        let mut depth = Canvas::new(self.width, self.height, 0.0);
        self.depth_into(&mut depth);
        depth.into_image()
    }

    /// As [`VisibilityBuffer::depth`], into an image that is reused.
    pub fn depth_into(&self, depth: &mut Canvas<f32>) {
        let [x0, y0, x1, y1] = self.covered();
        let pixels = depth.begin(self.width, self.height, [x0, y0, x1, y1]);
        for y in y0..y1 {
            let row = y * self.width;
            let out = &mut pixels[row + x0..row + x1];
            for (z, &inverse) in out.iter_mut().zip(&self.inverse_depth[row + x0..row + x1]) {
                *z = if inverse > 0.0 { 1.0 / inverse } else { 0.0 };
            }
        }
    }

    /// The pixels that show object number `object`.
    pub fn mask(&self, object: usize) -> Mask {
        let mut mask = Image::filled(self.width, self.height, false);
        if object + 1 < self.starts.len() {
            let range = self.starts[object]..self.starts[object + 1];
            self.for_covered(|index| mask.as_mut_slice()[index] = range.contains(&self.triangle[index]));
        }
        mask
    }

    /// The index of the object at each pixel.
    pub fn instances(&self) -> Image<Option<u32>> {
        let mut instances = Image::filled(self.width, self.height, None);
        self.for_covered(|index| {
            instances.as_mut_slice()[index] = self.surface_at(index).map(|(object, _)| object as u32);
        });
        instances
    }

    /// The tight box around the rendered pixels, in BOP's form: `x, y` of the first pixel, width and height in pixels. `None`
    /// when nothing was rendered.
    pub fn bounding_box(&self) -> Option<Rect> {
        let (mut x0, mut y0, mut x1, mut y1) = (usize::MAX, usize::MAX, 0, 0);
        self.for_covered(|index| {
            if self.triangle[index] != NOTHING {
                let (x, y) = (index % self.width, index / self.width);
                (x0, y0, x1, y1) = (x0.min(x), y0.min(y), x1.max(x + 1), y1.max(y + 1));
            }
        });
        (x1 > x0).then(|| Rect {
            x: x0 as f64,
            y: y0 as f64,
            width: (x1 - x0) as f64,
            height: (y1 - y0) as f64,
        })
    }

    /// Calls `f` with the number of every pixel that may be covered, row by row.
    pub(crate) fn for_covered(&self, mut f: impl FnMut(usize)) {
        let [x0, y0, x1, y1] = self.covered();
        for y in y0..y1 {
            for x in x0..x1 {
                f(y * self.width + x);
            }
        }
    }
}

fn union(a: [usize; 4], b: [usize; 4]) -> [usize; 4] {
    [a[0].min(b[0]), a[1].min(b[1]), a[2].max(b[2]), a[3].max(b[3])]
}

fn to_grid(v: f64) -> i32 {
    // Adding 1.5 * 2^52 leaves the rounded number in the low bits; `v` is within the guard band.
    (v * SUBPIXEL + 6_755_399_441_055_744.0).to_bits() as i32
}

/// The input for rendering a band of rows.
struct Work<'a> {
    camera: &'a Camera,
    /// 1/fx, 1/fy.
    focal_inverse: [f64; 2],
    corners: &'a [Corner],
    faces: &'a [[u32; 3]],
    first: u32,
    extra: &'a [ClippedTriangle],
    culling: Culling,
}

impl Work<'_> {
    /// Draws into the rows from `y0` on; returns the covered rectangle.
    fn draw_rows(
        &self,
        y0: usize,
        width: usize,
        inverse_depth: &mut [f32],
        triangle: &mut [u32],
    ) -> [usize; 4] {
        let rows = inverse_depth.len() / width;
        let mut target = Band {
            y0: y0 as i32,
            y1: (y0 + rows) as i32,
            width,
            inverse_depth,
            triangle,
            covered: [usize::MAX, usize::MAX, 0, 0],
        };
        for (face, f) in self.faces.iter().enumerate() {
            let [a, b, c] = f.map(|i| &self.corners[i as usize]);
            if a.clip | b.clip | c.clip {
                continue;
            }
            let grid = [(a.x, a.y), (b.x, b.y), (c.x, c.y)];
            target.triangle(grid, self.first + face as u32, self.culling, || {
                let low = a.inverse.min(b.inverse).min(c.inverse);
                let high = a.inverse.max(b.inverse).max(c.inverse);
                Plane::through(self.camera, self.focal_inverse, [&a.point, &b.point, &c.point], low, high)
            });
        }
        for piece in self.extra {
            target.triangle(piece.corners, piece.number, self.culling, || piece.plane);
        }
        target.covered
    }
}

struct Band<'a> {
    y0: i32,
    y1: i32,
    width: usize,
    inverse_depth: &'a mut [f32],
    triangle: &'a mut [u32],
    covered: [usize; 4],
}

impl Band<'_> {
    #[inline]
    fn triangle(
        &mut self,
        mut p: [(i32, i32); 3],
        number: u32,
        culling: Culling,
        plane: impl FnOnce() -> Plane,
    ) {
        const ONE: i32 = (1 << SUBPIXEL_BITS) - 1;
        let min_y = p[0].1.min(p[1].1).min(p[2].1);
        let max_y = p[0].1.max(p[1].1).max(p[2].1);
        let first_y = ((min_y + ONE) >> SUBPIXEL_BITS).max(self.y0);
        let last_y = (max_y >> SUBPIXEL_BITS).min(self.y1 - 1);
        if first_y > last_y {
            return;
        }
        let min_x = p[0].0.min(p[1].0).min(p[2].0);
        let max_x = p[0].0.max(p[1].0).max(p[2].0);
        let first_x = ((min_x + ONE) >> SUBPIXEL_BITS).max(0);
        let last_x = (max_x >> SUBPIXEL_BITS).min(self.width as i32 - 1);
        if first_x > last_x {
            return;
        }
        let area = edge(p[0], p[1], p[2]);
        if area == 0 {
            return;
        }
        if area < 0 {
            // Counter-clockwise as seen, in an image whose y axis points down: the front side.
            p.swap(1, 2);
        } else if culling == Culling::Back {
            return;
        }
        // Edge functions at the first pixel, biased so that an edge's own points belong to the
        // triangle only if it is a top or a left edge; each must be >= 0 inside. Between pixels they change by multiples of
        // the grid, so their sign is that of their integer part, and only the integer part is stepped.
        let start = (first_x << SUBPIXEL_BITS, first_y << SUBPIXEL_BITS);
        let mut row = [0i64; 3];
        let mut step_x = [0i64; 3];
        let mut step_y = [0i64; 3];
        for i in 0..3 {
            let (a, b) = (p[(i + 1) % 3], p[(i + 2) % 3]);
            let (dx, dy) = (i64::from(b.0) - i64::from(a.0), i64::from(b.1) - i64::from(a.1));
            let top_left = (dy == 0 && dx > 0) || dy < 0;
            row[i] = (edge(a, b, start) - i64::from(!top_left)) >> SUBPIXEL_BITS;
            step_x[i] = -dy;
            step_y[i] = dx;
        }
        let plane = plane();
        let rows = Rows { first_x, first_y, last_x, last_y, number, plane };
        let small = max_x.abs_diff(min_x).max(max_y.abs_diff(min_y)) <= SMALL << SUBPIXEL_BITS;
        if small && first_x as usize + 4 * rows.fours() <= self.width {
            let narrow = |v: [i64; 3]| v.map(|v| v as i32);
            self.fill_small(&rows, narrow(row), narrow(step_x), narrow(step_y));
        } else {
            self.fill_large(&rows, row, step_x, step_y);
        }
        self.covered = union(
            self.covered,
            [first_x as usize, first_y as usize, last_x as usize + 1, last_y as usize + 1],
        );
    }

    /// Four pixels at a time without branches: in a triangle of a few pixels, branches would be unpredictable. The last four
    /// may extend beyond the box, where the edge functions report that nothing is inside.
    #[inline]
    fn fill_small(&mut self, rows: &Rows, mut row: [i32; 3], step_x: [i32; 3], step_y: [i32; 3]) {
        let (low, high, a) = (rows.plane.low, rows.plane.high, rows.plane.a as f32);
        let count = rows.fours() * 4;
        for y in rows.first_y..=rows.last_y {
            let (start, base) = rows.row(y, self.y0, self.width);
            let depths = self.inverse_depth[start..start + count].as_chunks_mut::<4>().0;
            let numbers = self.triangle[start..start + count].as_chunks_mut::<4>().0;
            let mut e: [[i32; 4]; 3] =
                std::array::from_fn(|k| std::array::from_fn(|l| row[k] + l as i32 * step_x[k]));
            let mut x = [0.0f32, 1.0, 2.0, 3.0];
            for (depths, numbers) in depths.iter_mut().zip(numbers) {
                let sign: [i32; 4] = std::array::from_fn(|l| e[0][l] | e[1][l] | e[2][l]);
                if sign[0] & sign[1] & sign[2] & sign[3] >= 0 {
                    // Whole arrays in and out, so that the compiler vectorises this.
                    let (old, old_number) = (*depths, *numbers);
                    let inverse: [f32; 4] = std::array::from_fn(|l| a * x[l] + base);
                    let inverse = inverse.map(|v| if v > low { v } else { low });
                    let inverse = inverse.map(|v| if v < high { v } else { high });
                    let seen: [u32; 4] = std::array::from_fn(|l| {
                        (((sign[l] >= 0) & (inverse[l] > old[l])) as u32).wrapping_neg()
                    });
                    *depths = std::array::from_fn(|l| {
                        f32::from_bits((inverse[l].to_bits() & seen[l]) | (old[l].to_bits() & !seen[l]))
                    });
                    *numbers = std::array::from_fn(|l| (rows.number & seen[l]) | (old_number[l] & !seen[l]));
                }
                for l in 0..4 {
                    x[l] += 4.0;
                    for k in 0..3 {
                        e[k][l] += 4 * step_x[k];
                    }
                }
            }
            for k in 0..3 {
                row[k] += step_y[k];
            }
        }
    }

    fn fill_large(&mut self, rows: &Rows, mut row: [i64; 3], step_x: [i64; 3], step_y: [i64; 3]) {
        let (low, high, a) = (rows.plane.low, rows.plane.high, rows.plane.a as f32);
        for y in rows.first_y..=rows.last_y {
            let (start, base) = rows.row(y, self.y0, self.width);
            let pixels = start..start + (rows.last_x - rows.first_x) as usize + 1;
            let mut e = row;
            let mut inside = false;
            let depths = &mut self.inverse_depth[pixels.clone()];
            let numbers = &mut self.triangle[pixels];
            for (x, (depth, pixel)) in depths.iter_mut().zip(numbers).enumerate() {
                if (e[0] | e[1] | e[2]) >= 0 {
                    inside = true;
                    let inverse = (a * x as f32 + base).max(low).min(high);
                    if inverse > *depth {
                        *depth = inverse;
                        *pixel = rows.number;
                    }
                } else if inside {
                    break;
                }
                for k in 0..3 {
                    e[k] += step_x[k];
                }
            }
            for k in 0..3 {
                row[k] += step_y[k];
            }
        }
    }
}

/// The box of a triangle in pixels, both ends inclusive, and the output.
struct Rows {
    first_x: i32,
    first_y: i32,
    last_x: i32,
    last_y: i32,
    number: u32,
    plane: Plane,
}

impl Rows {
    /// The index at which row `y` starts in a band that starts at `y0`, and 1/z there.
    #[inline]
    fn row(&self, y: i32, y0: i32, width: usize) -> (usize, f32) {
        let base = self.plane.a * f64::from(self.first_x) + self.plane.b * f64::from(y) + self.plane.c;
        ((y - y0) as usize * width + self.first_x as usize, base as f32)
    }

    /// Groups of four pixels in a row.
    #[inline]
    fn fours(&self) -> usize {
        ((self.last_x - self.first_x) as usize >> 2) + 1
    }
}

/// Twice the signed area of `a b p` on the grid.
#[inline]
fn edge(a: (i32, i32), b: (i32, i32), p: (i32, i32)) -> i64 {
    let (dx, dy) = (i64::from(b.0) - i64::from(a.0), i64::from(b.1) - i64::from(a.1));
    dx * (i64::from(p.1) - i64::from(a.1)) - dy * (i64::from(p.0) - i64::from(a.0))
}

/// Clips a triangle at the near plane and at the guard band (Sutherland and Hodgman 1974).
fn clip_triangle(camera: &Camera, near: f64, c: [&Corner; 3], number: u32, out: &mut Vec<ClippedTriangle>) {
    // Signed distances, inside >= 0; the guard planes are moved in a little so that rounding cannot leave the guard band.
    let limit = 0.999 * GUARD;
    type Distance<'a> = &'a dyn Fn(&[f64; 3]) -> f64;
    let planes: [Distance<'_>; 5] = [
        &|p| p[2] - near,
        &|p| camera.fx * p[0] + (camera.cx + limit) * p[2],
        &|p| (limit - camera.cx) * p[2] - camera.fx * p[0],
        &|p| camera.fy * p[1] + (camera.cy + limit) * p[2],
        &|p| (limit - camera.cy) * p[2] - camera.fy * p[1],
    ];
    let mut polygon: Vec<[f64; 3]> = c.iter().map(|c| c.point).collect();
    for distance in planes {
        let mut cut = Vec::with_capacity(polygon.len() + 1);
        for (i, p) in polygon.iter().enumerate() {
            let q = &polygon[(i + 1) % polygon.len()];
            let (dp, dq) = (distance(p), distance(q));
            if dp >= 0.0 {
                cut.push(*p);
            }
            if (dp >= 0.0) != (dq >= 0.0) {
                let s = dp / (dp - dq);
                cut.push(std::array::from_fn(|k| p[k] + s * (q[k] - p[k])));
            }
        }
        polygon = cut;
        if polygon.len() < 3 {
            return;
        }
    }
    let inverses = polygon.iter().map(|p| 1.0 / p[2].max(near));
    let low = inverses.clone().fold(f64::INFINITY, f64::min);
    let high = inverses.fold(0.0, f64::max);
    let focal_inverse = [1.0 / camera.fx, 1.0 / camera.fy];
    let plane = Plane::through(camera, focal_inverse, [&c[0].point, &c[1].point, &c[2].point], low, high);
    let grid: Vec<(i32, i32)> = polygon
        .iter()
        .map(|p| {
            let z = p[2].max(near);
            (to_grid(camera.fx * p[0] / z + camera.cx), to_grid(camera.fy * p[1] / z + camera.cy))
        })
        .collect();
    for i in 1..grid.len() - 1 {
        out.push(ClippedTriangle { number, plane, corners: [grid[0], grid[i], grid[i + 1]] });
    }
}

/// Depth in metres of one mesh at one pose, 0 where nothing was rendered: a shorthand for [`VisibilityBuffer`].
pub fn render_depth(mesh: &Mesh, camera_from_object: &Pose, camera: &Camera) -> DepthImage {
    let mut frame = VisibilityBuffer::new(camera);
    let object = SceneObject { mesh, camera_from_object: *camera_from_object };
    frame.render(&[object], &RenderOptions::default());
    frame.depth()
}

/// The three corners of a face in the camera frame.
pub(crate) fn face_in_camera(object: &SceneObject<'_>, face: usize) -> [Vec3; 3] {
    object.mesh.faces()[face]
        .map(|i| object.camera_from_object.transform_point(&object.mesh.vertices()[i as usize]))
}

#[cfg(test)]
#[path = "raster_tests.rs"]
mod tests;
