//! STL, ascii and binary.
//!
//! We have our own reader of 50-byte records and `vertex` lines: stl_io 0.11.0 reads a binary file whose
//! header text starts with "solid" as ascii (several CAD programs write such files), and its errors do not
//! state the place.

use std::collections::HashMap;

use sixfold_geometry::Vec3;

use crate::mesh::Parts;
use crate::ply::excerpt;
use crate::{Mesh, MeshFileError, Resources, Unit};

const HEADER: usize = 84;
const RECORD: usize = 50;

/// Collects triangles and gives corners at the same place the same vertex.
#[derive(Default)]
struct Corners {
    parts: Parts,
    seen: HashMap<[u32; 3], u32>,
    scale: f64,
}

impl Corners {
    fn add(&mut self, triangle: [[f32; 3]; 3]) {
        let face = triangle.map(|corner| {
            // Adding zero turns -0 into 0.
            *self.seen.entry(corner.map(|c| (c + 0.0).to_bits())).or_insert_with(|| {
                self.parts.vertices.push(Vec3::from(corner.map(f64::from)) * self.scale);
                (self.parts.vertices.len() - 1) as u32
            })
        });
        self.parts.faces.push(face);
    }
}

/// Reads an STL mesh, ascii or binary, from the bytes of a file: triangles whose corners lie at exactly the
/// same place share vertices; coordinates times `unit`. The facets' normals are not used: the order of the
/// corners gives the same information. `resources` is not used.
///
/// # Errors
/// [`MeshFileError`] with the line or the triangle; `file` is the name in messages.
pub fn parse_stl(
    bytes: &[u8],
    file: &str,
    unit: Unit,
    _resources: Resources<'_>,
) -> Result<Mesh, MeshFileError> {
    let mut corners = Corners { scale: unit.to_metres(), ..Corners::default() };
    let count = bytes.get(80..HEADER).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize);
    let fits = count.is_some_and(|n| n.checked_mul(RECORD).is_some_and(|n| n == bytes.len() - HEADER));
    let start = bytes.trim_ascii_start();
    let says_ascii = start.get(..5).is_some_and(|word| word.eq_ignore_ascii_case(b"solid"));
    if says_ascii && !fits {
        read_ascii(bytes, file, &mut corners)?;
    } else {
        read_binary(bytes, file, count, &mut corners)?;
    }
    if corners.parts.faces.is_empty() {
        return Err(MeshFileError::field(file, "triangles", "at least one", "none"));
    }
    corners.parts.into_mesh(file)
}

fn read_binary(
    bytes: &[u8],
    file: &str,
    count: Option<usize>,
    corners: &mut Corners,
) -> Result<(), MeshFileError> {
    let Some(count) = count else {
        let found = format!("{} bytes", bytes.len());
        return Err(MeshFileError::field(file, "header", "the word solid, or 84 bytes of header", found));
    };
    let body = &bytes[HEADER..];
    if count.checked_mul(RECORD).is_none_or(|needed| needed > body.len()) {
        return Err(MeshFileError::field(
            file,
            "triangle count",
            format!("at most {} triangles, as the file has bytes for", body.len() / RECORD),
            format!("{count}; the file is cut off or no STL"),
        ));
    }
    for (index, record) in body.chunks_exact(RECORD).take(count).enumerate() {
        let number =
            |at: usize| f32::from_le_bytes([record[at], record[at + 1], record[at + 2], record[at + 3]]);
        let triangle = [12, 24, 36].map(|at| [number(at), number(at + 4), number(at + 8)]);
        if let Some(found) = triangle.as_flattened().iter().find(|c| !c.is_finite()) {
            let field = format!("triangle {index} of {count}");
            return Err(MeshFileError::field(file, field, "finite numbers", found.to_string()));
        }
        corners.add(triangle);
    }
    Ok(())
}

fn read_ascii(bytes: &[u8], file: &str, corners: &mut Corners) -> Result<(), MeshFileError> {
    let text = String::from_utf8_lossy(bytes);
    let mut loop_corners: Vec<[f32; 3]> = Vec::with_capacity(3);
    let mut ended = false;
    for (number, line) in text.lines().enumerate() {
        let error = |expected: &str| {
            let field = format!("line {}", number + 1);
            MeshFileError::field(file, field, expected, format!("\"{}\"", excerpt(line.trim())))
        };
        let mut words = line.split_ascii_whitespace();
        let Some(keyword) = words.next() else { continue };
        match keyword.to_ascii_lowercase().as_str() {
            "vertex" => {
                let mut corner = [0.0f32; 3];
                for value in &mut corner {
                    *value = words
                        .next()
                        .and_then(|word| word.parse().ok())
                        .filter(|v: &f32| v.is_finite())
                        .ok_or_else(|| error("vertex and three finite numbers"))?;
                }
                loop_corners.push(corner);
            }
            "endloop" => {
                let triangle = <[[f32; 3]; 3]>::try_from(loop_corners.as_slice())
                    .map_err(|_| error("endloop after three vertex lines"))?;
                corners.add(triangle);
                loop_corners.clear();
            }
            "endsolid" => ended = true,
            // A file may hold several solids.
            "solid" => ended = false,
            "facet" | "outer" | "endfacet" => {}
            _ => return Err(error("solid, facet, outer loop, vertex, endloop, endfacet or endsolid")),
        }
    }
    if ended && loop_corners.is_empty() {
        return Ok(());
    }
    Err(MeshFileError::field(file, "end", "endsolid", "the end of the file; it is cut off"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::no_resources;
    use proptest::prelude::*;

    const TWO: &str = "solid two\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 1 1 0\n\
        endloop\nendfacet\nfacet normal 0 0 1\nouter loop\nvertex -0 0 0\nvertex 1 1 0\nvertex 0 1 0\nendloop\n\
        endfacet\nendsolid two\n";

    fn parse(bytes: &[u8]) -> Result<Mesh, MeshFileError> {
        parse_stl(bytes, "s.stl", Unit::Millimetre, &no_resources)
    }

    fn binary(text: &[u8; 80]) -> Vec<u8> {
        let mut bytes = text.to_vec();
        bytes.extend(2u32.to_le_bytes());
        for triangle in [[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]] {
            bytes.extend([0; 12]);
            for value in triangle.as_flattened() {
                bytes.extend((*value as f32).to_le_bytes());
            }
            bytes.extend([0; 2]);
        }
        bytes
    }

    #[test]
    fn both_forms_give_the_same_merged_mesh() {
        let ascii = parse(TWO.as_bytes()).unwrap();
        assert_eq!(ascii.faces(), [[0, 1, 2], [0, 2, 3]]);
        assert_eq!(ascii.vertices()[2], Vec3::new(0.001, 0.001, 0.0));
        assert_eq!(parse(&binary(&[b' '; 80])).unwrap(), ascii);
        // Some programs start the header text of a binary file with "solid".
        let mut text = [b' '; 80];
        text[..5].copy_from_slice(b"solid");
        assert_eq!(parse(&binary(&text)).unwrap(), ascii);
    }

    #[test]
    fn files_with_wrong_counts_are_explained() {
        let mut wrong_count = binary(&[b' '; 80]);
        wrong_count[80..84].copy_from_slice(&4_000_000_000u32.to_le_bytes());
        let mut nan = binary(&[b' '; 80]);
        nan[84 + 12..84 + 16].copy_from_slice(&f32::NAN.to_le_bytes());
        for (bytes, names) in [
            (wrong_count, ["triangle count", "at most 2", "4000000000"]),
            (nan, ["triangle 0 of 2", "finite", "NaN"]),
            (vec![0; 30], ["header", "84 bytes", "30 bytes"]),
            (TWO.replace("1 1 0", "1 x 0").into_bytes(), ["line 6", "three finite", "vertex 1 x 0"]),
            (TWO.replace("vertex 1 0 0\n", "").into_bytes(), ["line 6", "three vertex lines", "endloop"]),
            (TWO.replace("endsolid two", "").into_bytes(), ["end", "endsolid", "cut off"]),
            (b"solid\nendsolid".to_vec(), ["triangles", "at least one", "none"]),
        ] {
            let error = parse(&bytes).unwrap_err().to_string();
            for name in names.iter().chain(&["s.stl"]) {
                assert!(error.contains(name), "{name} not in: {error}");
            }
        }
    }

    proptest! {
        #[test]
        fn changed_files_never_panic(ascii in any::<bool>(), at in any::<prop::sample::Index>(), to in any::<u8>(),
                                     cut in any::<prop::sample::Index>()) {
            let mut bytes = if ascii { TWO.as_bytes().to_vec() } else { binary(&[b' '; 80]) };
            let cut = cut.index(bytes.len());
            prop_assert!(parse(&bytes[..cut]).is_err() || (ascii && cut + 5 >= bytes.len()));
            let at = at.index(bytes.len());
            bytes[at] = to;
            let _ = parse(&bytes);
        }
    }
}
