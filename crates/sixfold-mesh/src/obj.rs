//! Wavefront OBJ with its MTL materials.
//!
//! We have our own parser: tobj 4.0.5, tried first, returns a texture array of another length than the vertices for
//! `f 1 2/1 3`, refuses a file in which only some vertices have a colour, and its errors do not state the line.

use std::collections::HashMap;

use sixfold_geometry::Vec3;

use crate::file::load_texture;
use crate::mesh::Parts;
use crate::paint::{MAX_PIXELS, Paint, apply};
use crate::ply::{excerpt, shown_name};
use crate::{Mesh, MeshFileError, Resources, Unit};

/// The colour of a material without one: MTL's default, 0.8.
const PLAIN: [u8; 3] = [204; 3];

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Corner {
    vertex: usize,
    texcoord: Option<usize>,
    normal: Option<usize>,
    material: usize,
}

#[derive(Debug, Clone, Default)]
struct ObjMaterial {
    color: Option<[u8; 3]>,
    /// The name of the texture and the line that gives it.
    texture: Option<(String, String)>,
}

/// The place that a message states.
struct Line<'a> {
    file: &'a str,
    number: usize,
}

impl Line<'_> {
    fn error(&self, keyword: &str, expected: impl Into<String>, found: impl Into<String>) -> MeshFileError {
        MeshFileError::field(self.file, format!("line {}, {keyword}", self.number), expected, found)
    }

    fn numbers<const N: usize>(&self, keyword: &str, words: &[&str]) -> Result<[f64; N], MeshFileError> {
        let mut numbers = [0.0; N];
        for (index, number) in numbers.iter_mut().enumerate() {
            let Some(word) = words.get(index) else {
                return Err(self.error(keyword, format!("{N} numbers"), format!("{} words", words.len())));
            };
            *number =
                word.parse().ok().filter(|n: &f64| n.is_finite()).ok_or_else(|| {
                    self.error(keyword, "a finite number", format!("\"{}\"", excerpt(word)))
                })?;
        }
        Ok(numbers)
    }

    /// An index in OBJ's form: from 1 at the start, from -1 at the end.
    fn index(&self, word: &str, count: usize, what: &str) -> Result<usize, MeshFileError> {
        let found = word.parse::<i64>().ok();
        let index = match found {
            Some(n) if n > 0 => usize::try_from(n - 1).ok(),
            Some(n) if n < 0 => usize::try_from(n.unsigned_abs()).ok().and_then(|n| count.checked_sub(n)),
            _ => None,
        };
        index.filter(|i| *i < count).ok_or_else(|| {
            let expected = format!("a {what} index from 1 to {count} (or -1 to -{count})");
            self.error("f", expected, format!("\"{}\"", excerpt(word)))
        })
    }
}

/// The lines of a text, with lines that end in a backslash joined to the next; returns number and text.
fn lines(text: &str) -> impl Iterator<Item = (usize, String)> + '_ {
    let mut source = text.lines().enumerate();
    std::iter::from_fn(move || {
        let (number, first) = source.next()?;
        let mut line = first.to_owned();
        while line.ends_with('\\') {
            line.pop();
            line.push(' ');
            line.push_str(source.next().map_or("", |(_, next)| next));
        }
        Some((number + 1, line))
    })
}

/// Reads an OBJ mesh from the bytes of a file.
///
/// * vertices `v x y z`, times `unit`; `v x y z r g b` with colours from 0 to 1;
/// * `vt` and `vn`; a vertex used with several of them is split;
/// * faces `f` with indices from either end; polygons become triangle fans; without faces: a point model. With
///   faces, vertices that no face uses are left out;
/// * `mtllib` and `usemtl`: `map_Kd` textures (with which `Kd` is not multiplied) and `Kd` colours. One texture on
///   all faces stays as it is; if there are only colours, they become vertex colours; anything else is stacked into
///   one texture. A material that no `mtllib` defines is grey (0.8).
///
/// # Errors
/// [`MeshFileError`] with the line; also when a named material or texture file is missing ([`MeshFileError::Named`]).
/// `file` is the name in messages.
pub fn parse_obj(
    bytes: &[u8],
    file: &str,
    unit: Unit,
    resources: Resources<'_>,
) -> Result<Mesh, MeshFileError> {
    let text = String::from_utf8_lossy(bytes);
    let scale = unit.to_metres();
    let mut vertices: Vec<Vec3> = Vec::new();
    let mut colors: Vec<Option<[u8; 3]>> = Vec::new();
    let mut texcoords: Vec<[f32; 2]> = Vec::new();
    let mut normals: Vec<Vec3> = Vec::new();
    let mut library: HashMap<String, ObjMaterial> = HashMap::new();
    let mut has_library = false;
    let mut names: Vec<String> = vec![String::new()];
    let mut number_of: HashMap<String, usize> = HashMap::from([(String::new(), 0)]);
    let mut material = 0;
    let mut corners: HashMap<Corner, u32> = HashMap::new();
    let mut order: Vec<Corner> = Vec::new();
    let mut faces: Vec<[u32; 3]> = Vec::new();
    let mut face_materials: Vec<usize> = Vec::new();
    let mut polygon: Vec<u32> = Vec::new();
    for (number, line) in lines(&text) {
        let at = Line { file, number };
        let line = line.split('#').next().unwrap_or("").trim();
        let (keyword, rest) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
        let rest = rest.trim();
        let words = || rest.split_ascii_whitespace().collect::<Vec<&str>>();
        match keyword {
            "v" => {
                let words = words();
                vertices.push(Vec3::from(at.numbers::<3>("v", &words)?) * scale);
                let color = if words.len() >= 6 { Some(at.numbers::<3>("v", &words[3..])?) } else { None };
                colors.push(color.map(|c| c.map(to_byte)));
            }
            "vt" => {
                let words = words();
                let u = at.numbers::<1>("vt", &words)?[0];
                let v = if words.len() > 1 { at.numbers::<1>("vt", &words[1..])?[0] } else { 0.0 };
                let uv = [u as f32, v as f32];
                if !uv.iter().all(|c| c.is_finite()) {
                    return Err(at.error("vt", "numbers that fit 32 bit", excerpt(rest)));
                }
                texcoords.push(uv);
            }
            "vn" => normals.push(Vec3::from(at.numbers::<3>("vn", &words())?)),
            "f" => {
                polygon.clear();
                for word in rest.split_ascii_whitespace() {
                    let mut parts = word.split('/');
                    let vertex = at.index(parts.next().unwrap_or(""), vertices.len(), "vertex")?;
                    let mut optional = |count, what| match parts.next() {
                        None | Some("") => Ok(None),
                        Some(word) => at.index(word, count, what).map(Some),
                    };
                    let texcoord = optional(texcoords.len(), "texture coordinate")?;
                    let normal = optional(normals.len(), "normal")?;
                    let corner = Corner { vertex, texcoord, normal, material };
                    polygon.push(*corners.entry(corner).or_insert_with(|| {
                        order.push(corner);
                        (order.len() - 1) as u32
                    }));
                }
                if polygon.len() < 3 {
                    let found = format!("{} in \"{}\"", polygon.len(), excerpt(line));
                    return Err(at.error("f", "three corners or more", found));
                }
                for corner in 2..polygon.len() {
                    faces.push([polygon[0], polygon[corner - 1], polygon[corner]]);
                    face_materials.push(material);
                }
            }
            "usemtl" => {
                material = *number_of.entry(rest.to_owned()).or_insert_with(|| {
                    names.push(rest.to_owned());
                    names.len() - 1
                });
            }
            "mtllib" => {
                has_library = true;
                read_library(rest, &at, resources, &mut library)?;
            }
            _ => {}
        }
    }
    if vertices.is_empty() {
        return Err(MeshFileError::field(file, "vertices", "at least one line v x y z", "none"));
    }
    if faces.is_empty() {
        order = (0..vertices.len())
            .map(|vertex| Corner { vertex, texcoord: None, normal: None, material: 0 })
            .collect();
    }
    let any_color = order.iter().any(|c| colors[c.vertex].is_some());
    let mut parts = Parts {
        vertices: order.iter().map(|c| vertices[c.vertex]).collect(),
        faces,
        normals: order.iter().any(|c| c.normal.is_some()).then(|| {
            // A corner without a normal gets the normal of the faces around it.
            order.iter().map(|c| c.normal.map_or(Vec3::zeros(), |n| normals[n])).collect()
        }),
        colors: any_color.then(|| order.iter().map(|c| colors[c.vertex].unwrap_or([128; 3])).collect()),
        texcoords: order
            .iter()
            .any(|c| c.texcoord.is_some())
            .then(|| order.iter().map(|c| c.texcoord.map_or([0.0; 2], |t| texcoords[t])).collect()),
        texture: None,
    };
    if has_library && !parts.faces.is_empty() {
        let (mut paints, mut pixels) = (Vec::new(), 0);
        let mut used = vec![false; names.len()];
        face_materials.iter().for_each(|&material| used[material] = true);
        for (name, used) in names.iter().zip(used) {
            let material = library.get(name).cloned().unwrap_or_default();
            paints.push(match material.texture {
                Some((texture, field)) if used && parts.texcoords.is_some() => {
                    let texture = load_texture(file, &field, &texture, resources)?;
                    pixels += texture.as_slice().len();
                    if pixels > MAX_PIXELS {
                        let expected = format!("at most {MAX_PIXELS} pixels in all");
                        return Err(MeshFileError::field(file, field, expected, "more"));
                    }
                    Paint::Texture(texture)
                }
                _ => Paint::Color(material.color.unwrap_or(PLAIN)),
            });
        }
        apply(&mut parts, &face_materials, paints, file)?;
    }
    parts.into_mesh(file)
}

fn to_byte(value: f64) -> u8 {
    (value * 255.0).round() as u8
}

/// Reads the files of a `mtllib` line: one name, which may hold spaces, or several.
fn read_library(
    rest: &str,
    at: &Line<'_>,
    resources: Resources<'_>,
    library: &mut HashMap<String, ObjMaterial>,
) -> Result<(), MeshFileError> {
    let named = |name: &str, error: std::io::Error| MeshFileError::Named {
        file: at.file.to_owned(),
        field: format!("line {}, mtllib", at.number),
        named: shown_name(name),
        reason: error.to_string(),
    };
    match resources(rest) {
        Ok(bytes) => parse_library(&bytes, rest, library),
        Err(error) => {
            let names: Vec<&str> = rest.split_ascii_whitespace().collect();
            if names.len() < 2 {
                return Err(named(rest, error));
            }
            for name in names {
                parse_library(&resources(name).map_err(|error| named(name, error))?, name, library)?;
            }
            Ok(())
        }
    }
}

fn parse_library(
    bytes: &[u8],
    file: &str,
    library: &mut HashMap<String, ObjMaterial>,
) -> Result<(), MeshFileError> {
    let text = String::from_utf8_lossy(bytes);
    let mut current: Option<String> = None;
    for (number, line) in lines(&text) {
        let at = Line { file, number };
        let line = line.trim();
        let (keyword, rest) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
        let rest = rest.trim();
        if keyword == "newmtl" {
            library.insert(rest.to_owned(), ObjMaterial::default());
            current = Some(rest.to_owned());
            continue;
        }
        let Some(material) = current.as_ref().and_then(|name| library.get_mut(name)) else { continue };
        match keyword {
            "Kd" => {
                let words: Vec<&str> = rest.split_ascii_whitespace().collect();
                // `Kd spectral FILE` and `Kd xyz ...` are left out.
                if words.first().is_some_and(|w| w.parse::<f64>().is_ok()) {
                    material.color = Some(at.numbers::<3>("Kd", &words)?.map(to_byte));
                }
            }
            "map_Kd" => {
                let name = without_options(rest);
                if !name.is_empty() {
                    material.texture = Some((name, format!("{file} line {number}, map_Kd")));
                }
            }
            _ => {}
        }
    }
    Ok(())
}

/// The file name of a texture line: the rest of the line after options such as `-s 1 1 1` and `-clamp on`.
fn without_options(rest: &str) -> String {
    let mut words: Vec<&str> = rest.split_ascii_whitespace().collect();
    while words.len() > 1 && words[0].starts_with('-') {
        let count = match words[0] {
            "-mm" => 2,
            "-o" | "-s" | "-t" => {
                words[1..].iter().take(3).take_while(|word| word.parse::<f64>().is_ok()).count()
            }
            _ => 1,
        };
        words.drain(..(1 + count).min(words.len() - 1));
    }
    words.join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::no_resources;
    use proptest::prelude::*;
    use std::io;

    const QUAD: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 2\n";

    fn parse(text: &str) -> Result<Mesh, MeshFileError> {
        parse_obj(text.as_bytes(), "q.obj", Unit::Metre, &no_resources)
    }

    /// A PNG of two by two pixels of one colour.
    fn png(color: [u8; 3]) -> Vec<u8> {
        let mut bytes = io::Cursor::new(Vec::new());
        image::RgbImage::from_pixel(2, 2, image::Rgb(color))
            .write_to(&mut bytes, image::ImageFormat::Png)
            .unwrap();
        bytes.into_inner()
    }

    fn beside(name: &str) -> io::Result<Vec<u8>> {
        match name {
            "m.mtl" => Ok(b"newmtl red\nKd 1 0 0\nnewmtl a\nmap_Kd -s 1 1 1 -clamp on tex a.png\nnewmtl b\nmap_Kd b.png\nnewmtl lost\nmap_Kd lost.png".to_vec()),
            "tex a.png" => Ok(png([10, 20, 30])),
            "b.png" => Ok(png([200, 100, 50])),
            _ => no_resources(name),
        }
    }

    #[test]
    fn polygons_and_indices_from_both_ends() {
        let mesh = parse(&format!("{QUAD}f 1//1 2//1 3//1 4//1\nf -4 -3 -2\n")).unwrap();
        assert_eq!(mesh.faces(), [[0, 1, 2], [0, 2, 3], [4, 5, 6]]);
        assert_eq!(mesh.vertices()[4], mesh.vertices()[0]);
        assert!(mesh.normals().unwrap().iter().all(|n| *n == Vec3::z()));
        let points = parse("v 1 2 3 1 0 0.5\nv 4 5 6\n").unwrap();
        assert_eq!(points.colors().unwrap(), [[255, 0, 128], [128, 128, 128]]);
    }

    #[test]
    fn seams_split_and_missing_corners_stay_aligned() {
        let mesh = parse_obj(
            format!("mtllib m.mtl\nusemtl a\n{QUAD}f 1/1 2/2 3/3\nf 1/2 3 4/4\n").as_bytes(),
            "q.obj",
            Unit::Metre,
            &beside,
        )
        .unwrap();
        assert_eq!(mesh.faces(), [[0, 1, 2], [3, 4, 5]]);
        let expected = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0], [0.0, 1.0]];
        assert_eq!(mesh.texcoords().unwrap(), expected);
        assert_eq!(mesh.texture().unwrap()[(1, 1)], [10, 20, 30]);
    }

    #[test]
    fn colours_alone_become_vertex_colours() {
        let text = format!("mtllib m.mtl\nusemtl red\n{QUAD}f 1 2 3\nusemtl unknown\nf 1 3 4\n");
        let mesh = parse_obj(text.as_bytes(), "q.obj", Unit::Metre, &beside).unwrap();
        let (red, plain) = ([255, 0, 0], PLAIN);
        assert_eq!(mesh.colors().unwrap(), [red, red, red, plain, plain, plain]);
        assert!(mesh.texture().is_none());
    }

    #[test]
    fn several_materials_are_stacked_in_one_texture() {
        let text = format!(
            "mtllib m.mtl\n{QUAD}usemtl a\nf 1/1 2/2 3/3\nusemtl b\nf 1/1 3/3 4/4\nusemtl red\nf 1 2 4\n"
        );
        let mesh = parse_obj(text.as_bytes(), "q.obj", Unit::Metre, &beside).unwrap();
        let texture = mesh.texture().unwrap();
        for (face, color) in [[10, 20, 30], [200, 100, 50], [255, 0, 0]].into_iter().enumerate() {
            let corners = mesh.faces()[face].map(|v| mesh.texcoords().unwrap()[v as usize]);
            // The centre of the face, and points close to its corners.
            for weights in [[0.34, 0.33, 0.33], [0.9, 0.05, 0.05], [0.05, 0.9, 0.05], [0.05, 0.05, 0.9]] {
                let uv = [0, 1].map(|k| corners.iter().zip(weights).map(|(c, w)| c[k] * w).sum::<f32>());
                let x = (uv[0] * texture.width() as f32) as usize;
                let y = ((1.0 - uv[1]) * texture.height() as f32) as usize;
                assert_eq!(texture[(x.min(texture.width() - 1), y)], color, "face {face}");
            }
        }
    }

    #[test]
    fn errors_name_the_line() {
        for (text, names) in [
            ("v 1 2\n", ["line 1, v", "3 numbers", "2 words"]),
            ("v 1 2 nan\n", ["line 1, v", "finite", "nan"]),
            ("v 0 0 0\nf 1 1 2\n", ["line 2, f", "from 1 to 1", "\"2\""]),
            ("v 0 0 0\nf 1 1 -2\n", ["line 2, f", "-1 to -1", "\"-2\""]),
            ("v 0 0 0\nf 0 1 1\n", ["line 2, f", "vertex index", "\"0\""]),
            ("v 0 0 0\nf 1/1 1 1\n", ["line 2, f", "texture coordinate", "\"1\""]),
            ("v 0 0 0\nf 1 1\n", ["line 2, f", "three corners", "2 in"]),
            ("v 0 0 0\nmtllib gone.mtl\n", ["line 2, mtllib", "gone.mtl", "put that file beside"]),
            ("# nothing\n", ["vertices", "at least one", "none"]),
        ] {
            let error = parse(text).unwrap_err().to_string();
            for name in names.iter().chain(&["q.obj"]) {
                assert!(error.contains(name), "{name} not in: {error}");
            }
        }
        let text = format!("mtllib m.mtl\n{QUAD}usemtl lost\nf 1/1 2/2 3/3\n");
        let error = parse_obj(text.as_bytes(), "q.obj", Unit::Metre, &beside).unwrap_err().to_string();
        assert!(error.contains("lost.png") && error.contains("m.mtl line 8, map_Kd"), "{error}");
    }

    proptest! {
        #[test]
        fn words_never_panic(words in prop::collection::vec(prop::sample::select(vec![
            "v", "vt", "vn", "f", "usemtl", "mtllib", "\n", "\n", "1", "-1", "2/1", "1//1", "3/4/5", "a", "nan",
            "1e308", "99999999999999999999", "\\\n", "#", "m.mtl", "0", "/", "//"]), 0..80)) {
            let _ = parse_obj(words.join(" ").as_bytes(), "x", Unit::Inch, &beside);
        }

        #[test]
        fn changed_files_never_panic(at in any::<prop::sample::Index>(), to in any::<u8>()) {
            let text = format!("mtllib m.mtl\nusemtl a\n{QUAD}f 1/1 2/2 3/3\nusemtl b\nf 1/2 3 4/4\n");
            let mut bytes = text.into_bytes();
            let at = at.index(bytes.len());
            bytes[at] = to;
            let _ = parse_obj(&bytes, "x", Unit::Inch, &beside);
        }
    }
}
