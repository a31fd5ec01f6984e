//! Verification of a pose by rendering: compares the depth image with the rendered depth.
//!
//! The scores of the dissertation, section 5.2.5: depth fitness `S_D = P_O N_i / (N_m - N_occ)` with `P_O = 1 - N_out / N_m`, the
//! fraction `S_N` of matched normals, the fraction `S_B` of the silhouette that is on an edge of the scene, and their product.
//! `N_m` are the rendered pixels; a pixel is an inlier within the threshold, occluded when the scene is nearer, an outlier when the
//! scene is further away (one would see through the object). Pixels without measured depth count in `N_m` only, as published.
//! Beyond the dissertation: an occluder must have an outline. Hidden pixels behind a surface that continues smoothly from the
//! visible part of the object ([`pierced`](VerificationScore::pierced)) do not count as occluded and stay in `N_m - N_occ`.

use std::f64::consts::FRAC_PI_2;

use sixfold_geometry::{Camera, OptionError, Pose, Rect, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};

use crate::prepared::PreparedDepth;

/// Thresholds of the verification.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VerificationOptions {
    /// Depth inlier threshold in metres (dissertation: 10 mm, 5 mm for small objects); `None`: 5 % of the diameter, between 5 and
    /// 10 mm.
    pub depth_threshold: Option<f64>,
    /// Largest angle between the rendered and the measured normal of an inlier whose normals agree, radians.
    pub normal_angle: f64,
    /// Largest distance from a silhouette pixel to a scene edge at which the pixel counts as being on the edge, pixels.
    pub boundary_distance: u8,
    /// Count hidden pixels as occluded only if the scene has an edge between them and the visible part; `false` as published.
    pub occluders_have_edges: bool,
}

/// Depth inlier threshold as a fraction of the diameter, if none is given; chosen by hand, not swept.
const DEPTH_THRESHOLD: f64 = 0.05;
/// Its bounds, metres: the values of the dissertation, section 5.2.5, for small objects and for all others.
const DEPTH_THRESHOLDS: (f64, f64) = (0.005, 0.010);
/// Largest angle between the rendered and the measured normal of an inlier whose normals agree, degrees; chosen by hand, not swept.
const NORMAL_ANGLE: f64 = 30.0;
/// Largest distance from a silhouette pixel to a scene edge at which the pixel counts as being on the edge, pixels; chosen by hand,
/// not swept.
const BOUNDARY_DISTANCE: u8 = 3;
/// Visibility at which [`VerificationScore::ranking`] is half the total; chosen by hand, not swept.
const HALF_RANKING: f64 = 0.1;
/// A rendered point whose normal has a z (camera frame, towards the camera negative) above this is seen at a grazing angle, less
/// than 9 degrees, and may move out of its pixel. Chosen by hand; not swept.
const GRAZING: f32 = -0.15;
/// Pixels by which the rendered crop exceeds the projected bounding box to the upper left and to the lower right: silhouettes need
/// an empty pixel next to them.
const CROP_MARGINS: (f64, f64) = (1.0, 2.0);

impl Default for VerificationOptions {
    fn default() -> Self {
        VerificationOptions {
            depth_threshold: None,
            normal_angle: NORMAL_ANGLE.to_radians(),
            boundary_distance: BOUNDARY_DISTANCE,
            occluders_have_edges: true,
        }
    }
}

impl VerificationOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        if let Some(metres) = self.depth_threshold {
            OptionError::unless_positive("verification.depth_threshold", metres, "metres above 0")?;
        }
        let expected = "radians from 0 to a quarter of a turn";
        OptionError::unless_within("verification.normal_angle", self.normal_angle, 0.0..=FRAC_PI_2, expected)
    }

    /// The depth inlier threshold for an object of this diameter, metres.
    pub fn threshold_for(&self, diameter: f64) -> f64 {
        let (low, high) = DEPTH_THRESHOLDS;
        self.depth_threshold.unwrap_or((DEPTH_THRESHOLD * diameter).clamp(low, high))
    }
}

/// The counts and scores of one pose.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize)]
pub struct VerificationScore {
    /// Rendered pixels, `N_m`.
    pub rendered: usize,
    /// Pixels whose depth agrees, `N_i`.
    pub inliers: usize,
    /// Pixels where the scene is nearer, `N_occ`.
    pub occluded: usize,
    /// Those of them without an occluder's edge: the pose penetrates a surface.
    pub pierced: usize,
    /// Pixels where the scene is further away, `N_out`.
    pub outliers: usize,
    /// Depth fitness `S_D`.
    pub depth: f64,
    /// Fraction of the visible silhouette that is on a scene edge, `S_B`.
    pub boundary: f64,
    /// Fraction of the inliers whose normals agree, `S_N`.
    pub normals: f64,
    /// `S_D S_B S_N`.
    pub total: f64,
}

impl VerificationScore {
    /// Inliers as a fraction of the rendered pixels: the visible fraction of the object.
    pub fn visible_fraction(&self) -> f64 {
        if self.rendered == 0 { 0.0 } else { self.inliers as f64 / self.rendered as f64 }
    }

    /// The total, reduced if little of the object is visible: `total * v / (v + 0.1)` with `v` the
    /// [`visible_fraction`](Self::visible_fraction). The dissertation removes every penalty for occlusion, so a hidden pose may
    /// score like a fully visible one; of two hypotheses for one object the visible one is more likely to be right.
    pub fn ranking(&self) -> f64 {
        let v = self.visible_fraction();
        self.total * v / (v + HALF_RANKING)
    }
}

/// Renders poses into crops of a scene and compares them; reuses its buffers.
#[derive(Debug)]
pub struct Verifier {
    frame: VisibilityBuffer,
    agreement: Vec<Agreement>,
}

/// Comparison with the scene at a pixel of a rendering or template.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Agreement {
    /// Nothing was rendered, nothing was measured, or the scene is further away.
    Nothing,
    /// The depth agrees.
    Inlier {
        /// Whether the pixel is near an edge of the scene.
        on_edge: bool,
    },
    /// The scene is nearer.
    Occluded,
}

impl Default for Verifier {
    fn default() -> Self {
        let one = Camera { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, width: 1, height: 1, distortion: None };
        Verifier { frame: VisibilityBuffer::new(&one), agreement: vec![] }
    }
}

/// The point visible at a pixel of a rendered pose.
#[derive(Debug, Clone, Copy)]
pub struct RenderedPoint {
    /// In the object's frame, metres.
    pub point: Vec3,
    /// Unit normal in the object's frame.
    pub normal: Vec3,
    /// Whether the scene's depth agrees here.
    pub inlier: bool,
}

impl Verifier {
    /// Renders the mesh into the part of the image that it covers; returns the corner of that part, or `None` if the mesh is
    /// outside the image.
    fn render(&mut self, image: &PreparedDepth, mesh: &Mesh, pose: &Pose) -> Option<(usize, usize)> {
        let camera = image.camera();
        let (mut x0, mut y0, mut x1, mut y1) =
            (f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY);
        for corner in mesh.box_corners() {
            // An object that extends behind the camera is rendered into the whole image.
            let Some(p) = camera.project(&pose.transform_point(&corner)) else {
                (x0, y0, x1, y1) = (0.0, 0.0, camera.width as f64, camera.height as f64);
                break;
            };
            (x0, y0, x1, y1) = (x0.min(p.x), y0.min(p.y), x1.max(p.x), y1.max(p.y));
        }
        let x0 = (x0.floor() - CROP_MARGINS.0).clamp(0.0, camera.width as f64);
        let y0 = (y0.floor() - CROP_MARGINS.0).clamp(0.0, camera.height as f64);
        let x1 = (x1.ceil() + CROP_MARGINS.1).clamp(0.0, camera.width as f64);
        let y1 = (y1.ceil() + CROP_MARGINS.1).clamp(0.0, camera.height as f64);
        if x1 <= x0 || y1 <= y0 {
            return None;
        }
        let crop = camera.crop(&Rect { x: x0, y: y0, width: x1 - x0, height: y1 - y0 });
        self.frame.set_camera(&crop);
        self.frame.render(&[SceneObject { mesh, camera_from_object: *pose }], &RenderOptions::default());
        Some((x0 as usize, y0 as usize))
    }

    /// Scores a pose. `threshold` is the depth inlier threshold in metres.
    pub fn score(
        &mut self,
        image: &PreparedDepth,
        mesh: &Mesh,
        camera_from_object: &Pose,
        threshold: f64,
        options: &VerificationOptions,
    ) -> VerificationScore {
        let mut score = VerificationScore::default();
        let Some((x0, y0)) = self.render(image, mesh, camera_from_object) else { return score };
        let objects = [SceneObject { mesh, camera_from_object: *camera_from_object }];
        let normals = self.frame.normals(&objects);
        let cosine = options.normal_angle.cos() as f32;
        let (width, height) = (self.frame.width(), self.frame.height());
        let inverse = self.frame.inverse_depth();
        let (mut with_normal, mut good_normals, mut contour, mut on_edge) = (0usize, 0usize, 0usize, 0usize);
        let [cx0, cy0, cx1, cy1] = self.frame.covered();
        self.agreement.clear();
        self.agreement.resize(width * height, Agreement::Nothing);
        for y in cy0..cy1 {
            for x in cx0..cx1 {
                let index = y * width + x;
                if inverse[index] <= 0.0 {
                    continue;
                }
                score.rendered += 1;
                let (sx, sy) = (x + x0, y + y0);
                let measured = image.depth()[(sx, sy)];
                let difference = f64::from(measured) - 1.0 / f64::from(inverse[index]);
                let occluded = measured > 0.0 && difference < -threshold;
                if occluded {
                    score.occluded += 1;
                    self.agreement[index] = Agreement::Occluded;
                } else if measured > 0.0 && difference > threshold {
                    score.outliers += 1;
                } else if measured > 0.0 {
                    score.inliers += 1;
                    let on_edge = image.edge_distance()[(sx, sy)] <= options.boundary_distance;
                    self.agreement[index] = Agreement::Inlier { on_edge };
                    let (a, b) = (normals[(x, y)], image.normals()[(sx, sy)]);
                    if b != [0.0; 3] {
                        with_normal += 1;
                        good_normals += usize::from(a[0] * b[0] + a[1] * b[1] + a[2] * b[2] > cosine);
                    }
                }
                let empty = |x: isize, y: isize| {
                    x >= 0
                        && y >= 0
                        && (x as usize) < width
                        && (y as usize) < height
                        && inverse[y as usize * width + x as usize] <= 0.0
                };
                let (ix, iy) = (x as isize, y as isize);
                if !occluded
                    && (empty(ix - 1, iy) || empty(ix + 1, iy) || empty(ix, iy - 1) || empty(ix, iy + 1))
                {
                    contour += 1;
                    on_edge += usize::from(image.edge_distance()[(sx, sy)] <= options.boundary_distance);
                }
            }
        }
        let fraction = |a: usize, b: usize| if b == 0 { 0.0 } else { a as f64 / b as f64 };
        if options.occluders_have_edges {
            score.pierced = pierced(&mut self.agreement, width);
        }
        let outlier_penalty = 1.0 - fraction(score.outliers, score.rendered);
        score.depth =
            outlier_penalty * fraction(score.inliers, score.rendered + score.pierced - score.occluded);
        score.boundary = fraction(on_edge, contour);
        score.normals = fraction(good_normals, with_normal);
        score.total = score.depth * score.boundary * score.normals;
        score
    }

    /// About `count` of the points visible at a pose, evenly spread over the image.
    pub(crate) fn visible_points(
        &mut self,
        image: &PreparedDepth,
        mesh: &Mesh,
        camera_from_object: &Pose,
        threshold: f64,
        count: usize,
    ) -> Vec<RenderedPoint> {
        let Some((x0, y0)) = self.render(image, mesh, camera_from_object) else { return vec![] };
        let objects = [SceneObject { mesh, camera_from_object: *camera_from_object }];
        let inverse = self.frame.inverse_depth();
        let total = inverse.iter().filter(|&&d| d > 0.0).count();
        let stride = ((total as f64 / count.max(1) as f64).sqrt().round() as usize).max(1);
        let normals = self.frame.normals(&objects);
        let coordinates = self.frame.object_coordinates(&objects);
        let object_from_camera = camera_from_object.inverse();
        let mut points = Vec::with_capacity(count * 2);
        for y in (0..self.frame.height()).step_by(stride) {
            for x in (0..self.frame.width()).step_by(stride) {
                let index = y * self.frame.width() + x;
                if inverse[index] <= 0.0 {
                    continue;
                }
                let normal = normals[(x, y)];
                // A surface seen at a grazing angle may move out of its pixel.
                if normal[2] > GRAZING {
                    continue;
                }
                let measured = f64::from(image.depth()[(x + x0, y + y0)]);
                let z = 1.0 / f64::from(inverse[index]);
                points.push(RenderedPoint {
                    point: Vec3::from(coordinates[(x, y)].map(f64::from)),
                    normal: object_from_camera.transform_direction(&Vec3::from(normal.map(f64::from))),
                    inlier: measured > 0.0 && (measured - z).abs() < threshold,
                });
            }
        }
        points
    }

    /// The pixels (numbers in the scene image) where the pose's rendering agrees with the scene.
    pub fn explained_pixels(
        &mut self,
        image: &PreparedDepth,
        mesh: &Mesh,
        camera_from_object: &Pose,
        threshold: f64,
    ) -> Vec<u32> {
        let Some((x0, y0)) = self.render(image, mesh, camera_from_object) else { return vec![] };
        let inverse = self.frame.inverse_depth();
        let width = self.frame.width();
        let mut pixels = vec![];
        for (index, &inverse) in inverse.iter().enumerate() {
            if inverse > 0.0 {
                let (sx, sy) = (index % width + x0, index / width + y0);
                let measured = f64::from(image.depth()[(sx, sy)]);
                if measured > 0.0 && (measured - 1.0 / f64::from(inverse)).abs() < threshold {
                    pixels.push((sy * image.camera().width + sx) as u32);
                }
            }
        }
        pixels
    }
}

/// Number of hidden pixels that are not explained by an occluder: of each connected part of them, the fraction of its border with
/// inliers that is not on an edge of the scene. `agreement` has rows of `width` pixels; its hidden pixels are removed.
pub fn pierced(agreement: &mut [Agreement], width: usize) -> usize {
    let mut total = 0;
    let mut open = vec![];
    for start in 0..agreement.len() {
        if agreement[start] != Agreement::Occluded {
            continue;
        }
        let (mut pixels, mut border, mut without_edge) = (0usize, 0usize, 0usize);
        open.push(start);
        agreement[start] = Agreement::Nothing;
        while let Some(index) = open.pop() {
            pixels += 1;
            let (x, y) = (index % width, index / width);
            let mut touch = |x: usize, y: usize| {
                let Some(at) = agreement.get_mut(y * width + x).filter(|_| x < width) else { return };
                match at {
                    Agreement::Nothing => {}
                    Agreement::Inlier { on_edge } => {
                        border += 1;
                        without_edge += usize::from(!*on_edge);
                    }
                    Agreement::Occluded => {
                        *at = Agreement::Nothing;
                        open.push(y * width + x);
                    }
                }
            };
            if x > 0 {
                touch(x - 1, y);
            }
            if y > 0 {
                touch(x, y - 1);
            }
            touch(x + 1, y);
            touch(x, y + 1);
        }
        // A part without a border with inliers gives no information about its occluder.
        total += (pixels * without_edge).checked_div(border).unwrap_or(0);
    }
    total
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_out_of_range_are_named() {
        let options = VerificationOptions::default();
        assert_eq!(options.check(), Ok(()));
        let angle = VerificationOptions { normal_angle: f64::NAN, ..options };
        assert_eq!(angle.check().unwrap_err().option, "verification.normal_angle");
        let threshold = VerificationOptions { depth_threshold: Some(0.0), ..options };
        assert_eq!(threshold.check().unwrap_err().option, "verification.depth_threshold");
    }
}
