//! The door for mesh files: format by ending, unit to metres, and the check for a wrong unit.

use std::fs;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

use sixfold_geometry::RgbImage;
use sixfold_io::{ImageFile, ImageFileError, write_atomically_with};

use crate::{Mesh, MeshFileError, Unit};

/// Smallest diameter that [`read_mesh`] takes without asking, in metres.
pub const SMALLEST_DIAMETER: f64 = 0.005;
/// Largest diameter that [`read_mesh`] takes without asking, in metres.
pub const LARGEST_DIAMETER: f64 = 5.0;

/// Gives the bytes of a file that a mesh file names (texture, material, buffer), by that name.
pub type Resources<'a> = &'a dyn Fn(&str) -> io::Result<Vec<u8>>;

/// The [`Resources`] of bytes that stand alone: every name is missing.
///
/// # Errors
/// Always [`io::ErrorKind::NotFound`].
pub fn no_resources(_name: &str) -> io::Result<Vec<u8>> {
    Err(io::Error::new(io::ErrorKind::NotFound, "no such file"))
}

/// Reads a mesh and tests its size: [`read_mesh_unchecked`], then [`check_size`].
///
/// The format follows from the ending (`.ply .obj .stl .gltf .glb .xyz`, upper or lower case). The vertices come
/// out in metres: the file's numbers times [`Unit::to_metres`]. glTF is in metres by its specification, and
/// `unit` multiplies all the same: give [`Unit::Metre`] for a file that keeps to it.
///
/// # Errors
/// [`MeshFileError`], naming file, field, what was expected and found; [`MeshFileError::Size`] for a diameter
/// outside 5 mm to 5 m.
pub fn read_mesh(path: impl AsRef<Path>, unit: Unit) -> Result<Mesh, MeshFileError> {
    let path = path.as_ref();
    let mesh = read_mesh_unchecked(path, unit)?;
    check_size(&mesh, &path.display().to_string(), unit)?;
    Ok(mesh)
}

/// Reads a mesh as [`read_mesh`] does, of whatever size.
///
/// # Errors
/// [`MeshFileError`], but never [`MeshFileError::Size`].
pub fn read_mesh_unchecked(path: impl AsRef<Path>, unit: Unit) -> Result<Mesh, MeshFileError> {
    let path = path.as_ref();
    let file = path.display().to_string();
    let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    let parse = match ending.as_str() {
        "ply" => crate::parse_ply,
        "obj" => crate::parse_obj,
        "stl" => crate::parse_stl,
        "gltf" | "glb" => crate::parse_gltf,
        "xyz" => crate::parse_xyz,
        _ => return Err(MeshFileError::Format { file, found: ending }),
    };
    let bytes = fs::read(path).map_err(|source| MeshFileError::Io { file: file.clone(), source })?;
    let folder = path.parent().map(Path::to_path_buf).unwrap_or_default();
    parse(&bytes, &file, unit, &|name| read_beside(&folder, name))
}

/// A named file relative to the mesh file's folder; a name that is a path of another machine is looked for
/// by its last part.
fn read_beside(folder: &Path, name: &str) -> io::Result<Vec<u8>> {
    let direct = folder.join(PathBuf::from(name.replace('\\', "/")));
    match fs::read(&direct) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            let last = name.rsplit(['/', '\\']).next().unwrap_or(name);
            fs::read(folder.join(last)).map_err(|_| error)
        }
        other => other,
    }
}

/// Tests that a mesh read with `unit` has a diameter between 5 mm and 5 m; the error states in which unit it
/// would have a sensible one.
///
/// # Errors
/// [`MeshFileError::Size`].
pub fn check_size(mesh: &Mesh, name: &str, unit: Unit) -> Result<(), MeshFileError> {
    let diameter = mesh.diameter();
    let sensible = SMALLEST_DIAMETER..=LARGEST_DIAMETER;
    if sensible.contains(&diameter) {
        return Ok(());
    }
    let in_file = diameter / unit.to_metres();
    let better: Vec<String> = Unit::ALL
        .into_iter()
        .filter(|u| sensible.contains(&(in_file * u.to_metres())))
        .map(|u| {
            format!("{} if the file is in {}: give --unit {u}", length(in_file * u.to_metres()), u.plural())
        })
        .collect();
    let advice = if diameter == 0.0 {
        "all vertices are the same point".to_owned()
    } else if better.is_empty() {
        "no unit (m, mm, cm, in) makes it an object between 5 mm and 5 m: check the file".to_owned()
    } else {
        better.join("; ")
    };
    Err(MeshFileError::Size {
        file: name.to_owned(),
        diameter,
        explanation: format!("the diameter would be {} as {}; {advice}", length(diameter), unit.plural()),
    })
}

/// A length as people say it.
fn length(metres: f64) -> String {
    if metres >= 1e6 || (metres > 0.0 && metres < 1e-6) {
        format!("{metres:.2e} m")
    } else if metres >= 1.0 {
        format!("{} m", significant(metres))
    } else {
        format!("{} mm", significant(metres * 1e3))
    }
}

/// Three significant digits, whole numbers in full.
fn significant(value: f64) -> String {
    if value >= 100.0 {
        format!("{value:.0}")
    } else if value >= 10.0 {
        format!("{value:.1}")
    } else {
        format!("{value:.3}")
    }
}

/// Decodes a PNG or JPEG texture, of at most so many pixels as any image.
pub(crate) fn decode_texture(bytes: &[u8]) -> Result<RgbImage, String> {
    ImageFile::of_bytes(Path::new("texture"), bytes).rgb().map_err(|error| match error {
        ImageFileError::Content { reason, .. } => reason,
        other => other.to_string(),
    })
}

/// Reads and decodes a texture that `field` of `file` names.
pub(crate) fn load_texture(
    file: &str,
    field: &str,
    named: &str,
    resources: Resources<'_>,
) -> Result<RgbImage, MeshFileError> {
    let error = |reason: String| MeshFileError::Named {
        file: file.to_owned(),
        field: field.to_owned(),
        named: named.to_owned(),
        reason,
    };
    let bytes = resources(named).map_err(|e| error(e.to_string()))?;
    decode_texture(&bytes).map_err(error)
}

/// Writes a file that nobody sees a part of, into a folder that is there already.
pub(crate) fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), MeshFileError> {
    write_atomically_with(path, |file| file.write_all(bytes))
        .map_err(|source| MeshFileError::Io { file: path.display().to_string(), source })
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::Vec3;

    fn two_points(distance: f64) -> Mesh {
        Mesh::new(vec![Vec3::zeros(), Vec3::x() * distance], vec![]).unwrap()
    }

    #[test]
    fn a_factor_of_a_thousand_is_explained() {
        let explain =
            |metres: f64, unit: Unit| check_size(&two_points(metres), "o.ply", unit).unwrap_err().to_string();
        assert_eq!(
            explain(102.1, Unit::Metre),
            "o.ply: the diameter would be 102 m as metres; 102 mm if the file is in millimetres: give --unit mm; \
             1.021 m if the file is in centimetres: give --unit cm; 2.593 m if the file is in inches: give --unit in"
        );
        assert_eq!(
            explain(0.000_125, Unit::Millimetre),
            "o.ply: the diameter would be 0.125 mm as millimetres; 125 mm if the file is in metres: give --unit m"
        );
        assert!(explain(1e9, Unit::Metre).contains("no unit"), "{}", explain(1e9, Unit::Metre));
        assert!(explain(0.0, Unit::Metre).contains("the same point"));
        for metres in [0.005, 0.1, 5.0] {
            check_size(&two_points(metres), "o.ply", Unit::Inch).unwrap();
        }
    }

    #[test]
    fn files_are_found_by_ending_and_beside() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("Thing.OBJ");
        fs::write(
            &path,
            "mtllib C:\\models\\thing.mtl\nv 0 0 0\nv 100 0 0\nv 0 100 0\nusemtl red\nf 1 2 3\n",
        )
        .unwrap();
        let error = read_mesh(&path, Unit::Millimetre).unwrap_err().to_string();
        assert!(error.contains("thing.mtl") && error.contains("Thing.OBJ"), "{error}");
        fs::write(folder.path().join("thing.mtl"), "newmtl red\nKd 1 0 0\n").unwrap();
        assert_eq!(read_mesh(&path, Unit::Millimetre).unwrap().colors().unwrap(), [[255, 0, 0]; 3]);
        let error = read_mesh(folder.path().join("a.step"), Unit::Metre).unwrap_err().to_string();
        assert!(
            error.contains("\"step\"") && error.contains(".ply, .obj, .stl, .gltf, .glb or .xyz"),
            "{error}"
        );
        let error = read_mesh(folder.path().join("a.stl"), Unit::Metre).unwrap_err();
        assert!(matches!(error, MeshFileError::Io { .. }), "{error}");
    }
}
