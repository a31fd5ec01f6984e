//! glTF 2.0 (Khronos 2021), as text with external or embedded buffers, or binary (GLB).
//!
//! The crate gltf parses the document and checks its references. But its accessors and GLB header trust lengths (a length of 3 in
//! the header underflows, as does a count of zero), its validation panics on an accessor that does not exist, its images panic on
//! one without a type, and its node trees may contain cycles. So chunks, accessors and the traversal of the nodes are implemented
//! here, with every offset checked.

use std::borrow::Cow;
use std::collections::HashMap;

use gltf::accessor::{DataType, Dimensions};
use gltf::buffer::Source;
use gltf::mesh::Mode;
use gltf::{Accessor, Document, Gltf, Primitive, Semantic};
use nalgebra::{Matrix3, Matrix4};
use sixfold_geometry::{RgbImage, Vec3, srgb};

use crate::file::decode_texture;
use crate::mesh::Parts;
use crate::paint::{MAX_PIXELS, Paint, apply};
use crate::ply::{excerpt, shown_name};
use crate::{Mesh, MeshFileError, Resources, Unit};

/// Largest number of vertices and of faces of a file, whose nodes can use the same mesh many times.
const MOST: usize = 1 << 24;

/// Reads a glTF mesh from the bytes of a file, text or binary (GLB).
///
/// All triangles of the default scene (else of the first scene, else of all nodes), transformed by their nodes. Positions are in
/// metres by the specification; they are multiplied by `unit` nevertheless. Kept: `NORMAL`, `COLOR_0` (linear there, sRGB here),
/// base colour textures with the texture coordinates that they refer to, base colour factors. One texture on all faces stays as it
/// is; only factors become vertex colours; anything else is stacked into one texture. Points and lines, skins, morph targets, alpha
/// and texture transforms are left out; sparse accessors and compressed meshes are refused. `resources` provides external buffers
/// and images.
///
/// # Errors
/// [`MeshFileError`] with the part of the document; `file` is the name in messages.
pub fn parse_gltf(
    bytes: &[u8],
    file: &str,
    unit: Unit,
    resources: Resources<'_>,
) -> Result<Mesh, MeshFileError> {
    let (json, blob) = if bytes.starts_with(b"glTF") { chunks(bytes, file)? } else { (bytes, None) };
    if json.starts_with(b"glTF") {
        return Err(MeshFileError::field(file, "chunk JSON", "a JSON document", "another GLB file"));
    }
    let document = checked_document(json)
        .map_err(|found| MeshFileError::field(file, "document", "a valid glTF 2.0 document", found))?;
    let mut buffers = Vec::new();
    for buffer in document.buffers() {
        let field = format!("buffers[{}]", buffer.index());
        let data = match buffer.source() {
            Source::Bin => Cow::Borrowed(blob.ok_or_else(|| {
                MeshFileError::field(file, &field, "a uri, or the BIN chunk of a GLB file", "neither")
            })?),
            Source::Uri(uri) => Cow::Owned(read_uri(uri, file, &field, resources)?),
        };
        if data.len() < buffer.length() {
            let expected = format!("{} bytes", buffer.length());
            return Err(MeshFileError::field(file, field, expected, format!("{} bytes", data.len())));
        }
        buffers.push(data);
    }
    let mut reader = Reader {
        file,
        resources,
        buffers,
        parts: Parts::default(),
        face_paints: Vec::new(),
        paints: Vec::new(),
        paint_of: HashMap::new(),
        pixels: 0,
        scale: unit.to_metres(),
    };
    reader.walk(&document)?;
    let Reader { mut parts, face_paints, paints, .. } = reader;
    if parts.faces.is_empty() {
        return Err(MeshFileError::field(file, "scene", "a node with a mesh of triangles", "none"));
    }
    apply(&mut parts, &face_paints, paints, file)?;
    parts.into_mesh(file)
}

/// The document, with all references validated by the crate, after checks of what its validation and its accessors take for
/// granted.
fn checked_document(json: &[u8]) -> Result<Document, String> {
    let mut root = Gltf::from_slice_without_validation(json).map_err(|e| e.to_string())?.document.into_json();
    for (index, mesh) in root.meshes.iter().enumerate() {
        for accessor in mesh.primitives.iter().flat_map(|p| p.attributes.values()) {
            if accessor.value() >= root.accessors.len() {
                let count = root.accessors.len();
                return Err(format!("meshes[{index}] with accessor {} of {count}", accessor.value()));
            }
        }
    }
    for (index, image) in root.images.iter_mut().enumerate() {
        if image.uri.is_none() && image.buffer_view.is_none() {
            return Err(format!("images[{index}] without uri and bufferView"));
        }
        // Images are distinguished by their first bytes, but the crate asks for a type.
        image.mime_type.get_or_insert_with(|| gltf::json::image::MimeType("image/png".to_owned()));
    }
    Document::from_json(root).map_err(|error| error.to_string())
}

/// The JSON and BIN chunks of a GLB file.
fn chunks<'a>(bytes: &'a [u8], file: &str) -> Result<(&'a [u8], Option<&'a [u8]>), MeshFileError> {
    let word =
        |at: usize| bytes.get(at..at + 4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize);
    if word(4) != Some(2) {
        let found = word(4).map_or("the end of the file".to_owned(), |v| v.to_string());
        return Err(MeshFileError::field(file, "header, version", "2", found));
    }
    let chunk = |at: usize, kind: &[u8; 4], name: &str| {
        let found = word(at).map_or("the end of the file".to_owned(), |n| format!("a chunk of {n} bytes"));
        let here = bytes.get(at + 4..at + 8) == Some(kind);
        let end = word(at).and_then(|length| (at + 8).checked_add(length));
        end.filter(|_| here).and_then(|end| Some((bytes.get(at + 8..end)?, end))).ok_or_else(|| {
            let expected = format!("a chunk {name} within the {} bytes of the file", bytes.len());
            MeshFileError::field(file, format!("chunk {name}"), expected, found)
        })
    };
    let (json, end) = chunk(12, b"JSON", "JSON")?;
    let next = end.next_multiple_of(4);
    if next >= bytes.len() {
        return Ok((json, None));
    }
    let (blob, _) = chunk(next, b"BIN\0", "BIN")?;
    Ok((json, Some(blob)))
}

/// The bytes of a `data:` URI, or of the file that a relative URI refers to.
fn read_uri(uri: &str, file: &str, field: &str, resources: Resources<'_>) -> Result<Vec<u8>, MeshFileError> {
    if let Some(data) = uri.strip_prefix("data:") {
        return data.split_once(";base64,").and_then(|(_, text)| from_base64(text)).ok_or_else(|| {
            MeshFileError::field(file, field, "a data URI in base64", format!("\"{}\"", excerpt(uri)))
        });
    }
    let name = percent_decoded(uri);
    resources(&name).map_err(|error| MeshFileError::Named {
        file: file.to_owned(),
        field: field.to_owned(),
        named: shown_name(&name),
        reason: error.to_string(),
    })
}

fn from_base64(text: &str) -> Option<Vec<u8>> {
    let mut bytes = Vec::with_capacity(text.len() / 4 * 3);
    let (mut bits, mut count) = (0u32, 0);
    for letter in text.trim_end_matches('=').bytes() {
        let six = match letter {
            b'A'..=b'Z' => letter - b'A',
            b'a'..=b'z' => letter - b'a' + 26,
            b'0'..=b'9' => letter - b'0' + 52,
            b'+' | b'-' => 62,
            b'/' | b'_' => 63,
            _ => return None,
        };
        bits = bits << 6 | u32::from(six);
        count += 6;
        if count >= 8 {
            count -= 8;
            bytes.push((bits >> count) as u8);
        }
    }
    Some(bytes)
}

fn percent_decoded(text: &str) -> String {
    let bytes = text.as_bytes();
    let mut out = Vec::with_capacity(bytes.len());
    let mut at = 0;
    while at < bytes.len() {
        let hex = bytes.get(at + 1..at + 3).and_then(|h| std::str::from_utf8(h).ok());
        match hex.filter(|_| bytes[at] == b'%').and_then(|h| u8::from_str_radix(h, 16).ok()) {
            Some(byte) => {
                out.push(byte);
                at += 3;
            }
            None => {
                out.push(bytes[at]);
                at += 1;
            }
        }
    }
    String::from_utf8_lossy(&out).into_owned()
}

struct Reader<'a> {
    file: &'a str,
    resources: Resources<'a>,
    buffers: Vec<Cow<'a, [u8]>>,
    parts: Parts,
    face_paints: Vec<usize>,
    paints: Vec<Paint>,
    /// Paints by image and factor, so that a texture is decoded once.
    paint_of: HashMap<(Option<usize>, [u32; 3]), usize>,
    /// Pixels of all textures so far.
    pixels: usize,
    scale: f64,
}

impl Reader<'_> {
    /// Traverses the nodes with an explicit stack, so that a deep tree cannot overflow the call stack.
    fn walk(&mut self, document: &Document) -> Result<(), MeshFileError> {
        let nodes: Vec<_> = document.nodes().collect();
        let scene = document.default_scene().or_else(|| document.scenes().next());
        let roots: Vec<usize> = match scene {
            Some(scene) => scene.nodes().map(|node| node.index()).collect(),
            None => {
                let mut is_child = vec![false; nodes.len()];
                nodes.iter().flat_map(|node| node.children()).for_each(|c| is_child[c.index()] = true);
                (0..nodes.len()).filter(|i| !is_child[*i]).collect()
            }
        };
        let mut seen = vec![false; nodes.len()];
        let mut stack: Vec<(usize, Matrix4<f64>)> =
            roots.into_iter().rev().map(|root| (root, Matrix4::identity())).collect();
        while let Some((index, scene_from_parent)) = stack.pop() {
            let node = &nodes[index];
            if std::mem::replace(&mut seen[index], true) {
                let field = format!("nodes[{index}]");
                let found = "a second way to it, or a circle";
                return Err(MeshFileError::field(self.file, field, "a tree of nodes", found));
            }
            let own = Matrix4::from(node.transform().matrix()).map(f64::from);
            let scene_from_node = scene_from_parent * own;
            if let Some(mesh) = node.mesh() {
                for primitive in mesh.primitives() {
                    let name = format!("meshes[{}].primitives[{}]", mesh.index(), primitive.index());
                    self.primitive(&primitive, &name, &scene_from_node)?;
                }
            }
            let mut children: Vec<_> = node.children().map(|c| (c.index(), scene_from_node)).collect();
            children.reverse();
            stack.append(&mut children);
        }
        Ok(())
    }

    fn error(&self, field: &str, expected: &str, found: impl Into<String>) -> MeshFileError {
        MeshFileError::field(self.file, field, expected, found)
    }

    fn primitive(
        &mut self,
        primitive: &Primitive<'_>,
        name: &str,
        scene_from_node: &Matrix4<f64>,
    ) -> Result<(), MeshFileError> {
        if !matches!(primitive.mode(), Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan) {
            return Ok(());
        }
        let Some(positions) = primitive.get(&Semantic::Positions) else {
            return Err(self.error(name, "an attribute POSITION", "no such attribute"));
        };
        let positions = self.floats::<3>(&positions, &format!("{name}.POSITION"))?;
        let count = positions.len();
        let offset = self.parts.vertices.len();
        let order: Vec<u32> = match primitive.indices() {
            Some(accessor) => self.indices(&accessor, &format!("{name}.indices"), count)?,
            None => (0..count as u32).collect(),
        };
        if offset + count > MOST || self.parts.faces.len() + order.len() > MOST {
            let expected = format!("at most {MOST} vertices and faces in all");
            return Err(self.error(name, &expected, "more"));
        }
        let linear: Matrix3<f64> = scene_from_node.fixed_view::<3, 3>(0, 0).into_owned();
        let shift: Vec3 = scene_from_node.fixed_view::<3, 1>(0, 3).into_owned();
        for (index, position) in positions.into_iter().enumerate() {
            let vertex = (linear * Vec3::from(position.map(f64::from)) + shift) * self.scale;
            if !vertex.iter().all(|c| c.is_finite()) {
                let field = format!("{name}.POSITION[{index}]");
                return Err(self.error(&field, "finite numbers", format!("{:?}", vertex.as_slice())));
            }
            self.parts.vertices.push(vertex);
        }
        let material = primitive.material();
        let pbr = material.pbr_metallic_roughness();
        let texture = pbr.base_color_texture();
        let set = texture.as_ref().map_or(0, |info| info.tex_coord());
        let attribute = |semantic: Semantic| primitive.get(&semantic);
        let normals = match attribute(Semantic::Normals) {
            Some(accessor) => Some(self.floats::<3>(&accessor, &format!("{name}.NORMAL"))?),
            None => None,
        };
        let colors = match attribute(Semantic::Colors(0)) {
            Some(accessor) if accessor.dimensions() == Dimensions::Vec4 => {
                let colors = self.floats::<4>(&accessor, &format!("{name}.COLOR_0"))?;
                Some(colors.into_iter().map(|[r, g, b, _]| [r, g, b]).collect())
            }
            Some(accessor) => Some(self.floats::<3>(&accessor, &format!("{name}.COLOR_0"))?),
            None => None,
        };
        let texcoords = match attribute(Semantic::TexCoords(set)) {
            Some(accessor) => Some(self.floats::<2>(&accessor, &format!("{name}.TEXCOORD_{set}"))?),
            None => None,
        };
        for (attribute, length) in [
            ("NORMAL", normals.as_ref().map_or(count, Vec::len)),
            ("COLOR_0", colors.as_ref().map_or(count, Vec::len)),
            ("TEXCOORD", texcoords.as_ref().map_or(count, Vec::len)),
        ] {
            if length != count {
                let expected = format!("{count} entries, one for each position");
                return Err(self.error(&format!("{name}.{attribute}"), &expected, length.to_string()));
            }
        }
        // The inverse transpose (up to a factor, the cofactors) keeps normals perpendicular to a stretched surface.
        let determinant = linear.determinant();
        let cofactors = Matrix3::from_columns(&[
            linear.column(1).cross(&linear.column(2)),
            linear.column(2).cross(&linear.column(0)),
            linear.column(0).cross(&linear.column(1)),
        ]) * if determinant < 0.0 { -1.0 } else { 1.0 };
        let normals = normals.map(|normals| {
            normals.into_iter().map(move |n| cofactors * Vec3::from(n.map(f64::from))).collect()
        });
        let colors =
            colors.map(|colors: Vec<[f32; 3]>| colors.into_iter().map(|c| c.map(srgb::to_byte)).collect());
        // In the file, v points down from the top.
        let texcoords = texcoords.map(|t| {
            t.into_iter()
                .map(|[u, v]| [u, 1.0 - v])
                .map(|t| if t[0].is_finite() && t[1].is_finite() { t } else { [0.0; 2] })
                .collect()
        });
        append(&mut self.parts.normals, normals, offset, count, Vec3::zeros());
        append(&mut self.parts.colors, colors, offset, count, [255; 3]);
        let has_texcoords = texcoords.is_some();
        append(&mut self.parts.texcoords, texcoords, offset, count, [0.0; 2]);
        let image = texture.filter(|_| has_texcoords).map(|info| info.texture().source());
        let [r, g, b, _] = pbr.base_color_factor();
        let paint = self.paint(image, [r, g, b])?;
        self.add_faces(&order, primitive.mode(), offset, determinant < 0.0, paint);
        Ok(())
    }

    /// Splits a list of corners into triangles; a mirrored node reverses their order.
    fn add_faces(&mut self, order: &[u32], mode: Mode, offset: usize, mirrored: bool, paint: usize) {
        let mut add = |[a, b, c]: [u32; 3]| {
            let face = if mirrored { [a, c, b] } else { [a, b, c] };
            self.parts.faces.push(face.map(|v| v + offset as u32));
            self.face_paints.push(paint);
        };
        match mode {
            Mode::TriangleStrip => {
                for (index, w) in order.windows(3).enumerate() {
                    add(if index % 2 == 0 { [w[0], w[1], w[2]] } else { [w[1], w[0], w[2]] });
                }
            }
            Mode::TriangleFan => {
                for w in order.get(1..).unwrap_or_default().windows(2) {
                    add([order[0], w[0], w[1]]);
                }
            }
            _ => order.chunks_exact(3).for_each(|w| add([w[0], w[1], w[2]])),
        }
    }

    fn paint(&mut self, image: Option<gltf::Image<'_>>, factor: [f32; 3]) -> Result<usize, MeshFileError> {
        let key = (image.as_ref().map(|i| i.index()), factor.map(f32::to_bits));
        if let Some(&paint) = self.paint_of.get(&key) {
            return Ok(paint);
        }
        let paint = match image {
            None => Paint::Color(factor.map(srgb::to_byte)),
            Some(image) => {
                let mut texture = self.texture(&image)?;
                if factor != [1.0; 3] {
                    let tables = factor.map(|f| {
                        (0..=255u8)
                            .map(|b| srgb::to_byte(srgb::to_linear(f32::from(b) / 255.0) * f))
                            .collect::<Vec<u8>>()
                    });
                    for pixel in texture.as_mut_slice() {
                        for (value, table) in pixel.iter_mut().zip(&tables) {
                            *value = table[usize::from(*value)];
                        }
                    }
                }
                Paint::Texture(texture)
            }
        };
        if let Paint::Texture(texture) = &paint {
            // The same image with many factors makes many textures.
            self.pixels += texture.as_slice().len();
            if self.pixels > MAX_PIXELS {
                let expected = format!("at most {MAX_PIXELS} pixels in all");
                return Err(self.error("textures", &expected, "more"));
            }
        }
        self.paints.push(paint);
        self.paint_of.insert(key, self.paints.len() - 1);
        Ok(self.paints.len() - 1)
    }

    fn texture(&self, image: &gltf::Image<'_>) -> Result<RgbImage, MeshFileError> {
        let field = format!("images[{}]", image.index());
        let bytes = match image.source() {
            gltf::image::Source::View { view, .. } => Cow::Borrowed(self.view(&view, &field)?),
            gltf::image::Source::Uri { uri, .. } => {
                Cow::Owned(read_uri(uri, self.file, &field, self.resources)?)
            }
        };
        decode_texture(&bytes).map_err(|reason| self.error(&field, "a PNG or JPEG image", reason))
    }

    fn view(&self, view: &gltf::buffer::View<'_>, field: &str) -> Result<&[u8], MeshFileError> {
        let data = self.buffers.get(view.buffer().index()).map_or(&[][..], |data| data);
        let end = view.offset().checked_add(view.length());
        end.and_then(|end| data.get(view.offset()..end)).ok_or_else(|| {
            let expected = format!("a bufferViews[{}] within the {} bytes", view.index(), data.len());
            self.error(field, &expected, format!("{} bytes from {}", view.length(), view.offset()))
        })
    }

    /// Calls `take` with the bytes of each element of an accessor.
    fn elements(
        &self,
        accessor: &Accessor<'_>,
        field: &str,
        mut take: impl FnMut(&[u8]),
    ) -> Result<(), MeshFileError> {
        let (Some(view), None) = (accessor.view(), accessor.sparse()) else {
            return Err(self.error(field, "an accessor with a bufferView", "a sparse or empty one"));
        };
        let data = self.view(&view, field)?;
        let size = accessor.data_type().size() * accessor.dimensions().multiplicity();
        let stride = view.stride().unwrap_or(size);
        let count = accessor.count();
        if count == 0 {
            return Ok(());
        }
        let end = stride
            .checked_mul(count - 1)
            .and_then(|n| n.checked_add(size))
            .and_then(|n| n.checked_add(accessor.offset()));
        if stride == 0 || end.is_none_or(|end| end > data.len()) {
            let expected = format!("{count} elements of {size} bytes, {stride} apart");
            let found = format!("{} bytes from {}; it is cut off or lies", data.len(), accessor.offset());
            return Err(self.error(field, &expected, found));
        }
        for index in 0..count {
            let start = accessor.offset() + index * stride;
            take(&data[start..start + size]);
        }
        Ok(())
    }

    fn floats<const N: usize>(
        &self,
        accessor: &Accessor<'_>,
        field: &str,
    ) -> Result<Vec<[f32; N]>, MeshFileError> {
        let kind = accessor.data_type();
        if accessor.dimensions().multiplicity() != N
            || !matches!(kind, DataType::F32 | DataType::U8 | DataType::U16)
        {
            let expected = format!("{N} floats, or normalised unsigned integers");
            return Err(self.error(field, &expected, format!("{kind:?} {:?}", accessor.dimensions())));
        }
        let mut out = Vec::new();
        self.elements(accessor, field, |bytes| {
            let mut element = [0.0; N];
            for (value, raw) in element.iter_mut().zip(bytes.chunks_exact(kind.size())) {
                *value = match (kind, raw) {
                    (DataType::U8, [a]) => f32::from(*a) / 255.0,
                    (DataType::U16, [a, b]) => f32::from(u16::from_le_bytes([*a, *b])) / 65535.0,
                    (_, [a, b, c, d]) => f32::from_le_bytes([*a, *b, *c, *d]),
                    _ => 0.0,
                };
            }
            out.push(element);
        })?;
        Ok(out)
    }

    fn indices(
        &self,
        accessor: &Accessor<'_>,
        field: &str,
        vertices: usize,
    ) -> Result<Vec<u32>, MeshFileError> {
        let kind = accessor.data_type();
        if accessor.dimensions() != Dimensions::Scalar
            || !matches!(kind, DataType::U8 | DataType::U16 | DataType::U32)
        {
            let found = format!("{kind:?} {:?}", accessor.dimensions());
            return Err(self.error(field, "unsigned integers", found));
        }
        let mut out = Vec::new();
        self.elements(accessor, field, |bytes| {
            let mut word = [0; 4];
            word[..bytes.len()].copy_from_slice(bytes);
            out.push(u32::from_le_bytes(word));
        })?;
        match out.iter().find(|i| **i as usize >= vertices) {
            Some(found) => Err(self.error(field, &format!("indices below {vertices}"), found.to_string())),
            None => Ok(out),
        }
    }
}

/// Appends a primitive's attribute; vertices without the attribute get `missing`.
fn append<T: Clone>(all: &mut Option<Vec<T>>, own: Option<Vec<T>>, before: usize, count: usize, missing: T) {
    if own.is_none() && all.is_none() {
        return;
    }
    let all = all.get_or_insert_with(|| vec![missing.clone(); before]);
    all.extend(own.unwrap_or_else(|| vec![missing; count]));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::no_resources;
    use proptest::prelude::*;

    fn png(color: [u8; 3]) -> Vec<u8> {
        let mut bytes = std::io::Cursor::new(Vec::new());
        image::RgbImage::from_pixel(2, 2, image::Rgb(color))
            .write_to(&mut bytes, image::ImageFormat::Png)
            .unwrap();
        bytes.into_inner()
    }

    /// A unit square in z = 0 with texture coordinates and indices.
    fn square() -> Vec<u8> {
        let mut bin = Vec::new();
        for value in [[0.0f32, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]].as_flattened() {
            bin.extend(value.to_le_bytes());
        }
        for value in [[0.0f32, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]].as_flattened() {
            bin.extend(value.to_le_bytes());
        }
        for index in [0u16, 1, 2, 0, 2, 3] {
            bin.extend(index.to_le_bytes());
        }
        bin
    }

    /// The document around [`square`] (92 bytes) and a PNG behind it.
    fn document(node: &str, buffer: &str, png: usize, material: &str) -> String {
        format!(
            r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],"nodes":[{node}],
            "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"TEXCOORD_0":1}},"indices":2,"material":0}}]}}],
            "materials":[{{"pbrMetallicRoughness":{{{material}}}}}],"textures":[{{"source":0}}],
            "images":[{{"bufferView":3,"mimeType":"image/png"}}],
            "accessors":[
            {{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3","min":[0,0,0],"max":[1,1,0]}},
            {{"bufferView":1,"componentType":5126,"count":4,"type":"VEC2"}},
            {{"bufferView":2,"componentType":5123,"count":6,"type":"SCALAR"}}],
            "bufferViews":[{{"buffer":0,"byteOffset":0,"byteLength":48}},{{"buffer":0,"byteOffset":48,"byteLength":32}},
            {{"buffer":0,"byteOffset":80,"byteLength":12}},{{"buffer":0,"byteOffset":92,"byteLength":{png}}}],
            "buffers":[{{"byteLength":{length}{buffer}}}]}}"#,
            length = 92 + png
        )
    }

    fn glb(json: &str, bin: &[u8]) -> Vec<u8> {
        let pad = |bytes: &[u8], with: u8| {
            let mut bytes = bytes.to_vec();
            bytes.resize(bytes.len().next_multiple_of(4), with);
            bytes
        };
        let (json, bin) = (pad(json.as_bytes(), b' '), pad(bin, 0));
        let mut out = b"glTF".to_vec();
        let total = 12 + 8 + json.len() + 8 + bin.len();
        for part in [2u32, total as u32, json.len() as u32] {
            out.extend(part.to_le_bytes());
        }
        out.extend(b"JSON");
        out.extend(json);
        out.extend((bin.len() as u32).to_le_bytes());
        out.extend(b"BIN\0");
        out.extend(bin);
        out
    }

    const TEXTURED: &str = r#""baseColorTexture":{"index":0}"#;
    const MIRRORED: &str = r#"{"mesh":0,"translation":[0,0,2],"scale":[-1,1,1]}"#;

    fn textured() -> Vec<u8> {
        let png = png([10, 200, 30]);
        glb(&document(MIRRORED, "", png.len(), TEXTURED), &[square(), png].concat())
    }

    fn parse(bytes: &[u8]) -> Result<Mesh, MeshFileError> {
        parse_gltf(bytes, "g.glb", Unit::Metre, &no_resources)
    }

    #[test]
    fn binary_with_texture_and_a_mirroring_node() {
        let mesh = parse(&textured()).unwrap();
        assert_eq!(mesh.vertices()[1], Vec3::new(-1.0, 0.0, 2.0));
        // Mirroring reverses the order, so that the faces still face outwards.
        assert_eq!(mesh.faces(), [[0, 2, 1], [0, 3, 2]]);
        assert_eq!(mesh.texcoords().unwrap()[0], [0.0, 0.0], "v goes up");
        assert_eq!(mesh.texture().unwrap()[(1, 0)], [10, 200, 30]);
        assert!((mesh.vertex_normals()[0] - Vec3::z()).norm() < 1e-12);
        let small = parse_gltf(&textured(), "g.glb", Unit::Millimetre, &no_resources).unwrap();
        assert!((small.diameter() - 0.001 * 2f64.sqrt()).abs() < 1e-12);
    }

    #[test]
    fn text_with_a_file_beside_and_with_a_data_uri() {
        let png = png([255, 255, 255]);
        let factor = r#""baseColorTexture":{"index":0},"baseColorFactor":[0.5,1,0,1]"#;
        let bin = [square(), png.clone()].concat();
        let json = document(r#"{"mesh":0}"#, r#","uri":"the%20buffer.bin""#, png.len(), factor);
        let resources =
            |name: &str| if name == "the buffer.bin" { Ok(bin.clone()) } else { no_resources(name) };
        let mesh = parse_gltf(json.as_bytes(), "g.gltf", Unit::Metre, &resources).unwrap();
        // 0.5 linear is 188 in sRGB.
        assert_eq!(mesh.texture().unwrap()[(0, 0)], [188, 255, 0]);
        let json = document(r#"{"mesh":0}"#, r#","uri":"data:;base64,AAAA""#, 0, factor);
        let error = parse(json.as_bytes()).unwrap_err().to_string();
        assert!(error.contains("buffers[0]: expected 92 bytes, found 3 bytes"), "{error}");
        assert_eq!(from_base64("aGVsbG8=").unwrap(), b"hello");
        assert!(from_base64("a b").is_none());
    }

    #[test]
    fn a_factor_alone_becomes_vertex_colours() {
        let json = document(r#"{"mesh":0}"#, "", 0, r#""baseColorFactor":[0.5,1,0,1]"#);
        let mesh = parse(&glb(&json, &square())).unwrap();
        assert_eq!(mesh.colors().unwrap(), [[188, 255, 0]; 4]);
        assert!(mesh.texture().is_none() && mesh.texcoords().is_none());
    }

    #[test]
    fn files_with_wrong_counts_are_explained() {
        let json = document(MIRRORED, "", 0, "");
        let with = |from: &str, to: &str| {
            assert!(json.contains(from), "{from}");
            glb(&json.replacen(from, to, 1), &square())
        };
        let mut short_header = textured();
        short_header[12..16].copy_from_slice(&u32::MAX.to_le_bytes());
        for (bytes, names) in [
            (
                with(r#""count":4,"type":"VEC3""#, r#""count":4000000000,"type":"VEC3""#),
                ["POSITION", "4000000000 elements"],
            ),
            (
                with(r#""byteOffset":48"#, r#""byteOffset":18446744073709551615"#),
                ["TEXCOORD_0", "within the"],
            ),
            (with(r#""count":6"#, r#""count":7"#), ["indices", "7 elements"]),
            (with(r#""count":6"#, r#""count":0"#), ["", "expected"]),
            (with(r#""translation""#, r#""children":[0],"translation""#), ["nodes[0]", "tree"]),
            (with(r#""nodes":[0]"#, r#""nodes":[9]"#), ["document", "valid glTF"]),
            (with(r#""mesh":0,"#, ""), ["scene", "triangles"]),
            (with(r#""version":"2.0""#, r#""version":"2.0"#), ["document", "line"]),
            (short_header, ["chunk JSON", "4294967295 bytes"]),
            (b"glTF\x02\0\0\0\x03\0\0\0".to_vec(), ["chunk JSON", "the end of the file"]),
        ] {
            let error = parse(&bytes).unwrap_err().to_string();
            for name in names.iter().chain(&["g.glb"]) {
                assert!(error.contains(name), "{name} not in: {error}");
            }
        }
        let mut bad_index = square();
        bad_index[80] = 4;
        let error = parse(&glb(&json, &bad_index)).unwrap_err().to_string();
        assert!(error.contains("indices below 4, found 4"), "{error}");
    }

    proptest! {
        #[test]
        fn changed_files_never_panic(changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4),
                                     cut in any::<prop::sample::Index>()) {
            let mut bytes = textured();
            let _ = parse(&bytes[..cut.index(bytes.len())]);
            for (at, to) in changes {
                let at = at.index(bytes.len());
                bytes[at] = to;
            }
            let _ = parse(&bytes);
        }

        #[test]
        fn changed_numbers_never_panic(which in any::<prop::sample::Index>(), to in prop::sample::select(vec![
            "0", "1", "2", "3", "7", "-1", "255", "5121", "5125", "4294967295", "18446744073709551615", "1e300", "0.5"])) {
            let json = document(MIRRORED, "", 0, TEXTURED);
            // Replace one of the numbers of the document.
            let starts: Vec<usize> = (1..json.len())
                .filter(|&i| json.as_bytes()[i].is_ascii_digit() && b":[,".contains(&json.as_bytes()[i - 1]))
                .collect();
            let start = starts[which.index(starts.len())];
            let end = start + json[start..].bytes().take_while(u8::is_ascii_digit).count();
            let changed = format!("{}{to}{}", &json[..start], &json[end..]);
            let _ = parse(&glb(&changed, &square()));
        }
    }
}
