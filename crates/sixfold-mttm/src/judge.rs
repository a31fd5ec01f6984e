//! Verification without a mesh: the scores of the dissertation's section 5.2.5, computed with the template that was matched in
//! place of a rendering (what its section 5.4 leaves for the future).

use sixfold_align::verification::{Agreement, pierced};
use sixfold_align::{PreparedDepth, VerificationOptions, VerificationScore};
use sixfold_geometry::{PointCloud, Pose};

use crate::template::{SIDE, Template};

/// A template's point whose normal has a z (view frame) above this is seen at a grazing angle, less than 9 degrees, and may move
/// out of its pixel: as in verification by rendering. Chosen by hand; not swept.
const GRAZING: f64 = -0.15;
/// Lower bound of the cosine between ray and normal with which a difference in depth is converted to one along the normal, as in
/// the screening of point pair features: on grazing surfaces the depth may differ by more. Chosen by hand; not swept.
const MIN_SLOPE: f64 = 0.3;

/// The surface that a template shows, for alignment and verification.
#[derive(Debug, Clone)]
pub struct Surface {
    /// Some of the points with normals, for ICP.
    pub sparse: PointCloud,
    /// All points with normals.
    pub dense: PointCloud,
    /// Which of them are on the outline.
    pub outline: Vec<bool>,
    /// Their pixels in the template, row by row.
    pub pixels: Vec<u16>,
}

impl Surface {
    /// Prepares a template of a patch of `size` metres; `sparse` points for ICP.
    pub fn new(template: &Template, size: f64, sparse: usize) -> Surface {
        let (dense, pixels) = template.cloud(size);
        let empty = |x: usize, y: usize| template.depth[y * SIDE + x] == 0;
        let outline = pixels
            .iter()
            .map(|&[x, y]| {
                x == 0
                    || y == 0
                    || x + 1 == SIDE
                    || y + 1 == SIDE
                    || empty(x - 1, y)
                    || empty(x + 1, y)
                    || empty(x, y - 1)
                    || empty(x, y + 1)
            })
            .collect();
        let stride = ((dense.len() as f64 / sparse.max(1) as f64).sqrt().round() as usize).max(1);
        let mut few = PointCloud::default();
        for (i, &[x, y]) in pixels.iter().enumerate() {
            if x % stride == 0 && y % stride == 0 && dense.normals[i].z < GRAZING {
                few.points.push(dense.points[i]);
                few.normals.push(dense.normals[i]);
            }
        }
        let pixels = pixels.iter().map(|&[x, y]| (y * SIDE + x) as u16).collect();
        Surface { sparse: few, dense, outline, pixels }
    }
}

/// Scores a template at a pose. `threshold` is the depth inlier threshold in metres.
pub fn judge(
    scene: &PreparedDepth,
    surface: &Surface,
    camera_from_view: &Pose,
    threshold: f64,
    options: &VerificationOptions,
) -> VerificationScore {
    let camera = scene.camera();
    let (width, height) = (camera.width as f64, camera.height as f64);
    let cosine = options.normal_angle.cos();
    let mut score = VerificationScore::default();
    let mut agreement = [Agreement::Nothing; SIDE * SIDE];
    let (mut with_normal, mut good_normals, mut contour, mut on_edge) = (0usize, 0usize, 0usize, 0usize);
    for (i, p) in surface.dense.points.iter().enumerate() {
        let p = camera_from_view.transform_point(p);
        score.rendered += 1;
        let Some(pixel) = camera.project(&p) else { continue };
        let (x, y) = (pixel.x.round(), pixel.y.round());
        if !(x >= 0.0 && y >= 0.0 && x < width && y < height) {
            continue;
        }
        let at = (x as usize, y as usize);
        let measured = f64::from(scene.depth()[at]);
        let n = camera_from_view.transform_direction(&surface.dense.normals[i]);
        let slope = (-n.dot(&p) / p.norm()).clamp(MIN_SLOPE, 1.0);
        let off = (measured - p.z) * slope;
        let hidden = measured > 0.0 && off < -threshold;
        if hidden {
            score.occluded += 1;
            agreement[usize::from(surface.pixels[i])] = Agreement::Occluded;
        } else if measured > 0.0 && off > threshold {
            score.outliers += 1;
        } else if measured > 0.0 {
            score.inliers += 1;
            let on_edge = scene.edge_distance()[at] <= options.boundary_distance;
            agreement[usize::from(surface.pixels[i])] = Agreement::Inlier { on_edge };
            let m = scene.normals()[at];
            if m != [0.0; 3] {
                with_normal += 1;
                let agreement = n.x * f64::from(m[0]) + n.y * f64::from(m[1]) + n.z * f64::from(m[2]);
                good_normals += usize::from(agreement > cosine);
            }
        }
        if surface.outline[i] && !hidden {
            contour += 1;
            on_edge += usize::from(scene.edge_distance()[at] <= options.boundary_distance);
        }
    }
    let fraction = |a: usize, b: usize| if b == 0 { 0.0 } else { a as f64 / b as f64 };
    if options.occluders_have_edges && score.occluded > 0 {
        score.pierced = pierced(&mut agreement, SIDE);
    }
    score.depth = (1.0 - fraction(score.outliers, score.rendered))
        * fraction(score.inliers, score.rendered + score.pierced - score.occluded);
    score.boundary = fraction(on_edge, contour);
    score.normals = fraction(good_normals, with_normal);
    score.total = score.depth * score.boundary * score.normals;
    score
}
