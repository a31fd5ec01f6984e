//! Colour: vertex colours or texture, lit by Lambert's law with a Blinn-Phong highlight.
//!
//! Light is summed in linear colour and converted to sRGB at the end.

use sixfold_geometry::{Image, RgbImage, Vec3, srgb};

use crate::outputs::surface_normal;
use crate::raster::{SceneObject, VisibilityBuffer};

/// A light, placed in the camera frame. Colours are linear, 1 is full white.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Light {
    /// Uniform light from all directions.
    Ambient {
        /// Colour.
        color: [f32; 3],
    },
    /// Light from infinitely far away.
    Directional {
        /// Direction in which the light travels, in the camera frame; need not have length 1.
        direction: Vec3,
        /// Colour.
        color: [f32; 3],
    },
    /// A point light, falling off with the square of the distance.
    Point {
        /// Position in the camera frame, metres.
        position: Vec3,
        /// Colour at one metre.
        color: [f32; 3],
    },
}

impl Light {
    /// Soft ambient light and a lamp beside the camera, which show shape without hard shadows.
    pub fn default_set() -> Vec<Light> {
        vec![
            Light::Ambient { color: [0.35; 3] },
            Light::Directional { direction: Vec3::new(0.3, 0.5, 1.0), color: [0.75; 3] },
        ]
    }
}

/// Reflection of a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Material {
    /// Strength of the highlight, 0 for none.
    pub specular: f32,
    /// Sharpness of the highlight (Blinn's exponent).
    pub shininess: f32,
    /// Colour of meshes that have neither texture nor vertex colours, sRGB.
    pub plain: [u8; 3],
}

impl Default for Material {
    fn default() -> Self {
        Material { specular: 0.0, shininess: 20.0, plain: [200, 200, 200] }
    }
}

/// Renders the frame's objects in colour over `background` (black when `None`), without shadows.
///
/// # Panics
/// When `background` has another size than the frame.
pub fn shade(
    frame: &VisibilityBuffer,
    objects: &[SceneObject<'_>],
    lights: &[Light],
    material: &Material,
    background: Option<&RgbImage>,
) -> RgbImage {
    shade_in_shadows(frame, objects, lights, &|_, _| 1.0, material, background)
}

/// [`shade`] with shadows: `visible(light, point)` is the fraction of the light with this index that reaches a point in the camera
/// frame, 0..1. It is not called for ambient light. See [`ShadowMap`](crate::ShadowMap).
///
/// # Panics
/// When `background` has another size than the frame.
pub fn shade_in_shadows(
    frame: &VisibilityBuffer,
    objects: &[SceneObject<'_>],
    lights: &[Light],
    visible: &dyn Fn(usize, &Vec3) -> f32,
    material: &Material,
    background: Option<&RgbImage>,
) -> RgbImage {
    let mut out = match background {
        Some(image) => {
            assert_eq!(image.size(), (frame.width(), frame.height()), "background of another size");
            image.clone()
        }
        None => Image::filled(frame.width(), frame.height(), [0; 3]),
    };
    let to_linear = linear_table();
    // Towards each directional light, which is the same for all pixels; `None` for one without a direction.
    let towards: Vec<Option<Vec3>> = lights
        .iter()
        .map(|light| match light {
            Light::Directional { direction, .. } => (-direction).try_normalize(1e-12),
            Light::Ambient { .. } | Light::Point { .. } => None,
        })
        .collect();
    frame.for_surfaces(objects, |index, point, object, face, weights, corners| {
        let mesh = objects[object].mesh;
        let f = mesh.faces()[face];
        let albedo = if let (Some(uv), Some(texture)) = (mesh.texcoords(), mesh.texture()) {
            let at =
                |axis: usize| -> f32 { (0..3).map(|k| uv[f[k] as usize][axis] * weights[k] as f32).sum() };
            sample_texture(texture, at(0), at(1), &to_linear)
        } else if let Some(colors) = mesh.colors() {
            std::array::from_fn(|channel| {
                (0..3).map(|k| to_linear[colors[f[k] as usize][channel] as usize] * weights[k] as f32).sum()
            })
        } else {
            material.plain.map(|c| to_linear[c as usize])
        };
        let normal = surface_normal(&objects[object], face, weights, corners, &point);
        let mut color = [0.0f32; 3];
        for (number, light) in lights.iter().enumerate() {
            let (towards, power) = match light {
                Light::Ambient { color: c } => {
                    for k in 0..3 {
                        color[k] += c[k] * albedo[k];
                    }
                    continue;
                }
                Light::Directional { color, .. } => {
                    let Some(d) = towards[number] else { continue };
                    (d, *color)
                }
                Light::Point { position, color } => {
                    let offset = position - point;
                    let distance2 = offset.norm_squared().max(1e-6);
                    (offset / distance2.sqrt(), color.map(|c| c / distance2 as f32))
                }
            };
            let diffuse = normal.dot(&towards).max(0.0) as f32;
            let highlight = if material.specular > 0.0 && diffuse > 0.0 {
                let half = (towards - point.normalize()).try_normalize(1e-12).unwrap_or(normal);
                material.specular * (normal.dot(&half).max(0.0) as f32).powf(material.shininess)
            } else {
                0.0
            };
            let lit = if diffuse > 0.0 { visible(number, &point) } else { 0.0 };
            for k in 0..3 {
                color[k] += lit * power[k] * (diffuse * albedo[k] + highlight);
            }
        }
        out.as_mut_slice()[index] = color.map(srgb::to_byte);
    });
    out
}

fn linear_table() -> [f32; 256] {
    std::array::from_fn(|i| srgb::to_linear(i as f32 / 255.0))
}

/// Bilinear sampling of a repeated texture in linear colour; `v` points up.
fn sample_texture(texture: &RgbImage, u: f32, v: f32, to_linear: &[f32; 256]) -> [f32; 3] {
    let (w, h) = texture.size();
    if w == 0 || h == 0 || !u.is_finite() || !v.is_finite() {
        return [0.0; 3];
    }
    let x = u.rem_euclid(1.0) * w as f32 - 0.5;
    let y = (1.0 - v).rem_euclid(1.0) * h as f32 - 0.5;
    let (fx, fy) = (x - x.floor(), y - y.floor());
    let column = |i: f32| (i as i64).rem_euclid(w as i64) as usize;
    let row = |i: f32| (i as i64).rem_euclid(h as i64) as usize;
    let (x0, x1) = (column(x.floor()), column(x.floor() + 1.0));
    let (y0, y1) = (row(y.floor()), row(y.floor() + 1.0));
    std::array::from_fn(|k| {
        let at = |x: usize, y: usize| to_linear[texture[(x, y)][k] as usize];
        let top = at(x0, y0) * (1.0 - fx) + at(x1, y0) * fx;
        let bottom = at(x0, y1) * (1.0 - fx) + at(x1, y1) * fx;
        top * (1.0 - fy) + bottom * fy
    })
}
