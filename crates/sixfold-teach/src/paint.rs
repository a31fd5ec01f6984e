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

/// The vertices of a mesh in the photographs.
pub(crate) struct SeenVertices<'a> {
    mesh: &'a Mesh,
    normals: Vec<Vec3>,
    views: usize,
    /// For each vertex, the photographs that show it.
    observations: Vec<Vec<Observation>>,
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

impl<'a> SeenVertices<'a> {
    pub fn new(mesh: &'a Mesh, views: &[View]) -> SeenVertices<'a> {
        let depths: Vec<_> =
            views.par_iter().map(|v| render_depth(mesh, &v.camera_from_world, &v.camera)).collect();
        let normals = mesh.vertex_normals();
        let observations = (0..mesh.vertices().len())
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
        SeenVertices { mesh, normals, views: views.len(), observations }
    }

    /// Vertex colours under the mean light of the photographs.
    pub fn colors(&self) -> Vec<[u8; 3]> {
        let stored = |color: Vec3| <[f64; 3]>::from(color).map(|c| srgb::to_byte(c as f32));
        let colors = colors_in_mean_light(&self.observations, &self.normals, self.views);
        filled(self.mesh, colors.into_iter().map(|color| color.map(stored)).collect())
    }

    /// The fraction of the surface that no photograph shows.
    pub fn unseen(&self) -> f64 {
        let (mut unseen, mut all) = (0.0, 0.0);
        for (number, face) in self.mesh.faces().iter().enumerate() {
            let [a, b, c] = self.mesh.triangle(number);
            let area = (b - a).cross(&(c - a)).norm();
            let missing = face.iter().filter(|i| self.observations[**i as usize].is_empty()).count();
            unseen += area * missing as f64 / 3.0;
            all += area;
        }
        if all > 0.0 { unseen / all } else { 1.0 }
    }
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

#[cfg(test)]
mod tests {
    use sixfold_geometry::{Camera, Image};

    use super::*;
    use crate::simulation::looking_at;

    /// A ball of 60 mm.
    fn ball() -> Mesh {
        const SIDES: u32 = 24;
        let vertices = (0..=SIDES).flat_map(|row| {
            (0..SIDES).map(move |side| {
                let up = f64::from(row) / f64::from(SIDES) * std::f64::consts::PI;
                let around = f64::from(side) / f64::from(SIDES) * std::f64::consts::TAU;
                0.03 * Vec3::new(up.sin() * around.cos(), up.sin() * around.sin(), up.cos())
            })
        });
        let faces = (0..SIDES).flat_map(|row| {
            (0..SIDES).flat_map(move |side| {
                let at = |row: u32, side: u32| row * SIDES + side % SIDES;
                let (a, b, c, d) =
                    (at(row, side), at(row + 1, side), at(row + 1, side + 1), at(row, side + 1));
                [[a, b, c], [a, c, d]]
            })
        });
        Mesh::new(vertices.collect(), faces.collect()).unwrap()
    }

    /// A view from a direction that shows one grey.
    fn view(azimuth: f64, grey: u8) -> View {
        let camera =
            Camera { fx: 500.0, fy: 500.0, cx: 59.5, cy: 59.5, width: 120, height: 120, distortion: None };
        let pose = looking_at(&Vec3::zeros(), azimuth, 30.0, 0.5, 0.0);
        let eye = pose.inverse().translation();
        let image = Image::filled(120, 120, [grey; 3]);
        View { image, camera, camera_from_world: pose, eye, depth: None, mask: None, hidden: None }
    }

    #[test]
    fn photographs_of_different_brightness_leave_no_patches() {
        let mesh = ball();
        let greys = [200, 120, 160, 90, 180, 110, 140, 100];
        let views: Vec<View> = (0..8).map(|i| view(45.0 * i as f64, greys[i])).collect();
        let seen = SeenVertices::new(&mesh, &views);
        let greys: Vec<u8> = seen.colors().iter().map(|c| c[0]).collect();
        let (low, high) = (*greys.iter().min().unwrap(), *greys.iter().max().unwrap());
        assert!(high - low <= 6 && low > 100 && high < 180, "{low} to {high}");
        assert!((0.1..0.4).contains(&seen.unseen()), "{}", seen.unseen());
    }

    #[test]
    fn what_is_not_seen_counts_by_its_area_and_gets_the_colours_around_it() {
        let mesh = ball();
        let seen = SeenVertices::new(&mesh, &[view(0.0, 77)]);
        assert!((0.5..0.7).contains(&seen.unseen()), "{}", seen.unseen());
        assert!(seen.colors().iter().all(|c| *c == [77; 3]));
        assert_eq!(SeenVertices::new(&mesh, &[]).unseen(), 1.0);
    }
}
