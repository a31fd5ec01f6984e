//! How much an object's colours change at its surface when it is rotated.
//!
//! Colours are smoothed over the surface first: a rotation with an error of a degree moves the edges of a print, which would
//! otherwise count as differences. A detail smaller than the smoothing radius counts in proportion to its area.

use sixfold_geometry::{KdTree, Pose, RgbImage, Vec3};

use super::{ColorDifference, percentile};
use crate::{Mesh, SurfaceSamples};

/// Radius over which colours are smoothed, as a fraction of the diameter: that of some twenty samples.
const SMOOTHING: f64 = 0.04;
/// Samples at which colours are compared; the smoothing uses all samples.
const COMPARED: usize = 1500;

/// Colours of a surface at samples of it.
#[derive(Debug)]
pub(super) struct SurfaceColors {
    tree: KdTree,
    points: Vec<Vec3>,
    normals: Vec<Vec3>,
    /// sRGB, 0 to 1.
    colors: Vec<Vec3>,
    /// Smoothed colours of the first samples.
    smoothed: Vec<Vec3>,
    /// Metres.
    radius: f64,
}

impl SurfaceColors {
    /// The colours of a mesh at samples of its surface; `None` where it has neither vertex colours nor a texture.
    pub fn new(mesh: &Mesh, samples: &SurfaceSamples, diameter: f64) -> Option<SurfaceColors> {
        let at = |(p, face): (&Vec3, &u32)| color_at(mesh, *face as usize, p);
        let colors = samples.points.iter().zip(&samples.faces).map(at).collect::<Option<_>>()?;
        let mut this = SurfaceColors {
            tree: KdTree::new(&samples.points),
            points: samples.points.clone(),
            normals: samples.normals.clone(),
            colors,
            smoothed: vec![],
            radius: SMOOTHING * diameter,
        };
        let compared = COMPARED.min(this.points.len());
        this.smoothed = (0..compared).map(|i| this.smooth(&this.points[i], &this.normals[i])).collect();
        Some(this)
    }

    /// The mean colour around a point of the surface, of samples with a similar normal: walls are thin, and their two sides have
    /// different colours.
    fn smooth(&self, p: &Vec3, normal: &Vec3) -> Vec3 {
        let near = self.tree.within(p, self.radius);
        let alike = near.iter().map(|n| n.index).filter(|i| self.normals[*i].dot(normal) > 0.0);
        let (sum, count) = alike.fold((Vec3::zeros(), 0.0), |(sum, n), i| (sum + self.colors[i], n + 1.0));
        if count > 0.0 {
            return sum / count;
        }
        self.tree.nearest(p).map_or(sum, |n| self.colors[n.index])
    }

    /// The difference under a rotation of the object.
    pub fn difference(&self, rotation: &Pose) -> ColorDifference {
        let difference = |(i, before): (usize, &Vec3)| {
            let normal = rotation.transform_direction(&self.normals[i]);
            let after = self.smooth(&rotation.transform_point(&self.points[i]), &normal);
            (before - after).norm() / 3f64.sqrt()
        };
        let mut differences: Vec<f64> = self.smoothed.iter().enumerate().map(difference).collect();
        let mean = differences.iter().sum::<f64>() / differences.len().max(1) as f64;
        ColorDifference { mean, p95: percentile(&mut differences, 0.95) }
    }
}

/// The colour of a face at a point of it, sRGB from 0 to 1.
fn color_at(mesh: &Mesh, face: usize, p: &Vec3) -> Option<Vec3> {
    let corners = mesh.faces()[face];
    let weights = barycentric(&mesh.triangle(face), p);
    if let (Some(texcoords), Some(texture)) = (mesh.texcoords(), mesh.texture()) {
        let (mut u, mut v) = (0.0, 0.0);
        for (corner, weight) in corners.iter().zip(weights) {
            let at = texcoords[*corner as usize];
            u += weight * f64::from(at[0]);
            v += weight * f64::from(at[1]);
        }
        return texel(texture, u, v);
    }
    let colors = mesh.colors()?;
    let terms = corners.iter().zip(weights).map(|(c, w)| unit(colors[*c as usize]) * w);
    Some(terms.fold(Vec3::zeros(), |sum, term| sum + term))
}

/// The pixel of a texture, which is repeated outside 0..1.
fn texel(texture: &RgbImage, u: f64, v: f64) -> Option<Vec3> {
    let (width, height) = texture.size();
    if width == 0 || height == 0 || !u.is_finite() || !v.is_finite() {
        return None;
    }
    let pixel = |t: f64, size: usize| ((t.rem_euclid(1.0) * size as f64) as usize).min(size - 1);
    Some(unit(texture[(pixel(u, width), pixel(1.0 - v, height))]))
}

fn unit(color: [u8; 3]) -> Vec3 {
    Vec3::from(color.map(|c| f64::from(c) / 255.0))
}

/// The weights of a triangle's corners at a point of it.
fn barycentric([a, b, c]: &[Vec3; 3], p: &Vec3) -> [f64; 3] {
    let normal = (b - a).cross(&(c - a));
    let area = normal.norm_squared();
    let at = |from: &Vec3, to: &Vec3| ((to - from).cross(&(p - from)).dot(&normal) / area).clamp(0.0, 1.0);
    let (first, second) = (at(b, c), at(c, a));
    [first, second, (1.0 - first - second).max(0.0)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_texture_is_read_from_the_bottom_left() {
        let corner = |x: f64, y: f64| Vec3::new(x, y, 0.0);
        let vertices = vec![corner(0.0, 0.0), corner(1.0, 0.0), corner(0.0, 1.0)];
        let mesh = Mesh::new(vertices, vec![[0, 1, 2]]).unwrap();
        let mut texture = RgbImage::filled(2, 2, [0; 3]);
        texture[(0, 1)] = [255, 0, 0];
        let mesh = mesh.with_texture(vec![[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], texture).unwrap();
        assert_eq!(color_at(&mesh, 0, &corner(0.2, 0.2)), Some(Vec3::x()));
        assert_eq!(color_at(&mesh, 0, &corner(0.7, 0.2)), Some(Vec3::zeros()));
        assert_eq!(color_at(&mesh, 0, &corner(0.2, 0.7)), Some(Vec3::zeros()));
    }

    #[test]
    fn vertex_colours_are_interpolated() {
        let mesh = Mesh::new(vec![Vec3::zeros(), Vec3::x(), Vec3::y()], vec![[0, 1, 2]]).unwrap();
        let mesh = mesh.with_colors(vec![[255, 0, 0], [0, 255, 0], [0, 0, 255]]).unwrap();
        let color = color_at(&mesh, 0, &Vec3::new(0.25, 0.5, 0.0)).unwrap();
        assert!((color - Vec3::new(0.25, 0.25, 0.5)).norm() < 1e-12, "{color}");
    }
}
