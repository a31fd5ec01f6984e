//! The shading of each photograph: by how much light and its direction make a surface brighter or darker than on average.
//!
//! A distant light and light from all sides make a matt surface brighter by a function that is linear in its normal (Lambert 1760;
//! Basri and Jacobs 2003, the first four spherical harmonics). Four numbers a channel and a photograph are estimated together
//! with the colours of the surface, by alternating weighted least squares in linear light. A factor that is the same in all
//! photographs cannot be told from colour: it stays in the colours, so these are those under the mean light.

use rayon::prelude::*;
use sixfold_geometry::Vec3;
use sixfold_geometry::nalgebra::{Matrix4, Vector4};

/// Maximum number of alternations of shading and colours; they end when no number of any shading changes by more than [`CONVERGED`].
const ROUNDS: usize = 60;
const CONVERGED: f64 = 1e-3;
/// Smallest and largest shading relative to the mean of the photographs: darker is a shadow, brighter a highlight.
const RANGE: [f64; 2] = [0.2, 5.0];
/// Observations of a photograph below which its light is not estimated.
const FEWEST: usize = 50;
/// The strength with which the direction of a light is kept at zero, relative to the observations.
const RIDGE: f64 = 1e-3;

/// A point of the surface in a photograph.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Observation {
    /// Number of the photograph.
    pub view: usize,
    pub weight: f64,
    /// Linear light, 0 to 1.
    pub color: Vec3,
}

/// Brightness of a surface by its normal: a constant and the three components of the normal, for each channel.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Shading([Vector4<f64>; 3]);

impl Shading {
    const EVEN: Shading = {
        let even = Vector4::new(1.0, 0.0, 0.0, 0.0);
        Shading([even, even, even])
    };

    /// The largest difference of two numbers.
    fn difference(&self, other: &Shading) -> f64 {
        self.0.iter().zip(&other.0).map(|(a, b)| (a - b).amax()).fold(0.0, f64::max)
    }

    fn at(&self, normal: &Vec3) -> Vec3 {
        let terms = Vector4::new(1.0, normal.x, normal.y, normal.z);
        Vec3::from(self.0.map(|channel| channel.dot(&terms).max(1e-3)))
    }
}

/// The colours of points of a surface under the mean light of the photographs, linear, from their observations; `None` for a point
/// without any.
pub(crate) fn colors_in_mean_light(
    seen: &[Vec<Observation>],
    normals: &[Vec3],
    views: usize,
) -> Vec<Option<Vec3>> {
    let mut shadings = vec![Shading::EVEN; views];
    let mut colors = evened(seen, normals, &shadings);
    for _ in 0..ROUNDS {
        let fitted =
            (0..views).into_par_iter().map(|view| fitted(view, seen, normals, &colors, &shadings[view]));
        let fitted: Vec<Shading> = fitted.collect();
        let change = fitted.iter().zip(&shadings).map(|(a, b)| a.difference(b)).fold(0.0, f64::max);
        shadings = fitted;
        colors = evened(seen, normals, &shadings);
        if change < CONVERGED {
            break;
        }
    }
    colors
}

/// The colours after division by the shading relative to its mean over the photographs. A weighted median of each channel, which is
/// robust to moving highlights and to single wrong photographs.
fn evened(seen: &[Vec<Observation>], normals: &[Vec3], shadings: &[Shading]) -> Vec<Option<Vec3>> {
    let color = |(seen, normal): (&Vec<Observation>, &Vec3)| {
        if seen.is_empty() {
            return None;
        }
        let at: Vec<Vec3> = shadings.iter().map(|s| s.at(normal)).collect();
        let mean = at.iter().sum::<Vec3>() / at.len() as f64;
        let even: Vec<(f64, Vec3)> = seen
            .iter()
            .map(|o| {
                let relative = at[o.view].component_div(&mean).map(|r| r.clamp(RANGE[0], RANGE[1]));
                (o.weight, o.color.component_div(&relative))
            })
            .collect();
        Some(weighted_median(&even))
    };
    seen.par_iter().zip(normals).map(color).collect()
}

/// The median of each channel, by weight.
fn weighted_median(values: &[(f64, Vec3)]) -> Vec3 {
    let total: f64 = values.iter().map(|v| v.0).sum();
    Vec3::from(std::array::from_fn(|c| {
        let mut channel: Vec<(f64, f64)> = values.iter().map(|(weight, color)| (color[c], *weight)).collect();
        channel.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut sum = 0.0;
        let median = channel.iter().find(|(_, weight)| {
            sum += weight;
            sum >= 0.5 * total
        });
        median.or(channel.last()).map_or(0.0, |(value, _)| *value)
    }))
}

/// The shading of one photograph by weighted least squares with the colours as they are. Observations far from the shading before
/// (cast shadows, highlights) have small weights.
fn fitted(
    view: usize,
    seen: &[Vec<Observation>],
    normals: &[Vec3],
    colors: &[Option<Vec3>],
    before: &Shading,
) -> Shading {
    let observed: Vec<(f64, Vec3, Vec3, Vec3)> = seen
        .iter()
        .zip(normals)
        .zip(colors)
        .filter_map(|((seen, normal), color)| {
            let o = seen.iter().find(|o| o.view == view)?;
            Some((o.weight, *normal, o.color, (*color)?))
        })
        .collect();
    if observed.len() < FEWEST {
        return *before;
    }
    let channel = |c: usize| {
        let error =
            |(_, normal, shown, color): &(f64, Vec3, Vec3, Vec3)| shown[c] - color[c] * before.at(normal)[c];
        let mut errors: Vec<f64> = observed.iter().map(|o| error(o).abs()).collect();
        errors.sort_by(f64::total_cmp);
        let scale = 1.5 * errors[errors.len() / 2] + 1e-4;
        let (mut matrix, mut right) = (Matrix4::zeros(), Vector4::zeros());
        for o in &observed {
            let (weight, normal, shown, color) = o;
            let weight = weight / (1.0 + (error(o) / scale).powi(2));
            let row = Vector4::new(1.0, normal.x, normal.y, normal.z) * color[c];
            matrix += weight * row * row.transpose();
            right += weight * shown[c] * row;
        }
        let ridge = RIDGE * matrix[(0, 0)];
        (1..4).for_each(|i| matrix[(i, i)] += ridge);
        matrix.cholesky().map_or(before.0[c], |cholesky| cholesky.solve(&right))
    };
    Shading(std::array::from_fn(channel))
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::sphere_directions;

    use super::*;

    /// A ball with two colours, whose photographs see the half that faces them, each under a light of its own: its normals, its colours
    /// under the mean light, and what is seen.
    fn ball(photographs: usize) -> (Vec<Vec3>, Vec<Vec3>, Vec<Vec<Observation>>) {
        let normals = sphere_directions(600);
        let angle = |view: usize| view as f64 * std::f64::consts::TAU / photographs as f64;
        let light = |view: usize, normal: &Vec3| {
            let a = angle(view);
            let lamp = Vec3::new((3.0 * a).cos() * 0.5, (2.0 * a + 1.0).sin() * 0.5, 0.2);
            (1.0 + 0.5 * (2.0 * a).sin()) * (1.0 + lamp.dot(normal))
        };
        let (mut colors, mut seen) = (vec![], vec![]);
        for normal in &normals {
            let is_red = (5.0 * normal.x).sin() > 0.3;
            let color = if is_red { Vec3::new(0.3, 0.1, 0.1) } else { Vec3::new(0.2, 0.3, 0.25) };
            let observed = |view: usize| {
                let towards = Vec3::new(angle(view).cos(), angle(view).sin(), 0.3).normalize();
                let cosine = towards.dot(normal);
                let weight = cosine * cosine;
                (cosine > 0.2).then(|| Observation { view, weight, color: color * light(view, normal) })
            };
            seen.push((0..photographs).filter_map(observed).collect());
            let mean = (0..photographs).map(|view| light(view, normal)).sum::<f64>() / photographs as f64;
            colors.push(color * mean);
        }
        (normals, colors, seen)
    }

    /// The spread of the found colours over the true ones, relative to their mean, of points in sight.
    fn spread(found: &[Option<Vec3>], colors: &[Vec3]) -> f64 {
        let ratios: Vec<f64> = found.iter().zip(colors).filter_map(|(f, c)| Some((*f)?.x / c.x)).collect();
        let mean = ratios.iter().sum::<f64>() / ratios.len() as f64;
        let square = ratios.iter().map(|r| (r / mean - 1.0).powi(2)).sum::<f64>() / ratios.len() as f64;
        square.sqrt()
    }

    #[test]
    fn changing_light_leaves_the_colours_even() {
        let (normals, colors, seen) = ball(12);
        let plain = evened(&seen, &normals, &[Shading::EVEN; 12]);
        let found = colors_in_mean_light(&seen, &normals, 12);
        let spreads = [spread(&plain, &colors), spread(&found, &colors)];
        assert!(spreads[0] > 0.12 && spreads[1] < 0.03, "{spreads:?}");
        let hidden = seen.iter().filter(|s| s.is_empty()).count();
        assert!(hidden > 0 && found.iter().filter(|f| f.is_none()).count() == hidden);
    }

    #[test]
    fn one_photograph_keeps_its_colours() {
        let (normals, _, seen) = ball(1);
        for (found, seen) in colors_in_mean_light(&seen, &normals, 1).iter().zip(&seen) {
            assert_eq!(found.is_some(), !seen.is_empty());
            if let (Some(found), Some(shown)) = (found, seen.first()) {
                assert!((found - shown.color).norm() < 1e-9);
            }
        }
    }
}
