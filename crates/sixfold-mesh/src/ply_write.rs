//! Writing PLY: ascii for people, binary little endian (32 bit floats) for compact files.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use sixfold_geometry::RgbImage;

use crate::file::write_atomically;
use crate::{Mesh, MeshFileError, Unit};

/// The two forms of PLY that are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PlyFormat {
    /// Text; numbers with as many digits as a 32 bit float needs.
    Ascii,
    /// The compact form.
    BinaryLittleEndian,
}

/// Writes a mesh with its normals, colours and texture coordinates, lengths in `unit` as 32 bit floats. A
/// texture becomes a PNG beside the file, of the same name, which `comment TextureFile` names. Each file is
/// written under a temporary name and then renamed: readers get the old file or the new one, never a part.
///
/// # Errors
/// [`MeshFileError::Io`]; [`MeshFileError::Field`] when a coordinate does not fit a 32 bit float in `unit`.
pub fn write_ply(
    path: impl AsRef<Path>,
    mesh: &Mesh,
    unit: Unit,
    format: PlyFormat,
) -> Result<(), MeshFileError> {
    for (path, bytes) in ply_files(path, mesh, unit, format)? {
        write_atomically(&path, &bytes)?;
    }
    Ok(())
}

/// The files that [`write_ply`] writes, with their bytes: the texture first.
///
/// # Errors
/// As [`write_ply`].
pub fn ply_files(
    path: impl AsRef<Path>,
    mesh: &Mesh,
    unit: Unit,
    format: PlyFormat,
) -> Result<Vec<(PathBuf, Vec<u8>)>, MeshFileError> {
    let path = path.as_ref();
    let file = path.display().to_string();
    let largest = mesh.vertices().iter().fold(0.0f64, |m, v| m.max(v.amax())) / unit.to_metres();
    if largest > f64::from(f32::MAX) {
        let expected = format!("coordinates that fit a 32 bit float in {unit}");
        return Err(MeshFileError::field(&file, "element vertex", expected, format!("{largest:e}")));
    }
    let (mut files, mut texture_name) = (vec![], None);
    if let (Some(texture), Some(_)) = (mesh.texture(), mesh.texcoords()) {
        let texture_path = path.with_extension("png");
        let name = texture_path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let png = encode_png(texture).map_err(|error| MeshFileError::Io {
            file: texture_path.display().to_string(),
            source: std::io::Error::other(error),
        })?;
        files.push((texture_path, png));
        texture_name = Some(name);
    }
    files.push((path.to_owned(), ply_bytes(mesh, unit, format, texture_name.as_deref())));
    Ok(files)
}

fn encode_png(texture: &RgbImage) -> Result<Vec<u8>, image::ImageError> {
    let mut png = Vec::new();
    image::write_buffer_with_format(
        &mut Cursor::new(&mut png),
        texture.as_slice().as_flattened(),
        texture.width() as u32,
        texture.height() as u32,
        image::ExtendedColorType::Rgb8,
        image::ImageFormat::Png,
    )?;
    Ok(png)
}

/// The bytes of a PLY file; texture coordinates are written when `texture_name` is given, the name of the
/// texture beside the file.
pub fn ply_bytes(mesh: &Mesh, unit: Unit, format: PlyFormat, texture_name: Option<&str>) -> Vec<u8> {
    let texcoords = mesh.texcoords().filter(|_| texture_name.is_some());
    let mut header = String::from("ply\n");
    header += match format {
        PlyFormat::Ascii => "format ascii 1.0\n",
        PlyFormat::BinaryLittleEndian => "format binary_little_endian 1.0\n",
    };
    header += &format!("comment lengths in {unit}\n");
    if let (Some(name), Some(_)) = (texture_name, texcoords) {
        header += &format!("comment TextureFile {name}\n");
    }
    header += &format!("element vertex {}\n", mesh.vertices().len());
    let mut properties = |kind: &str, names: &[&str]| {
        for name in names {
            header += &format!("property {kind} {name}\n");
        }
    };
    properties("float", &["x", "y", "z"]);
    if mesh.normals().is_some() {
        properties("float", &["nx", "ny", "nz"]);
    }
    if mesh.colors().is_some() {
        properties("uchar", &["red", "green", "blue"]);
    }
    if texcoords.is_some() {
        properties("float", &["texture_u", "texture_v"]);
    }
    if !mesh.faces().is_empty() {
        header += &format!("element face {}\nproperty list uchar int vertex_indices\n", mesh.faces().len());
    }
    header += "end_header\n";
    let mut out = Writer { bytes: header.into_bytes(), format };
    let scale = unit.to_metres();
    for (index, vertex) in mesh.vertices().iter().enumerate() {
        out.floats(vertex.iter().map(|v| (v / scale) as f32));
        if let Some(normals) = mesh.normals() {
            out.floats(normals[index].iter().map(|v| *v as f32));
        }
        if let Some(colors) = mesh.colors() {
            colors[index].iter().for_each(|c| out.byte(*c));
        }
        if let Some(texcoords) = texcoords {
            out.floats(texcoords[index].iter().copied());
        }
        out.end_row();
    }
    for face in mesh.faces() {
        out.byte(3);
        face.iter().for_each(|index| out.index(*index));
        out.end_row();
    }
    out.bytes
}

struct Writer {
    bytes: Vec<u8>,
    format: PlyFormat,
}

impl Writer {
    fn word(&mut self, word: &impl ToString) {
        self.bytes.extend_from_slice(word.to_string().as_bytes());
        self.bytes.push(b' ');
    }

    fn floats(&mut self, values: impl Iterator<Item = f32>) {
        for value in values {
            match self.format {
                PlyFormat::Ascii => self.word(&value),
                PlyFormat::BinaryLittleEndian => self.bytes.extend_from_slice(&value.to_le_bytes()),
            }
        }
    }

    fn byte(&mut self, value: u8) {
        match self.format {
            PlyFormat::Ascii => self.word(&value),
            PlyFormat::BinaryLittleEndian => self.bytes.push(value),
        }
    }

    fn index(&mut self, value: u32) {
        match self.format {
            PlyFormat::Ascii => self.word(&value),
            PlyFormat::BinaryLittleEndian => self.bytes.extend_from_slice(&value.to_le_bytes()),
        }
    }

    fn end_row(&mut self) {
        if self.format == PlyFormat::Ascii {
            self.bytes.pop();
            self.bytes.push(b'\n');
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{no_resources, parse_ply, read_mesh};
    use proptest::prelude::*;
    use sixfold_geometry::Vec3;

    fn meshes() -> impl Strategy<Value = Mesh> {
        let point = prop::array::uniform3(-0.5..0.5f64);
        (1..40usize).prop_flat_map(move |n| {
            (
                prop::collection::vec(point.clone(), n),
                prop::collection::vec(prop::array::uniform3(0..n as u32), 0..60),
                prop::option::of(prop::collection::vec(point.clone(), n)),
                prop::option::of(prop::collection::vec(any::<[u8; 3]>(), n)),
                prop::option::of(prop::collection::vec(prop::array::uniform2(0.0..1.0f32), n)),
            )
                .prop_map(|(vertices, faces, normals, colors, texcoords)| {
                    let mut mesh = Mesh::new(vertices.into_iter().map(Vec3::from).collect(), faces).unwrap();
                    if let Some(normals) = normals {
                        let unit = |n| Vec3::from(n).try_normalize(1e-6).unwrap_or(Vec3::z());
                        mesh = mesh.with_normals(normals.into_iter().map(unit).collect()).unwrap();
                    }
                    if let Some(colors) = colors {
                        mesh = mesh.with_colors(colors).unwrap();
                    }
                    if let Some(texcoords) = texcoords {
                        let texture = RgbImage::from_fn(3, 2, |x, y| [x as u8, y as u8, 7]);
                        mesh = mesh.with_texture(texcoords, texture).unwrap();
                    }
                    mesh
                })
        })
    }

    fn assert_same(a: &Mesh, b: &Mesh) {
        assert_eq!(a.faces(), b.faces());
        assert_eq!(a.colors(), b.colors());
        assert_eq!(a.texcoords(), b.texcoords());
        assert_eq!(a.texture(), b.texture());
        assert_eq!(a.vertices().len(), b.vertices().len());
        assert!(a.vertices().iter().zip(b.vertices()).all(|(a, b)| (a - b).norm() < 1e-7));
        assert_eq!(a.normals().is_some(), b.normals().is_some());
        let normals = a.normals().unwrap_or_default().iter().zip(b.normals().unwrap_or_default());
        assert!(normals.into_iter().all(|(a, b)| (a - b).norm() < 1e-6));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn what_is_written_is_read(mesh in meshes(), ascii in any::<bool>(), millimetres in any::<bool>()) {
            let format = if ascii { PlyFormat::Ascii } else { PlyFormat::BinaryLittleEndian };
            let unit = if millimetres { Unit::Millimetre } else { Unit::Metre };
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("a mesh.PLY");
            write_ply(&path, &mesh, unit, format).unwrap();
            let back = crate::read_mesh_unchecked(&path, unit).unwrap();
            assert_same(&mesh, &back);
            let files = std::fs::read_dir(folder.path()).unwrap().count();
            prop_assert_eq!(files, 1 + usize::from(mesh.texture().is_some()));
        }

        #[test]
        fn changed_files_never_panic(mesh in meshes(), ascii in any::<bool>(), at in any::<prop::sample::Index>(),
                                     to in any::<u8>(), cut in any::<prop::sample::Index>()) {
            let format = if ascii { PlyFormat::Ascii } else { PlyFormat::BinaryLittleEndian };
            let mut bytes = ply_bytes(&mesh, Unit::Metre, format, None);
            let cut = cut.index(bytes.len());
            let parsed = parse_ply(&bytes[..cut], "x", Unit::Metre, &no_resources);
            // A text that is cut within its last number cannot be distinguished from a whole one.
            prop_assert!(parsed.is_err() || (ascii && cut + 16 > bytes.len()));
            let at = at.index(bytes.len());
            bytes[at] = to;
            let _ = parse_ply(&bytes, "x", Unit::Metre, &no_resources);
        }
    }

    #[test]
    fn a_folder_that_is_missing_is_named() {
        let mesh = Mesh::new(vec![Vec3::zeros(), Vec3::x()], vec![]).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("nowhere/x.ply");
        let error = write_ply(&path, &mesh, Unit::Metre, PlyFormat::Ascii).unwrap_err().to_string();
        assert!(error.contains("nowhere"), "{error}");
        assert!(matches!(read_mesh(&path, Unit::Metre), Err(MeshFileError::Io { .. })));
    }
}
