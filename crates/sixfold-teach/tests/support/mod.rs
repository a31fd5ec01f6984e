//! What the tests of photographs have in common.

use sixfold_geometry::{RgbImage, Vec3};
use sixfold_mesh::Mesh;

/// A box between two corners, metres.
pub fn cuboid(low: [f64; 3], high: [f64; 3]) -> Mesh {
    let corner = |i: usize| {
        let pick = |k: usize| if (i >> k) & 1 == 0 { low[k] } else { high[k] };
        Vec3::new(pick(0), pick(1), pick(2))
    };
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let faces = quads.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
    Mesh::new((0..8).map(corner).collect(), faces).unwrap()
}

/// Parts in one colour each, as one mesh.
pub fn painted(parts: &[Mesh], colors: &[[u8; 3]]) -> Mesh {
    let painted = parts
        .iter()
        .zip(colors)
        .map(|(mesh, color)| mesh.clone().with_colors(vec![*color; mesh.vertices().len()]).unwrap());
    Mesh::merged(&painted.collect::<Vec<_>>()).unwrap()
}

/// The bytes of an image as a PNG file.
pub fn png(image: &RgbImage) -> Vec<u8> {
    let (w, h) = image.size();
    let copy =
        image::RgbImage::from_fn(w as u32, h as u32, |x, y| image::Rgb(image[(x as usize, y as usize)]));
    let mut bytes = std::io::Cursor::new(vec![]);
    copy.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}
