//! Visible Surface Discrepancy (Hodan, Michel et al. 2018, equation 1), as the BOP Challenge 2019 and later use it
//! (step cost, visibility "bop19": missing test depth counts as visible, distances normalised by the diameter), and as
//! the benchmark of 2018 and the dissertation do (section 3.4.4).

use sixfold_geometry::{Camera, DepthImage};
use thiserror::Error;

/// Options of VSD. The default is BOP's.
#[derive(Debug, Clone, PartialEq)]
pub struct VsdOptions {
    /// Tolerance of the visibility test in metres: 15 mm in all BOP datasets but ITODD (5 mm).
    pub delta: f64,
    /// Misalignment tolerances.
    pub taus: Taus,
    /// Whether a model counts as visible where the test image has no depth: yes since 2019 ("bop19"), no in 2018 ("bop18").
    pub missing_is_visible: bool,
}

/// Misalignment tolerances of VSD, at least one.
#[derive(Debug, Clone, PartialEq)]
pub enum Taus {
    /// As fractions of the object's diameter.
    Diameters(Vec<f64>),
    /// In metres, the same for all objects.
    Metres(Vec<f64>),
}

impl Taus {
    /// The tolerances, in the unit of the variant.
    pub fn values(&self) -> &[f64] {
        let (Taus::Diameters(values) | Taus::Metres(values)) = self;
        values
    }
}

/// Misalignment tolerance of the benchmark of 2018 (Hodan, Michel et al. 2018, section 4.2) and of table 3.6 of the dissertation,
/// metres.
pub const PUBLISHED_TAU: f64 = 0.020;

impl Default for VsdOptions {
    fn default() -> Self {
        VsdOptions {
            delta: crate::visibility::VISIBILITY_DELTA,
            taus: Taus::Diameters(crate::score::fractions_05_to_50()),
            missing_is_visible: true,
        }
    }
}

impl VsdOptions {
    /// The options of the benchmark of 2018 and of the dissertation: a tolerance of 20 mm, nothing visible where depth is missing.
    pub fn published() -> Self {
        VsdOptions {
            taus: Taus::Metres(vec![PUBLISHED_TAU]),
            missing_is_visible: false,
            ..VsdOptions::default()
        }
    }
}

/// Why VSD cannot be computed.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum VsdError {
    /// The images do not have the camera's size.
    #[error("{image} depth is {width}x{height}, the camera's images are {camera_width}x{camera_height}")]
    Size {
        /// Which image: `estimate`, `ground-truth` or `test`.
        image: &'static str,
        /// Its width.
        width: usize,
        /// Its height.
        height: usize,
        /// Width the camera is for.
        camera_width: usize,
        /// Height the camera is for.
        camera_height: usize,
    },
    /// The diameter is not a positive number.
    #[error("the diameter is {found} m, expected a number above zero")]
    Diameter {
        /// The given value.
        found: f64,
    },
}

fn is_depth(z: f32) -> bool {
    z.is_finite() && z > 0.0
}

/// The discrepancy in `0..=1` for every tau.
///
/// `estimate` and `ground_truth` are depth images of the model rendered at the two poses (zero where the model is
/// not), `test` is the sensor's depth image (zero where nothing was measured). All three in metres, of the camera's size. Distances
/// are along the ray, not along the optical axis. Where nothing of either model is visible the discrepancy is one.
///
/// # Errors
/// [`VsdError`] when an image has another size or the diameter is not positive.
pub fn vsd(
    estimate: &DepthImage,
    ground_truth: &DepthImage,
    test: &DepthImage,
    camera: &Camera,
    diameter: f64,
    options: &VsdOptions,
) -> Result<Vec<f64>, VsdError> {
    for (image, depth) in [("estimate", estimate), ("ground-truth", ground_truth), ("test", test)] {
        if depth.size() != (camera.width, camera.height) {
            return Err(VsdError::Size {
                image,
                width: depth.width(),
                height: depth.height(),
                camera_width: camera.width,
                camera_height: camera.height,
            });
        }
    }
    if !(diameter.is_finite() && diameter > 0.0) {
        return Err(VsdError::Diameter { found: diameter });
    }
    let columns: Vec<f64> = (0..camera.width).map(|x| ((x as f64 - camera.cx) / camera.fx).powi(2)).collect();
    let mut union = 0u64;
    let mut common = 0u64;
    // Pixels visible in both whose distance is below tau, by tau.
    let taus = options.taus.values();
    let unit = match options.taus {
        Taus::Diameters(_) => diameter,
        Taus::Metres(_) => 1.0,
    };
    let mut close = vec![0u64; taus.len()];
    for y in 0..camera.height {
        let row = ((y as f64 - camera.cy) / camera.fy).powi(2) + 1.0;
        let pixels = estimate.row(y).iter().zip(ground_truth.row(y)).zip(test.row(y)).zip(&columns);
        for (((&e, &g), &t), &column) in pixels {
            let (has_e, has_g) = (is_depth(e), is_depth(g));
            if !has_e && !has_g {
                continue;
            }
            let ray = (column + row).sqrt();
            let (e, g) = (f64::from(e) * ray, f64::from(g) * ray);
            let visible = |d: f64| match is_depth(t) {
                true => d - f64::from(t) * ray <= options.delta,
                false => options.missing_is_visible,
            };
            let visible_g = has_g && visible(g);
            // A pixel of the estimate on the visible ground truth is visible even behind it: otherwise an
            // estimate could hide (Hodan et al. 2016, equation 14).
            let visible_e = has_e && (visible(e) || visible_g);
            union += u64::from(visible_g || visible_e);
            if visible_g && visible_e {
                common += 1;
                let distance = (g - e).abs() / unit;
                for (count, &tau) in close.iter_mut().zip(taus) {
                    *count += u64::from(distance < tau);
                }
            }
        }
    }
    if union == 0 {
        return Ok(vec![1.0; taus.len()]);
    }
    // Costs of the common pixels plus all pixels visible in one only.
    Ok(close.iter().map(|&n| ((common - n) + (union - common)) as f64 / union as f64).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::Image;

    /// Ten pixels in a row, so far away that every ray is parallel to the axis.
    fn camera() -> Camera {
        Camera::new(1e9, 1e9, 0.0, 0.0, 10, 1).unwrap()
    }

    fn depth(values: [f32; 10]) -> DepthImage {
        Image::from_vec(10, 1, values.to_vec()).unwrap()
    }

    fn compute(e: [f32; 10], g: [f32; 10], t: [f32; 10]) -> Vec<f64> {
        let options = VsdOptions { taus: Taus::Diameters(vec![0.05, 0.5]), ..VsdOptions::default() };
        vsd(&depth(e), &depth(g), &depth(t), &camera(), 0.1, &options).unwrap()
    }

    const OUT: f32 = 0.0;

    #[test]
    fn the_same_depth_costs_nothing() {
        let model = [OUT, 1.0, 1.0, 1.0, 1.0, OUT, OUT, OUT, OUT, OUT];
        assert_eq!(compute(model, model, model), vec![0.0, 0.0]);
    }

    #[test]
    fn half_overlapping_silhouettes_by_hand() {
        // Ground truth on pixels 1-4, estimate on 3-6, both 1 m: 2 common, 6 in the union, all common close.
        let g = [OUT, 1.0, 1.0, 1.0, 1.0, OUT, OUT, OUT, OUT, OUT];
        let e = [OUT, OUT, OUT, 1.0, 1.0, 1.0, 1.0, OUT, OUT, OUT];
        let t = [2.0, 1.0, 1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0, 2.0];
        let expected = 4.0 / 6.0;
        assert_eq!(compute(e, g, t), vec![expected, expected]);
    }

    #[test]
    fn a_depth_error_counts_by_tau() {
        // 20 mm off with a diameter of 0.1 m is 0.2: above tau .05, below tau .5.
        let g = [OUT, 1.0, 1.0, 1.0, 1.0, OUT, OUT, OUT, OUT, OUT];
        let e = g.map(|z| if z > 0.0 { 1.02 } else { 0.0 });
        assert_eq!(compute(e, g, g), vec![1.0, 0.0]);
    }

    #[test]
    fn an_occluder_hides_both_models() {
        // Pixels 1 and 2 are hidden by something at 0.5 m; the rest of the estimate misses pixel 4.
        let g = [OUT, 1.0, 1.0, 1.0, 1.0, OUT, OUT, OUT, OUT, OUT];
        let e = [OUT, 1.0, 1.0, 1.0, OUT, OUT, OUT, OUT, OUT, OUT];
        let t = [2.0, 0.5, 0.5, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0, 2.0];
        assert_eq!(compute(e, g, t), vec![0.5, 0.5]);
        // With missing depth in place of the occluder the hidden pixels count as visible: 1 of 4 is missed.
        let t = [2.0, OUT, f32::NAN, 1.0, 1.0, 2.0, 2.0, 2.0, 2.0, 2.0];
        assert_eq!(compute(e, g, t), vec![0.25, 0.25]);
    }

    #[test]
    fn the_visibility_tolerance_is_15_mm() {
        let g = [1.0, OUT, OUT, OUT, OUT, OUT, OUT, OUT, OUT, OUT];
        let e = [OUT, 1.0, OUT, OUT, OUT, OUT, OUT, OUT, OUT, OUT];
        // 14 mm behind the measured surface is visible: two pixels in the union, none in common.
        let t = [0.986, 0.986, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0];
        assert_eq!(compute(e, g, t), vec![1.0, 1.0]);
        // 16 mm behind is hidden; nothing is visible and the discrepancy is one by definition. The estimate over
        // the visible ground truth, though, stays visible however deep it lies.
        let t = [0.984, 0.984, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0];
        assert_eq!(compute(e, g, t), vec![1.0, 1.0]);
        let deep = [1.04, OUT, OUT, OUT, OUT, OUT, OUT, OUT, OUT, OUT];
        let t = [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0];
        assert_eq!(compute(deep, g, t), vec![1.0, 0.0]);
        // And 16 mm in front of a pixel that only the estimate covers: hidden, so it does not count at all.
        let far = [1.0, 1.016, OUT, OUT, OUT, OUT, OUT, OUT, OUT, OUT];
        assert_eq!(compute(far, g, t), vec![0.0, 0.0]);
    }

    #[test]
    fn as_published_by_hand() {
        // The tolerance is 20 mm whatever the diameter: 19 mm are close, 21 mm are not.
        let published = |e: [f32; 10], g: [f32; 10], t: [f32; 10], diameter: f64| {
            vsd(&depth(e), &depth(g), &depth(t), &camera(), diameter, &VsdOptions::published()).unwrap()
        };
        let g = [OUT, 1.0, 1.0, 1.0, 1.0, OUT, OUT, OUT, OUT, OUT];
        let e = [OUT, 1.019, 1.019, 1.019, 1.021, OUT, OUT, OUT, OUT, OUT];
        for diameter in [0.05, 0.5] {
            assert_eq!(published(e, g, g, diameter), vec![0.25]);
        }
        // One of the four pixels of the ground truth has no depth, so three count. The estimate misses one of them, and has one
        // more where depth is missing, which counts for nothing: 1 of 3. Since 2019 both count: 2 of 5.
        let t = [OUT, OUT, 1.0, 1.0, 1.0, OUT, 2.0, 2.0, 2.0, 2.0];
        let e = [OUT, 1.0, 1.0, 1.0, OUT, 1.0, OUT, OUT, OUT, OUT];
        assert_eq!(published(e, g, t, 0.1), vec![1.0 / 3.0]);
        assert_eq!(compute(e, g, t), vec![0.4, 0.4]);
    }

    #[test]
    fn distances_are_along_the_ray() {
        // At 45 degrees a depth error of 60 mm is 85 mm along the ray: above 0.7 diameters of 0.1 m.
        let camera = Camera::new(1.0, 1.0, 0.0, 0.0, 2, 1).unwrap();
        let image = |z: f32| Image::from_vec(2, 1, vec![0.0, z]).unwrap();
        let options =
            VsdOptions { delta: 0.1, taus: Taus::Diameters(vec![0.7, 0.9]), ..VsdOptions::default() };
        let found = vsd(&image(1.06), &image(1.0), &image(1.0), &camera, 0.1, &options).unwrap();
        assert_eq!(found, vec![1.0, 0.0]);
    }

    #[test]
    fn images_of_another_size_are_refused() {
        let d = depth([1.0; 10]);
        let small = Image::filled(5, 1, 1.0f32);
        let error = vsd(&d, &d, &small, &camera(), 0.1, &VsdOptions::default()).unwrap_err();
        assert!(error.to_string().contains("test depth is 5x1"), "{error}");
        assert!(vsd(&d, &d, &d, &camera(), 0.0, &VsdOptions::default()).is_err());
    }
}
