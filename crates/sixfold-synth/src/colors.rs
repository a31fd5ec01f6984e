//! Colours for shapes that have none.

use rand::RngExt;
use sixfold_geometry::Vec3;
use sixfold_geometry::random::{Random, stream, uniform};
use sixfold_mesh::{Mesh, MeshError};

/// The mesh in random colours that change slowly over its surface, for shapes without colours.
pub fn randomly_colored(mesh: &Mesh, random: &mut Random) -> Mesh {
    let (low, high) = mesh.bounding_box();
    let size = (high - low).norm().max(1e-9);
    let base: [f32; 3] = std::array::from_fn(|_| uniform(random, [0.1, 0.9]));
    let waves: Vec<(Vec3, f64, [f32; 3])> = (0..random.random_range(1..5u32))
        .map(|_| {
            let k = Vec3::from_fn(|_, _| f64::from(uniform(random, [-25.0, 25.0]))) / size;
            let phase = f64::from(uniform(random, [0.0, std::f32::consts::TAU]));
            (k, phase, std::array::from_fn(|_| uniform(random, [-0.25, 0.25])))
        })
        .collect();
    let colors = mesh
        .vertices()
        .iter()
        .map(|v| {
            let mut color = base;
            for (k, phase, amount) in &waves {
                let wave = (k.dot(v) + phase).sin() as f32;
                (0..3).for_each(|c| color[c] += amount[c] * wave);
            }
            color.map(|c| (c.clamp(0.0, 1.0) * 255.0) as u8)
        })
        .collect();
    // One colour per vertex always fits. A texture would take precedence over it, so only the shape is kept.
    Mesh::new(mesh.vertices().to_vec(), mesh.faces().to_vec())
        .and_then(|shape| shape.with_normals(mesh.vertex_normals()))
        .and_then(|shape| shape.with_colors(colors))
        .unwrap_or_else(|_| mesh.clone())
}

/// Gives a mesh without colours a single colour, which depends on its number.
///
/// # Errors
/// [`MeshError`]: never, one colour per vertex always fits.
pub fn with_own_color(mesh: Mesh, number: u32) -> Result<Mesh, MeshError> {
    if mesh.colors().is_some() || mesh.texture().is_some() {
        return Ok(mesh);
    }
    let mut random = stream(u64::from(number), 2 << 40);
    // Hues at distances of the golden ratio: consecutive numbers get very different hues.
    let hue = f64::from(number) * 0.618_033_988_749_895;
    let (pale, bright) = (0.15 + 0.5 * random.random::<f64>(), 110.0 + 120.0 * random.random::<f64>());
    let channel = |shift: f64| {
        let wave = 0.5 + 0.5 * (std::f64::consts::TAU * (hue + shift)).cos();
        (bright * (pale + (1.0 - pale) * wave)).round() as u8
    };
    let color = [channel(0.0), channel(1.0 / 3.0), channel(2.0 / 3.0)];
    let count = mesh.vertices().len();
    mesh.with_colors(vec![color; count])
}
