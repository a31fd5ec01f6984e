//! An object prepared for comparison with itself: samples of its surface, its distance field and its tree of triangles.

use nalgebra::{Matrix3, SymmetricEigen};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use sixfold_geometry::Vec3;

use super::axis::{Axis, refine};
use super::color::SurfaceColors;
use super::field::DistanceField;
use super::{ColorDifference, Deviation, SymmetryOptions, percentile};
use crate::Mesh;
use crate::surface::Surface;

/// Samples from which the distance field is computed, and whose colours are compared.
const FIELD_SAMPLES: usize = 8000;
/// Distance beyond which a point is weighted less when axes are refined, as a fraction of the diameter.
const ROBUST_SCALE: f64 = 0.02;

/// An object and what is computed from it once.
#[derive(Debug)]
pub(super) struct Body {
    /// Metres.
    pub diameter: f64,
    pub noise: f64,
    /// Centroid of the surface.
    pub centre: Vec3,
    /// Principal axes of the surface's inertia.
    pub principal_axes: [Vec3; 3],
    /// Points of uniform density on the surface, ordered so that the first few are already spread over all of it.
    pub points: Vec<Vec3>,
    pub field: DistanceField,
    surface: Surface,
    colors: Option<SurfaceColors>,
}

impl Body {
    pub fn new(mesh: &Mesh, options: &SymmetryOptions) -> Body {
        let count = FIELD_SAMPLES.max(options.samples);
        let mut samples = mesh.sample_surface(count, options.seed);
        let has_surface = !samples.points.is_empty();
        if !has_surface {
            samples.points = mesh.vertices().to_vec();
            samples.points.shuffle(&mut ChaCha8Rng::seed_from_u64(options.seed));
            samples.points.truncate(count);
        }
        let centre = samples.points.iter().sum::<Vec3>() / samples.points.len() as f64;
        let radius = mesh.vertices().iter().map(|v| (v - centre).norm()).fold(0.0, f64::max);
        let diameter = mesh.diameter();
        let colors = if has_surface { SurfaceColors::new(mesh, &samples, diameter) } else { None };
        let field = DistanceField::new(&samples.points, &centre, radius);
        let spread =
            samples.points.iter().map(|p| (p - centre) * (p - centre).transpose()).sum::<Matrix3<f64>>();
        let eigen = SymmetricEigen::new(spread);
        let principal_axes = [0, 1, 2].map(|i| eigen.eigenvectors.column(i).into_owned());
        let surface = Surface::new(mesh);
        let mut points = samples.points;
        points.truncate(options.samples);
        Body { diameter, noise: options.noise, centre, principal_axes, points, field, surface, colors }
    }

    /// Distance beyond which a point is weighted less, metres.
    pub fn robust_scale(&self) -> f64 {
        ROBUST_SCALE * self.diameter + 2.0 * self.noise
    }

    /// Mean distance, from the field, of the first `count` points rotated about an axis, metres.
    pub fn field_mean(&self, axis: &Axis, angles: &[f64], count: usize) -> f64 {
        let points = &self.points[..count.min(self.points.len())];
        let of_angle = |angle: &f64| {
            let rotation = axis.rotation(*angle);
            points.iter().map(|p| self.field.at(&rotation.transform_point(p)).0).sum::<f64>()
        };
        angles.iter().map(of_angle).sum::<f64>() / (points.len() * angles.len()) as f64
    }

    /// The axis refined in `steps` steps so that rotations of the first `count` points by these angles fit the surface
    /// itself best.
    pub fn refined(&self, axis: &Axis, angles: &[f64], (count, steps): (usize, usize)) -> Axis {
        let points = &self.points[..count.min(self.points.len())];
        let residual = |p: &Vec3| {
            let near = self.surface.nearest(p);
            let away = (p - near.point).try_normalize(1e-9 * self.diameter).unwrap_or(near.normal);
            (near.distance, away)
        };
        refine(axis, angles, points, self.robust_scale(), steps, residual)
    }

    /// How far the first `count` points are from the surface when they are rotated; the worst over the angles.
    pub fn deviation(&self, axis: &Axis, angles: &[f64], count: usize) -> Deviation {
        let points = &self.points[..count.min(self.points.len())];
        let mut worst = Deviation { p95: 0.0, max: 0.0 };
        for rotation in angles.iter().map(|angle| axis.rotation(*angle)) {
            let distance = |p: &Vec3| self.surface.nearest(&rotation.transform_point(p)).distance;
            let mut distances: Vec<f64> = points.iter().map(distance).collect();
            worst.p95 = worst.p95.max(percentile(&mut distances, 0.95));
            worst.max = worst.max.max(percentile(&mut distances, 1.0));
        }
        worst
    }

    /// How much colours differ under rotations about an axis, the worst over the angles; `None` for an object without
    /// colours.
    pub fn color_difference(&self, axis: &Axis, angles: &[f64]) -> Option<ColorDifference> {
        let colors = self.colors.as_ref()?;
        let differences = angles.iter().map(|angle| colors.difference(&axis.rotation(*angle)));
        let none = ColorDifference { mean: 0.0, p95: 0.0 };
        Some(differences.fold(none, |worst, d| ColorDifference {
            mean: worst.mean.max(d.mean),
            p95: worst.p95.max(d.p95),
        }))
    }
}
