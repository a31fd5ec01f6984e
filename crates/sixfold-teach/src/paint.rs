//! The colours of a mesh from the photographs, and the fraction of its surface that none of them shows.

use rayon::prelude::*;
use sixfold_geometry::{Vec3, srgb};
use sixfold_mesh::Mesh;
use sixfold_render::render_depth;

use crate::shading::{Observation, colors_in_mean_light};
use crate::view::{View, bilinear_rgb};

/// How far a vertex may be behind the rendered surface and still count as visible, metres.
const BEHIND: f64 = 0.003;
/// Minimum cosine between the normal and the viewing ray for a surface to count as visible.
const FLATTEST: f64 = 0.2;

/// Vertex colours, and the fraction of the surface that no photograph shows.
pub(crate) struct Painted {
    pub colors: Vec<[u8; 3]>,
    pub unseen: f64,
}

/// The same surface with every face split into four, repeated while there are at most `most` faces: colours are stored per
/// vertex.
pub(crate) fn finer(mesh: &Mesh, most: usize) -> Mesh {
    let mut mesh = mesh.clone();
    while !mesh.faces().is_empty() && 4 * mesh.faces().len() <= most {
        let mut vertices = mesh.vertices().to_vec();
        let mut midpoints = std::collections::BTreeMap::new();
        let mut midpoint = |a: u32, b: u32| {
            *midpoints.entry((a.min(b), a.max(b))).or_insert_with(|| {
                vertices.push(0.5 * (vertices[a as usize] + vertices[b as usize]));
                vertices.len() as u32 - 1
            })
        };
        let mut faces = Vec::with_capacity(4 * mesh.faces().len());
        for &[a, b, c] in mesh.faces() {
            let [ab, bc, ca] = [midpoint(a, b), midpoint(b, c), midpoint(c, a)];
            faces.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
        }
        let Ok(cut) = Mesh::new(vertices, faces) else { return mesh };
        mesh = cut;
    }
    mesh
}

pub(crate) fn painted(mesh: &Mesh, views: &[View]) -> Painted {
    let depths: Vec<_> =
        views.par_iter().map(|v| render_depth(mesh, &v.camera_from_world, &v.camera)).collect();
    let normals = mesh.vertex_normals();
    let seen: Vec<Vec<Observation>> = (0..mesh.vertices().len())
        .into_par_iter()
        .map(|i| {
            let (point, normal) = (&mesh.vertices()[i], &normals[i]);
            let mut seen = vec![];
            for (number, (view, depth)) in views.iter().zip(&depths).enumerate() {
                let cosine = (view.eye - point).normalize().dot(normal);
                let Some((pixel, z)) = view.project(point) else { continue };
                let nearest = (pixel.x.round() as usize, pixel.y.round() as usize);
                let front = f64::from(depth[nearest]);
                if view.is_hidden(nearest) {
                    continue;
                }
                if cosine > FLATTEST && front > 0.0 && z < front + BEHIND {
                    let color = bilinear_rgb(&view.image, pixel.x, pixel.y);
                    let color = Vec3::from(color.map(|c| f64::from(srgb::to_linear(c as f32 / 255.0))));
                    seen.push(Observation { view: number, weight: cosine * cosine, color });
                }
            }
            seen
        })
        .collect();
    let colors: Vec<Option<[u8; 3]>> = colors_in_mean_light(&seen, &normals, views.len())
        .into_iter()
        .map(|color| Some(color?.into()).map(|c: [f64; 3]| c.map(stored)))
        .collect();
    let unseen = unseen_fraction(mesh, &colors);
    Painted { colors: filled(mesh, colors), unseen }
}

fn stored(linear: f64) -> u8 {
    (255.0 * srgb::from_linear(linear as f32)).round() as u8
}

fn unseen_fraction(mesh: &Mesh, colors: &[Option<[u8; 3]>]) -> f64 {
    let (mut unseen, mut all) = (0.0, 0.0);
    for (number, face) in mesh.faces().iter().enumerate() {
        let [a, b, c] = mesh.triangle(number);
        let area = (b - a).cross(&(c - a)).norm();
        let missing = face.iter().filter(|i| colors[**i as usize].is_none()).count();
        unseen += area * missing as f64 / 3.0;
        all += area;
    }
    if all > 0.0 { unseen / all } else { 1.0 }
}

/// Vertices without a colour get the colour of their neighbours, from the border inwards.
fn filled(mesh: &Mesh, mut colors: Vec<Option<[u8; 3]>>) -> Vec<[u8; 3]> {
    let mut around: Vec<Vec<u32>> = vec![vec![]; mesh.vertices().len()];
    for [a, b, c] in mesh.faces() {
        for (i, j) in [(a, b), (b, c), (c, a)] {
            around[*i as usize].push(*j);
            around[*j as usize].push(*i);
        }
    }
    loop {
        let found: Vec<(usize, [u8; 3])> = (0..colors.len())
            .filter(|i| colors[*i].is_none())
            .filter_map(|i| {
                let known: Vec<[u8; 3]> = around[i].iter().filter_map(|j| colors[*j as usize]).collect();
                let mean = |c: usize| known.iter().map(|k| u32::from(k[c])).sum::<u32>() / known.len() as u32;
                (!known.is_empty()).then(|| (i, std::array::from_fn(|c| mean(c) as u8)))
            })
            .collect();
        if found.is_empty() {
            break;
        }
        found.into_iter().for_each(|(i, color)| colors[i] = Some(color));
    }
    colors.into_iter().map(|c| c.unwrap_or([128; 3])).collect()
}

/// The centre of a mesh's box.
pub(crate) fn centre(mesh: &Mesh) -> Vec3 {
    let (low, high) = mesh.bounding_box();
    (low + high) * 0.5
}
