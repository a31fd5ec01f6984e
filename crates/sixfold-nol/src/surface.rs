//! Points on the surface with outward normals.

use sixfold_geometry::Vec3;
use sixfold_mesh::Mesh;

/// Normals of a surface sample, all negated if necessary so that they point outwards: files orient their faces either way. The sign
/// of the volume decides, which for an open surface still shows the direction that most of it faces.
pub(crate) fn outwards(mesh: &Mesh, normals: &[Vec3]) -> Vec<Vec3> {
    let (low, high) = mesh.bounding_box();
    let centre = (low + high) * 0.5;
    let volume: f64 = (0..mesh.faces().len())
        .map(|face| {
            let [a, b, c] = mesh.triangle(face).map(|v| v - centre);
            a.dot(&b.cross(&c))
        })
        .sum();
    let sign = if volume < 0.0 { -1.0 } else { 1.0 };
    normals.iter().map(|n| n * sign).collect()
}
