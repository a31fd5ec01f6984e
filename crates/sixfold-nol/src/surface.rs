//! Points on the surface with normals on the side that can be seen.

use sixfold_geometry::Vec3;
use sixfold_mesh::Mesh;

/// Normals of a surface sample, turned outwards as a whole: files wind their faces either way. By the volume's sign, which
/// for a surface that is not closed still says where most of it faces.
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
