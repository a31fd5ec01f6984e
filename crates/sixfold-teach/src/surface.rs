//! The zero level set of a field on a grid as a closed mesh, by surface nets (Gibson 1998).

use std::collections::BTreeMap;

use sixfold_geometry::Vec3;
use sixfold_mesh::Mesh;

use crate::grid::Grid;

/// The surface around the largest part in which the field is below zero; `None` if there is none. Outside the grid the field
/// counts as above zero, so the surface is closed.
pub(crate) fn surface(grid: &Grid) -> Option<Mesh> {
    let grid = &closed(grid);
    let mut vertices = vec![];
    let mut numbers = vec![u32::MAX; grid.values.len()];
    let [w, h, d] = grid.size;
    for z in 0..d - 1 {
        for y in 0..h - 1 {
            for x in 0..w - 1 {
                if let Some(vertex) = vertex_of(grid, [x, y, z]) {
                    numbers[grid.index([x, y, z])] = vertices.len() as u32;
                    vertices.push(vertex);
                }
            }
        }
    }
    let mut faces = vec![];
    for index in 0..grid.values.len() {
        let place = grid.place(index);
        for axis in 0..3 {
            quad(grid, &numbers, place, axis, &mut faces);
        }
    }
    largest_part(&Mesh::new(vertices, faces).ok()?)
}

/// The field with a border above zero.
fn closed(grid: &Grid) -> Grid {
    let size = grid.size.map(|n| n + 2);
    let mut padded = Grid {
        low: grid.low - Vec3::repeat(grid.step),
        step: grid.step,
        size,
        values: vec![grid.step as f32; size.iter().product()],
    };
    for (index, value) in grid.values.iter().enumerate() {
        let at = padded.index(grid.place(index).map(|c| c + 1));
        padded.values[at] = *value;
    }
    padded
}

/// The mean of the zero crossings on the edges of a cell.
fn vertex_of(grid: &Grid, [x, y, z]: [usize; 3]) -> Option<Vec3> {
    let corner = |i: usize| [x + (i & 1), y + (i >> 1 & 1), z + (i >> 2 & 1)];
    let values: [f32; 8] = std::array::from_fn(|i| grid.values[grid.index(corner(i))]);
    let inside = values.iter().filter(|v| **v < 0.0).count();
    if inside == 0 || inside == 8 {
        return None;
    }
    let (mut sum, mut count) = (Vec3::zeros(), 0.0);
    for i in 0..8 {
        for axis in 0..3 {
            let j = i | 1 << axis;
            if j == i || (values[i] < 0.0) == (values[j] < 0.0) {
                continue;
            }
            let t = f64::from(values[i] / (values[i] - values[j]));
            sum += grid.point(corner(i)).lerp(&grid.point(corner(j)), t);
            count += 1.0;
        }
    }
    Some(sum / count)
}

/// The two triangles across an edge of the grid that crosses zero.
fn quad(grid: &Grid, numbers: &[u32], place: [usize; 3], axis: usize, faces: &mut Vec<[u32; 3]>) {
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    if place[axis] + 1 >= grid.size[axis] || place[u] == 0 || place[v] == 0 {
        return;
    }
    let mut end = place;
    end[axis] += 1;
    let (from, to) = (grid.values[grid.index(place)] < 0.0, grid.values[grid.index(end)] < 0.0);
    if from == to {
        return;
    }
    let cell = |du: usize, dv: usize| {
        let mut cell = place;
        cell[u] -= du;
        cell[v] -= dv;
        numbers[grid.index(cell)]
    };
    let [a, b, c, d] = [cell(1, 1), cell(0, 1), cell(0, 0), cell(1, 0)];
    if [a, b, c, d].contains(&u32::MAX) {
        return;
    }
    // Counter-clockwise seen from outside.
    if from {
        faces.extend([[a, b, c], [a, c, d]]);
    } else {
        faces.extend([[a, c, b], [a, d, c]]);
    }
}

/// The connected part with most faces; connected faces share a vertex.
fn largest_part(mesh: &Mesh) -> Option<Mesh> {
    let mut parent: Vec<u32> = (0..mesh.vertices().len() as u32).collect();
    fn root(parent: &mut [u32], mut i: u32) -> u32 {
        while parent[i as usize] != i {
            parent[i as usize] = parent[parent[i as usize] as usize];
            i = parent[i as usize];
        }
        i
    }
    for [a, b, c] in mesh.faces() {
        for other in [b, c] {
            let (x, y) = (root(&mut parent, *a), root(&mut parent, *other));
            parent[x.max(y) as usize] = x.min(y);
        }
    }
    let mut counts: BTreeMap<u32, usize> = BTreeMap::new();
    for face in mesh.faces() {
        *counts.entry(root(&mut parent, face[0])).or_default() += 1;
    }
    let (&most, _) = counts.iter().max_by_key(|(part, count)| (**count, std::cmp::Reverse(**part)))?;
    let mut numbers = vec![u32::MAX; mesh.vertices().len()];
    let (mut vertices, mut faces) = (vec![], vec![]);
    for face in mesh.faces() {
        if root(&mut parent, face[0]) != most {
            continue;
        }
        faces.push(face.map(|i| {
            let number = &mut numbers[i as usize];
            if *number == u32::MAX {
                *number = vertices.len() as u32;
                vertices.push(mesh.vertices()[i as usize]);
            }
            *number
        }));
    }
    Mesh::new(vertices, faces).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::view::Volume;

    /// How often each edge is used, in either direction.
    fn edges(mesh: &Mesh) -> BTreeMap<(u32, u32), i32> {
        let mut edges = BTreeMap::new();
        for [a, b, c] in mesh.faces() {
            for (i, j) in [(*a, *b), (*b, *c), (*c, *a)] {
                *edges.entry((i.min(j), i.max(j))).or_insert(0) += if i < j { 1 } else { -1 };
            }
        }
        edges
    }

    #[test]
    fn a_ball_becomes_a_closed_mesh_of_its_size_that_faces_outwards() {
        let volume = Volume { low: Vec3::repeat(-1.0), high: Vec3::repeat(1.0) };
        let away = Vec3::repeat(0.8);
        let grid = Grid::new(&volume, 40, |p| ((p.norm() - 0.6).min((p - away).norm() - 0.1)) as f32);
        let mesh = surface(&grid).unwrap();
        assert!(edges(&mesh).values().all(|n| *n == 0), "an edge has one side only");
        // The small part is left out.
        assert!(mesh.vertices().iter().all(|v| (v.norm() - 0.6).abs() < 0.01));
        let volume: f64 = (0..mesh.faces().len())
            .map(|f| mesh.triangle(f))
            .map(|[a, b, c]| a.dot(&b.cross(&c)) / 6.0)
            .sum();
        let exact = 4.0 / 3.0 * std::f64::consts::PI * 0.6f64.powi(3);
        assert!((volume / exact - 1.0).abs() < 0.02, "{volume} {exact}");
    }

    #[test]
    fn surfaces_at_the_border_are_closed() {
        let volume = Volume { low: Vec3::repeat(-1.0), high: Vec3::repeat(1.0) };
        let mesh = surface(&Grid::new(&volume, 10, |_| -1.0)).unwrap();
        assert!(edges(&mesh).values().all(|n| *n == 0));
        assert!(surface(&Grid::new(&volume, 10, |_| 1.0)).is_none());
    }
}
