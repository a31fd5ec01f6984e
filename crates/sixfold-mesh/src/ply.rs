//! PLY, the Polygon File Format (Turk 1994): ascii and binary of both byte orders.
//!
//! We have our own parser, because the crates considered store every row of every element as a separate value
//! (with its property names compared as strings) and trust an element's count: `element x 4000000000` without
//! properties needs no bytes in a binary file, but a crate's array grows until memory is exhausted. Here a count
//! is checked against the bytes that are left before anything is allocated, rows are read directly into the
//! mesh's arrays, and an error names element, row and property.

use std::collections::HashMap;

use sixfold_geometry::Vec3;

use crate::file::load_texture;
use crate::mesh::Parts;
use crate::{Mesh, MeshFileError, Resources, Unit};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Encoding {
    Ascii,
    Little,
    Big,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Scalar::I8,
            "uchar" | "uint8" => Scalar::U8,
            "short" | "int16" => Scalar::I16,
            "ushort" | "uint16" => Scalar::U16,
            "int" | "int32" => Scalar::I32,
            "uint" | "uint32" => Scalar::U32,
            "float" | "float32" => Scalar::F32,
            "double" | "float64" => Scalar::F64,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::F64 => 8,
        }
    }

    fn is_float(self) -> bool {
        matches!(self, Scalar::F32 | Scalar::F64)
    }
}

#[derive(Debug)]
struct Property {
    name: String,
    /// The type of the length, for a list.
    count: Option<Scalar>,
    scalar: Scalar,
}

#[derive(Debug)]
struct Element {
    name: String,
    count: usize,
    properties: Vec<Property>,
}

impl Element {
    fn scalar(&self, names: &[&str]) -> Option<(usize, Scalar)> {
        let index =
            self.properties.iter().position(|p| p.count.is_none() && names.contains(&p.name.as_str()))?;
        Some((index, self.properties[index].scalar))
    }

    fn list(&self, names: &[&str]) -> Option<usize> {
        self.properties.iter().position(|p| p.count.is_some() && names.contains(&p.name.as_str()))
    }

    /// The minimum number of bytes of a row in the body.
    fn min_bytes(&self, encoding: Encoding) -> usize {
        match encoding {
            // A digit and a separator.
            Encoding::Ascii => 2 * self.properties.len(),
            _ => self.properties.iter().map(|p| p.count.unwrap_or(p.scalar).bytes()).sum(),
        }
    }
}

struct Header {
    encoding: Encoding,
    elements: Vec<Element>,
    texture: Option<String>,
    /// Start of the body in the bytes of the file.
    body: usize,
    /// Number of lines of the header.
    lines: usize,
}

/// Splits off a line that ends in `\n`, `\r\n` or `\r`; returns the line and the start of the next one.
fn split_line(bytes: &[u8], start: usize) -> Option<(&[u8], usize)> {
    let rest = bytes.get(start..).filter(|rest| !rest.is_empty())?;
    let end = rest.iter().position(|&b| b == b'\n' || b == b'\r').unwrap_or(rest.len());
    let ending = match rest.get(end..) {
        Some([b'\r', b'\n', ..]) => 2,
        Some([_, ..]) => 1,
        _ => 0,
    };
    Some((&rest[..end], start + end + ending))
}

fn parse_header(bytes: &[u8], file: &str) -> Result<Header, MeshFileError> {
    let mut encoding = None;
    let mut elements: Vec<Element> = Vec::new();
    let mut texture = None;
    let (mut at, mut lines) = (0, 0);
    loop {
        let Some((line, next)) = split_line(bytes, at) else {
            return Err(MeshFileError::field(file, "header", "a line end_header", "the end of the file"));
        };
        at = next;
        lines += 1;
        let line = String::from_utf8_lossy(line);
        let error = |expected: &str| {
            MeshFileError::field(
                file,
                format!("header line {lines}"),
                expected,
                format!("\"{}\"", excerpt(&line)),
            )
        };
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        if lines == 1 {
            if words != ["ply"] {
                return Err(error("\"ply\", the first word of every PLY file"));
            }
            continue;
        }
        match words.as_slice() {
            [] => {}
            ["end_header"] => break,
            ["comment", key, ..] if key.eq_ignore_ascii_case("TextureFile") => {
                // The name is everything after the key, since it may contain spaces.
                let name = line.split_once(*key).map_or("", |(_, rest)| rest).trim();
                if !name.is_empty() {
                    texture.get_or_insert_with(|| name.to_owned());
                }
            }
            ["comment" | "obj_info", ..] => {}
            ["format", kind, "1.0"] => {
                encoding = Some(match *kind {
                    "ascii" => Encoding::Ascii,
                    "binary_little_endian" => Encoding::Little,
                    "binary_big_endian" => Encoding::Big,
                    _ => return Err(error("format ascii, binary_little_endian or binary_big_endian")),
                });
            }
            ["element", name, count] => {
                let count = count.parse().map_err(|_| error("element NAME COUNT with a whole COUNT"))?;
                elements.push(Element { name: (*name).to_owned(), count, properties: Vec::new() });
            }
            ["property", rest @ ..] => {
                let element = elements.last_mut().ok_or_else(|| error("an element before its properties"))?;
                let (count, kind, name) = match rest {
                    ["list", count, kind, name] => {
                        let count = Scalar::from_name(count)
                            .filter(|c| !c.is_float())
                            .ok_or_else(|| error("an integer type for the length of the list"))?;
                        (Some(count), kind, name)
                    }
                    [kind, name] => (None, kind, name),
                    _ => return Err(error("property TYPE NAME or property list TYPE TYPE NAME")),
                };
                let scalar = Scalar::from_name(kind)
                    .ok_or_else(|| error("a type: char uchar short ushort int uint float double"))?;
                element.properties.push(Property { name: (*name).to_owned(), count, scalar });
            }
            _ => return Err(error("comment, format, element, property or end_header")),
        }
    }
    let encoding =
        encoding.ok_or_else(|| MeshFileError::field(file, "header", "a line format", "no such line"))?;
    Ok(Header { encoding, elements, texture, body: at, lines })
}

/// The first characters of a text, for messages.
pub(crate) fn excerpt(text: &str) -> String {
    shortened(text, 60)
}

/// A name in a file, for messages: long enough for any path.
pub(crate) fn shown_name(text: &str) -> String {
    shortened(text, 300)
}

/// At most `most` characters; control characters, which a terminal would execute, are replaced.
fn shortened(text: &str, most: usize) -> String {
    let shown = |c: char| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c };
    let mut short: String = text.chars().take(most).map(shown).collect();
    if text.chars().nth(most).is_some() {
        short.push_str("...");
    }
    short
}

/// Reads the numbers of the body in order; every number of a PLY type is exact in `f64`.
struct Body<'a> {
    bytes: &'a [u8],
    at: usize,
    encoding: Encoding,
    file: &'a str,
    line: usize,
}

impl<'a> Body<'a> {
    fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    fn error(
        &self,
        element: &Element,
        row: usize,
        property: &str,
        expected: &str,
        found: &str,
    ) -> MeshFileError {
        let line =
            if self.encoding == Encoding::Ascii { format!("line {}, ", self.line) } else { String::new() };
        MeshFileError::field(
            self.file,
            format!("{line}element {}, row {row} of {}, property {property}", element.name, element.count),
            expected,
            found,
        )
    }

    /// Goes to the next line that is not blank (ascii only).
    fn start_row(&mut self) {
        if self.encoding != Encoding::Ascii {
            return;
        }
        while let Some(&byte) = self.bytes.get(self.at) {
            match byte {
                b'\n' => self.line += 1,
                // Old Macintosh files end lines with \r alone.
                b'\r' if self.bytes.get(self.at + 1) != Some(&b'\n') => self.line += 1,
                b' ' | b'\t' | b'\r' => {}
                _ => break,
            }
            self.at += 1;
        }
    }

    /// The next word of this line; empty at its end.
    fn word(&mut self) -> &'a [u8] {
        let rest = &self.bytes[self.at..];
        let skip = rest.iter().take_while(|&&b| b == b' ' || b == b'\t').count();
        let length = rest[skip..].iter().take_while(|b| !b.is_ascii_whitespace()).count();
        self.at += skip + length;
        &rest[skip..skip + length]
    }

    fn value(
        &mut self,
        scalar: Scalar,
        element: &Element,
        row: usize,
        property: &str,
    ) -> Result<f64, MeshFileError> {
        if self.encoding == Encoding::Ascii {
            let word = self.word();
            return parse_number(word, scalar).ok_or_else(|| {
                let found = if word.is_empty() {
                    if self.left() == 0 {
                        "the end of the file".to_owned()
                    } else {
                        "the end of the line".to_owned()
                    }
                } else {
                    format!("\"{}\"", excerpt(&String::from_utf8_lossy(word)))
                };
                let expected = if scalar.is_float() { "a number" } else { "a whole number" };
                self.error(element, row, property, expected, &found)
            });
        }
        let size = scalar.bytes();
        let Some(raw) = self.bytes.get(self.at..self.at + size) else {
            return Err(self.error(
                element,
                row,
                property,
                &format!("{size} bytes"),
                &format!("{} bytes up to the end of the file", self.left()),
            ));
        };
        self.at += size;
        let mut native = [0u8; 8];
        native[..size].copy_from_slice(raw);
        if self.encoding == Encoding::Big {
            native[..size].reverse();
        }
        let [a, b, c, d, ..] = native;
        Ok(match scalar {
            Scalar::I8 => f64::from(a as i8),
            Scalar::U8 => f64::from(a),
            Scalar::I16 => f64::from(i16::from_le_bytes([a, b])),
            Scalar::U16 => f64::from(u16::from_le_bytes([a, b])),
            Scalar::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            Scalar::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            Scalar::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            Scalar::F64 => f64::from_le_bytes(native),
        })
    }

    /// Reads a list into `out`, which is emptied first.
    fn list(
        &mut self,
        property: &Property,
        count: Scalar,
        element: &Element,
        row: usize,
        out: &mut Vec<f64>,
    ) -> Result<(), MeshFileError> {
        out.clear();
        let length = self.value(count, element, row, &property.name)?;
        if length < 0.0 {
            return Err(self.error(
                element,
                row,
                &property.name,
                "a list length of zero or more",
                &length.to_string(),
            ));
        }
        // Values are read one by one, so reading with a wrong length stops at the end of the file.
        for _ in 0..length as u64 {
            out.push(self.value(property.scalar, element, row, &property.name)?);
        }
        Ok(())
    }

    /// Checks that a row is at its end (ascii only).
    fn end_row(&mut self, element: &Element, row: usize) -> Result<(), MeshFileError> {
        if self.encoding != Encoding::Ascii {
            return Ok(());
        }
        let word = self.word();
        if word.is_empty() {
            return Ok(());
        }
        let last = element.properties.last().map_or("", |p| p.name.as_str());
        let found = format!("\"{}\" behind it", excerpt(&String::from_utf8_lossy(word)));
        Err(self.error(element, row, last, "the end of the line", &found))
    }
}

/// A number in ascii; `float` values are rounded to 32 bit as a binary file would hold them.
fn parse_number(word: &[u8], scalar: Scalar) -> Option<f64> {
    if !scalar.is_float() && (1..=9).contains(&word.len()) && word.iter().all(u8::is_ascii_digit) {
        return Some(f64::from(word.iter().fold(0u32, |n, d| 10 * n + u32::from(d - b'0'))));
    }
    let text = std::str::from_utf8(word).ok()?;
    match scalar {
        Scalar::F64 => text.parse().ok(),
        Scalar::F32 => text.parse::<f32>().ok().map(f64::from),
        // Some writers print "255.0" for a uchar.
        _ => text.parse::<f64>().ok().filter(|v| v.fract() == 0.0),
    }
}

/// The columns of a vertex row that are kept.
const KEPT: [&[&str]; 11] = [
    &["x"],
    &["y"],
    &["z"],
    &["nx", "normal_x"],
    &["ny", "normal_y"],
    &["nz", "normal_z"],
    &["red", "r", "diffuse_red"],
    &["green", "g", "diffuse_green"],
    &["blue", "b", "diffuse_blue"],
    &["texture_u", "u", "s"],
    &["texture_v", "v", "t"],
];
const SKIPPED: usize = KEPT.len();

/// Reads a PLY mesh from the bytes of a file.
///
/// * vertices: `x y z`, times `unit`, in metres out;
/// * normals `nx ny nz`, normalised; where a normal is zero or not finite, it is computed from the faces around
///   it;
/// * colours `red green blue` (also `diffuse_red` ...): integers 0 to 255 (`ushort`: 0 to 65535), floats 0 to 1;
/// * texture coordinates per vertex (`texture_u texture_v`, `u v` or `s t`) or per face corner (list
///   `texcoord`; vertices are then split at the seams), kept when `comment TextureFile NAME` names a texture,
///   which is read through `resources`;
/// * polygons with more than three corners become triangle fans, faces with fewer are left out;
/// * all other properties and elements are skipped; a file without faces gives a point model.
///
/// # Errors
/// [`MeshFileError`]; `file` is the name in messages.
pub fn parse_ply(
    bytes: &[u8],
    file: &str,
    unit: Unit,
    resources: Resources<'_>,
) -> Result<Mesh, MeshFileError> {
    let header = parse_header(bytes, file)?;
    let mut body = Body { bytes, at: header.body, encoding: header.encoding, file, line: header.lines + 1 };
    let mut parts = Parts::default();
    let mut corner_texcoords: Vec<[[f32; 2]; 3]> = Vec::new();
    let mut seen_vertices = false;
    let mut list = Vec::new();
    for element in &header.elements {
        let minimum = element.min_bytes(header.encoding);
        // The last line may lack its end.
        let available = body.left() + usize::from(header.encoding == Encoding::Ascii);
        if element.count.checked_mul(minimum).is_none_or(|needed| needed > available) {
            return Err(MeshFileError::field(
                file,
                format!("element {}", element.name),
                format!("{} rows of at least {minimum} bytes each", element.count),
                format!("{} bytes up to the end of the file; it is cut off or its header lies", body.left()),
            ));
        }
        if minimum == 0 {
            continue;
        }
        match element.name.as_str() {
            "vertex" if !seen_vertices => {
                seen_vertices = true;
                read_vertices(&mut body, element, unit, &mut parts)?;
            }
            "face" => read_faces(&mut body, element, &mut parts, &mut corner_texcoords)?,
            "tristrips" if element.count > 0 => {
                return Err(MeshFileError::field(
                    file,
                    "element tristrips",
                    "triangles in an element face",
                    "triangle strips, which are not supported; save the mesh with triangles",
                ));
            }
            _ => {
                for row in 0..element.count {
                    body.start_row();
                    skip_row(&mut body, element, row, &mut list)?;
                    body.end_row(element, row)?;
                }
            }
        }
    }
    if parts.vertices.is_empty() {
        return Err(MeshFileError::field(file, "element vertex", "at least one vertex", "none"));
    }
    let vertices = parts.vertices.len();
    for (face, corners) in parts.faces.iter().enumerate() {
        if let Some(&found) = corners.iter().find(|&&i| i as usize >= vertices) {
            return Err(MeshFileError::field(
                file,
                format!("element face, triangle {face}"),
                format!("vertex indices below {vertices}"),
                found.to_string(),
            ));
        }
    }
    if !corner_texcoords.is_empty() {
        split_at_seams(&mut parts, &corner_texcoords);
    }
    match &header.texture {
        Some(name) if parts.texcoords.is_some() => {
            parts.texture = Some(load_texture(file, "comment TextureFile", name, resources)?);
        }
        _ => parts.texcoords = None,
    }
    parts.into_mesh(file)
}

fn skip_row(
    body: &mut Body<'_>,
    element: &Element,
    row: usize,
    list: &mut Vec<f64>,
) -> Result<(), MeshFileError> {
    for property in &element.properties {
        match property.count {
            Some(count) => body.list(property, count, element, row, list)?,
            None => {
                body.value(property.scalar, element, row, &property.name)?;
            }
        }
    }
    Ok(())
}

fn read_vertices(
    body: &mut Body<'_>,
    element: &Element,
    unit: Unit,
    parts: &mut Parts,
) -> Result<(), MeshFileError> {
    let columns = KEPT.map(|names| element.scalar(names));
    for (axis, column) in ["x", "y", "z"].iter().zip(&columns) {
        if column.is_none() {
            return Err(MeshFileError::field(
                body.file,
                "element vertex",
                "the properties x, y and z",
                format!("no property {axis}"),
            ));
        }
    }
    let has = |range: std::ops::Range<usize>| columns[range].iter().all(Option::is_some);
    let (has_normals, has_colors, has_texcoords) = (has(3..6), has(6..9), has(9..11));
    let mut slots = vec![SKIPPED; element.properties.len()];
    for (slot, column) in columns.iter().enumerate() {
        if let Some((index, _)) = column {
            slots[*index] = slot;
        }
    }
    let color_scale = match columns[6] {
        Some((_, Scalar::F32 | Scalar::F64)) => 255.0,
        Some((_, Scalar::U16)) => 1.0 / 257.0,
        _ => 1.0,
    };
    let scale = unit.to_metres();
    let n = element.count;
    parts.vertices.reserve_exact(n);
    let mut normals = Vec::with_capacity(if has_normals { n } else { 0 });
    let mut colors = Vec::with_capacity(if has_colors { n } else { 0 });
    let mut texcoords = Vec::with_capacity(if has_texcoords { n } else { 0 });
    let mut list = Vec::new();
    for row in 0..n {
        let mut v = [0.0; SKIPPED + 1];
        body.start_row();
        for (property, &slot) in element.properties.iter().zip(&slots) {
            match property.count {
                Some(count) => body.list(property, count, element, row, &mut list)?,
                None => v[slot] = body.value(property.scalar, element, row, &property.name)?,
            }
        }
        body.end_row(element, row)?;
        for (axis, value) in ["x", "y", "z"].iter().zip(&v) {
            if !value.is_finite() {
                return Err(body.error(element, row, axis, "a finite number", &value.to_string()));
            }
        }
        parts.vertices.push(Vec3::new(v[0] * scale, v[1] * scale, v[2] * scale));
        if has_normals {
            normals.push(Vec3::new(v[3], v[4], v[5]));
        }
        if has_colors {
            // The cast saturates and turns NaN into zero.
            colors.push([v[6], v[7], v[8]].map(|c| (c * color_scale).round() as u8));
        }
        if has_texcoords {
            for (value, name) in v[9..11].iter().zip(["u", "v"]) {
                if !(*value as f32).is_finite() {
                    let name = format!("texture {name}");
                    return Err(body.error(element, row, &name, "a finite number", &value.to_string()));
                }
            }
            texcoords.push([v[9] as f32, v[10] as f32]);
        }
    }
    parts.normals = has_normals.then_some(normals);
    parts.colors = has_colors.then_some(colors);
    parts.texcoords = has_texcoords.then_some(texcoords);
    Ok(())
}

fn read_faces(
    body: &mut Body<'_>,
    element: &Element,
    parts: &mut Parts,
    corner_texcoords: &mut Vec<[[f32; 2]; 3]>,
) -> Result<(), MeshFileError> {
    let indices_at = element.list(&["vertex_indices", "vertex_index"]);
    let texcoord_at = element.list(&["texcoord"]);
    let Some(indices_at) = indices_at else {
        return Err(MeshFileError::field(
            body.file,
            "element face",
            "a property list vertex_indices",
            "no such property",
        ));
    };
    parts.faces.reserve(element.count);
    let mut indices = Vec::new();
    let mut texcoords = Vec::new();
    let mut other = Vec::new();
    for row in 0..element.count {
        body.start_row();
        for (at, property) in element.properties.iter().enumerate() {
            let Some(count) = property.count else {
                body.value(property.scalar, element, row, &property.name)?;
                continue;
            };
            let out = if at == indices_at {
                &mut indices
            } else if Some(at) == texcoord_at {
                &mut texcoords
            } else {
                &mut other
            };
            body.list(property, count, element, row, out)?;
        }
        body.end_row(element, row)?;
        if let Some(found) = indices.iter().find(|i| !(0.0..=f64::from(u32::MAX)).contains(*i)) {
            let expected = "a vertex index of zero or more";
            return Err(body.error(element, row, "vertex_indices", expected, &found.to_string()));
        }
        if texcoord_at.is_some() {
            if texcoords.len() != 2 * indices.len() {
                let expected = format!("{} numbers, two for each corner", 2 * indices.len());
                return Err(body.error(element, row, "texcoord", &expected, &texcoords.len().to_string()));
            }
            if let Some(found) = texcoords.iter().find(|t| !(**t as f32).is_finite()) {
                return Err(body.error(element, row, "texcoord", "finite numbers", &found.to_string()));
            }
        }
        for corner in 2..indices.len() {
            let fan = [0, corner - 1, corner];
            parts.faces.push(fan.map(|i| indices[i] as u32));
            if texcoord_at.is_some() {
                corner_texcoords.push(fan.map(|i| [texcoords[2 * i] as f32, texcoords[2 * i + 1] as f32]));
            }
        }
    }
    Ok(())
}

/// Gives every vertex one texture coordinate: the first one stays with the vertex, and every other one gets a
/// copy of the vertex, appended at the end.
fn split_at_seams(parts: &mut Parts, corner_texcoords: &[[[f32; 2]; 3]]) {
    let mut texcoords: Vec<Option<[f32; 2]>> = vec![None; parts.vertices.len()];
    let mut copies: HashMap<(u32, [u32; 2]), u32> = HashMap::new();
    for (face, corners) in parts.faces.iter_mut().zip(corner_texcoords) {
        for (index, uv) in face.iter_mut().zip(corners) {
            let original = *index as usize;
            let first = *texcoords[original].get_or_insert(*uv);
            if first == *uv {
                continue;
            }
            *index = *copies.entry((*index, uv.map(f32::to_bits))).or_insert_with(|| {
                let copy = parts.vertices.len() as u32;
                parts.vertices.push(parts.vertices[original]);
                if let Some(normals) = &mut parts.normals {
                    normals.push(normals[original]);
                }
                if let Some(colors) = &mut parts.colors {
                    colors.push(colors[original]);
                }
                texcoords.push(Some(*uv));
                copy
            });
        }
    }
    parts.texcoords = Some(texcoords.into_iter().map(Option::unwrap_or_default).collect());
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::no_resources;
    use proptest::prelude::*;

    fn parse(bytes: &[u8]) -> Result<Mesh, MeshFileError> {
        parse_ply(bytes, "p.ply", Unit::Millimetre, &no_resources)
    }

    const SQUARE: &str = "ply\nformat ascii 1.0\ncomment made by hand\nobj_info nothing\nelement extra 1\n\
        property list uchar short words\nproperty char c\nelement vertex 4\nproperty double x\nproperty short y\n\
        property float z\nproperty float quality\nproperty list uchar int more\nproperty float nx\n\
        property float ny\nproperty float nz\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n\
        element face 2\nproperty uchar flags\nproperty list uchar uint vertex_index\nelement edge 1\n\
        property int a\nend_header\n\
        2 -7 8 1\n\
        0.5 0 0 9 0 0 0 2 1 2 3\n1 0 0 9 1 7 0 0 2 4 5 6\n\n1 1 0 9 2 7 7 nan 0 0 7 8 9\n0 1 0 9 0 0 0 0 255 0 0\n\
        0 4 0 1 2 3\n0 2 0 1\n5\n";

    #[test]
    fn unknown_parts_are_skipped_and_polygons_cut() {
        for text in [SQUARE.to_owned(), SQUARE.replace('\n', "\r\n"), SQUARE.replace('\n', "\r")] {
            let mesh = parse(text.as_bytes()).unwrap();
            assert_eq!(mesh.vertices()[0], Vec3::new(0.0005, 0.0, 0.0));
            assert_eq!(mesh.faces(), [[0, 1, 2], [0, 2, 3]]);
            assert_eq!(mesh.colors().unwrap()[2], [7, 8, 9]);
            // One normal is NaN and one is zero: both are computed from the faces.
            assert!(mesh.normals().unwrap().iter().all(|n| (n - Vec3::z()).norm() < 1e-12));
        }
    }

    /// A PLY of every scalar type, in either byte order.
    fn binary(big: bool) -> Vec<u8> {
        let order = if big { "big" } else { "little" };
        let mut bytes = format!(
            "ply\nformat binary_{order}_endian 1.0\nelement vertex 3\nproperty double x\nproperty int16 y\n\
             property float32 z\nproperty ushort red\nproperty ushort green\nproperty ushort blue\nproperty uint id\n\
             element face 1\nproperty list int uint16 vertex_indices\nend_header\n"
        )
        .into_bytes();
        let mut put = |little: &[u8]| {
            bytes.extend(little);
            if big {
                let start = bytes.len() - little.len();
                bytes[start..].reverse();
            }
        };
        for (x, y, z) in [(0.25f64, 0i16, 0.0f32), (1.0, -2, 0.5), (0.0, 300, 0.0)] {
            put(&x.to_le_bytes());
            put(&y.to_le_bytes());
            put(&z.to_le_bytes());
            for color in [65535u16, 257, 0] {
                put(&color.to_le_bytes());
            }
            put(&9u32.to_le_bytes());
        }
        put(&3i32.to_le_bytes());
        for index in [0u16, 1, 2] {
            put(&index.to_le_bytes());
        }
        bytes
    }

    #[test]
    fn both_byte_orders() {
        let little = parse(&binary(false)).unwrap();
        assert_eq!(little.vertices()[1] * 1e3, Vec3::new(1.0, -2.0, 0.5));
        assert_eq!(little.vertices()[2].y, 0.3);
        assert_eq!(little.colors().unwrap()[1], [255, 1, 0]);
        assert_eq!(little.faces(), [[0, 1, 2]]);
        assert_eq!(parse(&binary(true)).unwrap(), little);
    }

    #[test]
    fn colours_between_zero_and_one() {
        let text = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
            property float red\nproperty float green\nproperty float blue\nend_header\n0 0 0 1 0.5 7\n";
        assert_eq!(parse(text.as_bytes()).unwrap().colors().unwrap(), [[255, 128, 255]]);
    }

    #[test]
    fn seams_split_vertices() {
        let header = "ply\nformat ascii 1.0\ncomment TextureFile the picture.png\nelement vertex 4\n\
            property float x\nproperty float y\nproperty float z\nelement face 2\n\
            property list uchar int vertex_indices\nproperty list uchar float texcoord\nend_header\n\
            0 0 0\n1 0 0\n1 1 0\n0 1 0\n";
        let faces = "3 0 1 2 6 0 0 1 0 1 1\n3 0 2 3 6 0.5 0 1 1 0 1\n";
        let picture = |name: &str| {
            assert_eq!(name, "the picture.png");
            let mut png = std::io::Cursor::new(Vec::new());
            image::RgbImage::from_pixel(2, 1, image::Rgb([1, 2, 3]))
                .write_to(&mut png, image::ImageFormat::Png)
                .unwrap();
            Ok(png.into_inner())
        };
        let text = format!("{header}{faces}");
        let mesh = parse_ply(text.as_bytes(), "p.ply", Unit::Metre, &picture).unwrap();
        assert_eq!(mesh.faces(), [[0, 1, 2], [4, 2, 3]]);
        assert_eq!(mesh.vertices()[4], mesh.vertices()[0]);
        let expected = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 0.0]];
        assert_eq!(mesh.texcoords().unwrap(), expected);
        assert_eq!(mesh.texture().unwrap().as_slice(), [[1, 2, 3]; 2]);
        let error = parse(text.as_bytes()).unwrap_err().to_string();
        assert!(error.contains("comment TextureFile names \"the picture.png\""), "{error}");
    }

    #[test]
    fn files_with_wrong_counts_are_explained_without_allocation() {
        for (from, to, names) in [
            (
                "vertex 4",
                "vertex 4000000000",
                ["element vertex", "4000000000 rows", "cut off or its header lies"],
            ),
            ("vertex 4", "vertex -1", ["header line 8", "whole COUNT", "element vertex -1"]),
            // The first face is read as a fifth vertex and runs out of words.
            (
                "vertex 4",
                "vertex 5",
                ["element vertex, row 4 of 5, property more", "a whole number", "the end of the line"],
            ),
            (
                "1 1 0 9",
                "1 inf_ 0 9",
                ["line 30, element vertex, row 2 of 4, property y", "a whole number", "\"inf_\""],
            ),
            ("0.5 0 0", "nan 0 0", ["row 0 of 4, property x", "a finite number", "NaN"]),
            ("4 0 1 2 3", "4 0 1 2 -3", ["row 0 of 2, property vertex_indices", "zero or more", "-3"]),
            ("4 0 1 2 3", "4 0 1 2 4", ["element face, triangle 1", "below 4", "found 4"]),
            ("4 0 1 2 3", "-4 0 1 2 3", ["vertex_index", "list length of zero or more", "-4"]),
            (
                "4 0 1 2 3",
                "99 0 1 2 3",
                ["row 0 of 2, property vertex_index", "a whole number", "the end of the line"],
            ),
            (
                "4 0 1 2 3",
                "3 0 1 2 3",
                ["row 0 of 2, property vertex_index", "the end of the line", "\"3\" behind it"],
            ),
            ("ply\n", "PLY2\n", ["header line 1", "\"ply\"", "PLY2"]),
            ("ascii", "utf8", ["header line 2", "format ascii", "utf8"]),
            ("property double x", "property half x", ["header line 9", "a type", "half"]),
            ("property double x", "property double a", ["element vertex", "x, y and z", "no property x"]),
            ("vertex_index", "corners", ["element face", "vertex_indices", "no such property"]),
            ("end_header", "end", ["header line 25", "end_header", "\"end\""]),
        ] {
            assert!(SQUARE.contains(from), "{from}");
            let result = parse(SQUARE.replacen(from, to, 1).as_bytes());
            let error = result.unwrap_err().to_string();
            for name in names.iter().chain(&["p.ply"]) {
                assert!(error.contains(name), "{name} not in: {error}");
            }
        }
        let empty = "ply\nformat binary_little_endian 1.0\nelement nothing 4000000000\nelement vertex 0\n\
            property float x\nproperty float y\nproperty float z\nend_header\n";
        let error = parse(empty.as_bytes()).unwrap_err().to_string();
        assert!(error.contains("element vertex: expected at least one vertex"), "{error}");
        let mut list = binary(false);
        let at = list.len() - 10;
        list[at..at + 4].copy_from_slice(&i32::MAX.to_le_bytes());
        let error = parse(&list).unwrap_err().to_string();
        assert!(
            error.contains("row 0 of 1, property vertex_indices: expected 2 bytes, found 0 bytes"),
            "{error}"
        );
    }

    proptest! {
        #[test]
        fn bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            let _ = parse(&bytes);
            let _ = parse(&[b"ply\nformat binary_big_endian 1.0\n", bytes.as_slice()].concat());
        }

        #[test]
        fn words_never_panic(words in prop::collection::vec(prop::sample::select(vec![
            "element", "vertex", "face", "property", "list", "float", "uchar", "int", "x", "y", "z", "vertex_indices",
            "texcoord", "\n", "\n", "\n", "end_header\n", "0", "1", "3", "-1", "4000000000", "nan", "comment", "TextureFile"]), 0..120),
            binary in any::<bool>()) {
            let format = if binary { "binary_little_endian" } else { "ascii" };
            let _ = parse(format!("ply\nformat {format} 1.0\n{}", words.join(" ")).as_bytes());
        }

        #[test]
        fn changed_files_never_panic(kind in 0..3usize, changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4)) {
            let mut bytes = [SQUARE.as_bytes().to_vec(), binary(false), binary(true)][kind].clone();
            for (at, to) in changes {
                let at = at.index(bytes.len());
                bytes[at] = to;
            }
            let _ = parse(&bytes);
        }
    }
}
