//! Combines several materials into the forms that a mesh supports: one texture, or one colour per vertex.

use sixfold_geometry::RgbImage;

use crate::MeshFileError;
use crate::mesh::Parts;

/// Rows of repeated border pixels between the textures of an atlas, so that interpolation does not mix
/// textures.
const GUTTER: usize = 2;
/// Maximum number of pixels of an atlas, and of all textures of a mesh.
pub(crate) const MAX_PIXELS: usize = 1 << 28;

/// The appearance that a material gives to a surface.
#[derive(Debug, Clone)]
pub(crate) enum Paint {
    /// One colour, sRGB.
    Color([u8; 3]),
    /// An image indexed by texture coordinates.
    Texture(RgbImage),
}

/// Gives `parts` the paints of its faces (`face_paints[i]` is the index in `paints` of face `i`'s).
///
/// * only colours: they become vertex colours, unless the file has its own;
/// * one texture on every face: it becomes the mesh's;
/// * else all textures and colours are stacked in one texture. The coordinates of each face are shifted by
///   whole numbers so that they start within the texture; coordinates that are still outside (a tiled
///   texture) are clamped to the border.
///
/// Faces of different paints must not share vertices.
pub(crate) fn apply(
    parts: &mut Parts,
    face_paints: &[usize],
    paints: Vec<Paint>,
    file: &str,
) -> Result<(), MeshFileError> {
    let mut used = vec![false; paints.len()];
    face_paints.iter().for_each(|&paint| used[paint] = true);
    let textures =
        paints.iter().zip(&used).filter(|(p, used)| **used && matches!(p, Paint::Texture(_))).count();
    let colors = used.iter().filter(|used| **used).count() - textures;
    if textures == 0 {
        parts.texcoords = None;
        if parts.colors.is_none() && colors > 0 {
            let mut vertex_colors = vec![[128; 3]; parts.vertices.len()];
            for (face, &paint) in parts.faces.iter().zip(face_paints) {
                if let Paint::Color(color) = paints[paint] {
                    face.iter().for_each(|&v| vertex_colors[v as usize] = color);
                }
            }
            parts.colors = Some(vertex_colors);
        }
        return Ok(());
    }
    if parts.texcoords.is_none() {
        return Err(MeshFileError::field(
            file,
            "texture",
            "texture coordinates for the faces with a texture",
            "none in the file",
        ));
    }
    if textures == 1 && colors == 0 {
        parts.texture = paints.into_iter().zip(used).find_map(|(paint, used)| match paint {
            Paint::Texture(texture) if used => Some(texture),
            _ => None,
        });
        return Ok(());
    }
    stack(parts, face_paints, &paints, &used, file)
}

/// Puts all used paints below one another in one texture.
fn stack(
    parts: &mut Parts,
    face_paints: &[usize],
    paints: &[Paint],
    used: &[bool],
    file: &str,
) -> Result<(), MeshFileError> {
    let size = |paint: &Paint| match paint {
        Paint::Color(_) => (1, 1),
        Paint::Texture(texture) => texture.size(),
    };
    let mut width = 1;
    let mut height = 0;
    let mut tops = vec![0; paints.len()];
    for (index, paint) in paints.iter().enumerate().filter(|(i, _)| used[*i]) {
        width = width.max(size(paint).0);
        tops[index] = height + GUTTER;
        height += size(paint).1 + 2 * GUTTER;
    }
    if width * height > MAX_PIXELS {
        let expected = format!("at most {MAX_PIXELS} pixels in all");
        return Err(MeshFileError::field(file, "textures", expected, format!("{width} x {height}")));
    }
    let mut atlas = RgbImage::filled(width, height, [0; 3]);
    for (index, paint) in paints.iter().enumerate().filter(|(i, _)| used[*i]) {
        let (w, h) = size(paint);
        for y in 0..h + 2 * GUTTER {
            for x in 0..width {
                let (from_x, from_y) = (x.min(w - 1), y.saturating_sub(GUTTER).min(h - 1));
                atlas[(x, tops[index] - GUTTER + y)] = match paint {
                    Paint::Color(color) => *color,
                    Paint::Texture(texture) => texture[(from_x, from_y)],
                };
            }
        }
    }
    let Some(texcoords) = &mut parts.texcoords else { return Ok(()) };
    let source = texcoords.clone();
    let mut moved = vec![false; source.len()];
    for (face, &paint) in parts.faces.iter().zip(face_paints) {
        let corners = face.map(|v| source[v as usize]);
        let turn = [0, 1].map(|k| corners.iter().map(|uv| uv[k]).fold(f32::INFINITY, f32::min).floor());
        // A face that reaches 1 only from below is not shifted.
        let (w, h) = size(&paints[paint]);
        for (&v, uv) in face.iter().zip(corners) {
            if std::mem::replace(&mut moved[v as usize], true) {
                continue;
            }
            let [u, v_up] = [0, 1].map(|k| (uv[k] - turn[k]).clamp(0.0, 1.0));
            let down = (tops[paint] as f32 + (1.0 - v_up) * h as f32) / height as f32;
            texcoords[v as usize] = [u * w as f32 / width as f32, 1.0 - down];
        }
    }
    parts.texture = Some(atlas);
    Ok(())
}
