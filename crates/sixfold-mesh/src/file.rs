//! Entry point for mesh files: format by extension, conversion to metres, and the check for a wrong unit.

use std::cell::Cell;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use sixfold_geometry::RgbImage;
use sixfold_io::{ImageFile, ImageFileError, limits, read_regular, write_atomically_with};

use crate::ply::shown_name;
use crate::{Mesh, MeshFileError, Unit};

/// Smallest diameter that [`read_mesh`] accepts, in metres.
pub const SMALLEST_DIAMETER: f64 = 0.005;
/// Largest diameter that [`read_mesh`] accepts, in metres.
pub const LARGEST_DIAMETER: f64 = 5.0;

/// Largest distance of an object from the origin of its frame that [`read_mesh`] accepts, in metres: single precision still
/// resolves a tenth of a millimetre there.
pub const LARGEST_OFFSET: f64 = 1000.0;
/// Largest area that [`read_mesh`] accepts, in squares of the diameter; a mesh with more than this in squares of the longest side
/// of its bounding box is first freed of repeated faces. Objects with all their inner walls reach tens. Thousands of faces on top
/// of each other take minutes to render and are not an object.
pub const LARGEST_AREA: f64 = 1000.0;
/// Limit on the bytes of all files together that a mesh file refers to.
const MAX_NAMED: u64 = 4 << 30;

/// Options of [`read_mesh_with`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MeshOptions {
    /// Read textures, materials and buffers from any path in the mesh file, not only from its own folder and below. A mesh from an
    /// untrusted source could refer to any file of this machine.
    pub allow_outside: bool,
    /// Whether the size is checked, see [`check_size`].
    pub check_size: bool,
}

static ALLOW_OUTSIDE: AtomicBool = AtomicBool::new(false);

impl Default for MeshOptions {
    fn default() -> Self {
        MeshOptions { allow_outside: ALLOW_OUTSIDE.load(Ordering::Relaxed), check_size: true }
    }
}

impl MeshOptions {
    /// Makes [`MeshOptions::allow_outside`] the default in this process, also for meshes of datasets and stores. For programs
    /// whose user requests it.
    pub fn allow_outside_everywhere() {
        ALLOW_OUTSIDE.store(true, Ordering::Relaxed);
    }
}

/// Returns the bytes of a file that a mesh file refers to (texture, material, buffer), by its name there.
pub type Resources<'a> = &'a dyn Fn(&str) -> io::Result<Vec<u8>>;

/// The [`Resources`] for mesh data without other files: every name is missing.
///
/// # Errors
/// Always [`io::ErrorKind::NotFound`].
pub fn no_resources(_name: &str) -> io::Result<Vec<u8>> {
    Err(io::Error::new(io::ErrorKind::NotFound, "no such file"))
}

/// Reads a mesh and tests its size: [`read_mesh_with`] and the default options.
///
/// # Errors
/// As [`read_mesh_with`].
pub fn read_mesh(path: impl AsRef<Path>, unit: Unit) -> Result<Mesh, MeshFileError> {
    read_mesh_with(path, unit, &MeshOptions::default())
}

/// Reads a mesh as [`read_mesh`] does, without checking its size.
///
/// # Errors
/// [`MeshFileError`], but never [`MeshFileError::Size`].
pub fn read_mesh_unchecked(path: impl AsRef<Path>, unit: Unit) -> Result<Mesh, MeshFileError> {
    read_mesh_with(path, unit, &MeshOptions { check_size: false, ..MeshOptions::default() })
}

/// Reads a mesh.
///
/// The format follows from the extension (`.ply .obj .stl .gltf .glb .xyz`, upper or lower case). The vertices come out in metres:
/// the file's numbers times [`Unit::to_metres`]. glTF is in metres by its specification, but `unit` is applied to it too: give
/// [`Unit::Metre`] for a file that conforms. The file itself, and those that it refers to, have to be regular files. If the area
/// exceeds [`LARGEST_AREA`] because faces cover each other, repeated faces are removed.
///
/// # Errors
/// [`MeshFileError`], naming file, field, what was expected and found; [`MeshFileError::Size`] for a diameter
/// outside 5 mm to 5 m, for an object far from the origin and for an area above [`LARGEST_AREA`].
pub fn read_mesh_with(
    path: impl AsRef<Path>,
    unit: Unit,
    options: &MeshOptions,
) -> Result<Mesh, MeshFileError> {
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
    let bytes = read_regular(path, limits::MESH)
        .map_err(|source| MeshFileError::Io { file: file.clone(), source })?;
    let beside = Beside { mesh: path, allow_outside: options.allow_outside, read: Cell::new(0) };
    let mut mesh = parse(&bytes, &file, unit, &|name| beside.bytes(name))?;
    if options.check_size {
        let (low, high) = mesh.bounding_box();
        if mesh.surface_area() > LARGEST_AREA * (high - low).amax().powi(2) {
            mesh = mesh.without_repeated_faces();
        }
        check_size(&mesh, &file, unit)?;
    }
    Ok(mesh)
}

/// The files that a mesh file may refer to.
struct Beside<'a> {
    mesh: &'a Path,
    allow_outside: bool,
    /// Bytes read so far, since the same file can be referred to many times.
    read: Cell<u64>,
}

impl Beside<'_> {
    /// A named file relative to the mesh file's folder; an absolute path of another machine is searched for by its last component.
    fn bytes(&self, name: &str) -> io::Result<Vec<u8>> {
        let folder = self.mesh.parent().filter(|f| !f.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let direct = folder.join(PathBuf::from(name.replace('\\', "/")));
        match self.regular(&direct, folder) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                let last = name.rsplit(['/', '\\']).next().unwrap_or(name);
                let found = self.regular(&folder.join(last), folder);
                found.map_err(|e| if e.kind() == io::ErrorKind::NotFound { error } else { e })
            }
            other => other,
        }
    }

    fn regular(&self, path: &Path, folder: &Path) -> io::Result<Vec<u8>> {
        let real = path.canonicalize()?;
        // Where the mesh file is a link, its own folder counts as well.
        let within = |folder: io::Result<PathBuf>| folder.is_ok_and(|folder| real.starts_with(folder));
        let target =
            || self.mesh.canonicalize().map(|mesh| mesh.parent().map(Path::to_path_buf).unwrap_or(mesh));
        if !self.allow_outside && !within(folder.canonicalize()) && !within(target()) {
            let message = format!(
                "{} lies outside the mesh's folder and is not read unless --allow-outside is given",
                real.display()
            );
            return Err(io::Error::new(io::ErrorKind::PermissionDenied, message));
        }
        let bytes = read_regular(&real, limits::IMAGE)?;
        self.read.set(self.read.get() + bytes.len() as u64);
        if self.read.get() > MAX_NAMED {
            let message = format!("the files that it names have more than {} MB in all", MAX_NAMED >> 20);
            return Err(io::Error::new(io::ErrorKind::FileTooLarge, message));
        }
        Ok(bytes)
    }
}

/// Tests that a mesh read with `unit` has a diameter between 5 mm and 5 m (the error states in which unit it would have a sensible
/// one), lies within [`LARGEST_OFFSET`] of its origin and has no more than [`LARGEST_AREA`].
///
/// # Errors
/// [`MeshFileError::Size`].
pub fn check_size(mesh: &Mesh, name: &str, unit: Unit) -> Result<(), MeshFileError> {
    let diameter = mesh.diameter();
    let sensible = SMALLEST_DIAMETER..=LARGEST_DIAMETER;
    if sensible.contains(&diameter) {
        return check_place_and_area(mesh, name, diameter);
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

fn check_place_and_area(mesh: &Mesh, name: &str, diameter: f64) -> Result<(), MeshFileError> {
    let size = |explanation| Err(MeshFileError::Size { file: name.to_owned(), diameter, explanation });
    let (low, high) = mesh.bounding_box();
    let offset = low.abs().sup(&high.abs()).amax();
    if offset > LARGEST_OFFSET {
        return size(format!(
            "the object lies {} from the origin of its frame, expected up to {}: move its origin into the object",
            length(offset),
            length(LARGEST_OFFSET)
        ));
    }
    let area = mesh.surface_area() / diameter.powi(2);
    if area > LARGEST_AREA {
        return size(format!(
            "the faces cover each other: their area is {area:.0} times the square of the diameter, expected up to \
             {LARGEST_AREA}; remove faces that lie on or across each other"
        ));
    }
    Ok(())
}

/// A length in a readable unit.
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

/// Decodes a PNG or JPEG texture, with the same limit on pixels as for any image.
pub(crate) fn decode_texture(bytes: &[u8]) -> Result<RgbImage, String> {
    ImageFile::of_bytes(Path::new("texture"), bytes).rgb().map_err(|error| match error {
        ImageFileError::Content { reason, .. } => reason,
        other => other.to_string(),
    })
}

/// Reads and decodes a texture that `field` of `file` refers to.
pub(crate) fn load_texture(
    file: &str,
    field: &str,
    named: &str,
    resources: Resources<'_>,
) -> Result<RgbImage, MeshFileError> {
    let error = |reason: String| MeshFileError::Named {
        file: file.to_owned(),
        field: field.to_owned(),
        named: shown_name(named),
        reason,
    };
    let bytes = resources(named).map_err(|e| error(e.to_string()))?;
    decode_texture(&bytes).map_err(error)
}

/// Writes a file atomically into an existing folder.
pub(crate) fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), MeshFileError> {
    write_atomically_with(path, |file| file.write_all(bytes))
        .map_err(|source| MeshFileError::Io { file: path.display().to_string(), source })
}

#[cfg(test)]
mod tests {
    use std::fs;

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

    /// The result of reading a mesh with this content, as text.
    fn said(folder: &Path, name: &str, content: &str, options: &MeshOptions) -> String {
        let path = folder.join(name);
        fs::write(&path, content).unwrap();
        let read = read_mesh_with(&path, Unit::Metre, options);
        read.map_or_else(|e| e.to_string(), |mesh| format!("read {} faces", mesh.faces().len()))
    }

    const NAMING_OBJ: &str = "mtllib NAMED\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl red\nf 1 2 3\n";
    const NAMING_PLY: &str = "ply\nformat ascii 1.0\ncomment TextureFile NAMED\nelement vertex 3\nproperty float x\n\
        property float y\nproperty float z\nproperty float u\nproperty float v\nelement face 1\n\
        property list uchar int vertex_indices\nend_header\n0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n";
    const NAMING_GLTF: &str = r#"{"asset":{"version":"2.0"},"nodes":[{"mesh":0}],"meshes":[{"primitives":[
        {"attributes":{"POSITION":0}}]}],"accessors":[{"bufferView":0,"componentType":5126,"count":3,"type":"VEC3",
        "min":[0,0,0],"max":[1,1,0]}],"bufferViews":[{"buffer":0,"byteLength":36}],
        "buffers":[{"byteLength":36,"uri":"NAMED"}]}"#;

    #[cfg(unix)]
    #[test]
    fn a_mesh_that_names_any_file_of_the_machine_reads_none_outside_its_folder() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("meshes");
        fs::create_dir_all(folder.join("below")).unwrap();
        let mut png = io::Cursor::new(Vec::new());
        image::RgbImage::new(2, 2).write_to(&mut png, image::ImageFormat::Png).unwrap();
        let three: Vec<u8> =
            [0f32, 0., 0., 1., 0., 0., 0., 1., 0.].iter().flat_map(|v| v.to_le_bytes()).collect();
        let content = |kind: &str| match kind {
            "obj" => b"newmtl red\nKd 1 0 0\n".to_vec(),
            "ply" => png.get_ref().clone(),
            _ => three.clone(),
        };
        let strict = MeshOptions { allow_outside: false, check_size: true };
        let open = MeshOptions { allow_outside: true, ..strict };
        for (kind, template) in [("obj", NAMING_OBJ), ("ply", NAMING_PLY), ("gltf", NAMING_GLTF)] {
            let name = format!("m.{kind}");
            let with =
                |named: &str, options| said(&folder, &name, &template.replace("NAMED", named), options);
            let outside = root.path().join(format!("secret-{kind}"));
            for place in [&outside, &folder.join("below/beside"), &folder.join("beside")] {
                fs::write(place, content(kind)).unwrap();
            }
            let link = folder.join(format!("link-{kind}"));
            std::os::unix::fs::symlink(&outside, &link).unwrap();
            for named in
                ["beside", "below/beside", "./below/../beside", &folder.join("beside").to_string_lossy()]
            {
                assert_eq!(with(named, &strict), "read 1 faces", "{kind} {named}");
            }
            let linked = format!("link-{kind}");
            let above = format!("../secret-{kind}");
            for named in [&above, &linked, &*outside.to_string_lossy()] {
                let message = with(named, &strict);
                for part in [&name, named, "--allow-outside", &format!("secret-{kind} lies outside")] {
                    assert!(message.contains(part), "{kind} {named}: {message}");
                }
                assert_eq!(with(named, &open), "read 1 faces", "{kind} {named}");
            }
            assert!(with("/dev/zero", &strict).contains("--allow-outside"));
            assert!(with("/dev/zero", &open).contains("found a device"));
            let pipe = folder.join(format!("pipe-{kind}"));
            assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
            let message = with(&format!("pipe-{kind}"), &strict);
            assert!(message.contains("found a pipe, expected a regular file"), "{message}");
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_mesh_file_that_is_no_regular_file_is_refused() {
        let root = tempfile::tempdir().unwrap();
        let pipe = root.path().join("pipe.ply");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let zeros = root.path().join("zeros.stl");
        std::os::unix::fs::symlink("/dev/zero", &zeros).unwrap();
        let folder = root.path().join("folder.obj");
        fs::create_dir(&folder).unwrap();
        for (path, found) in [(&pipe, "a pipe"), (&zeros, "a device"), (&folder, "a folder")] {
            let message = read_mesh(path, Unit::Metre).unwrap_err().to_string();
            assert!(message.contains(found) && message.contains("expected a regular file"), "{message}");
        }
    }

    #[test]
    fn a_library_that_is_named_without_end_and_a_thousand_materials_take_no_time() {
        let root = tempfile::tempdir().unwrap();
        fs::write(root.path().join("m.mtl"), "newmtl red\nKd 1 0 0\n").unwrap();
        let mut text = "mtllib m.mtl\n".repeat(1000) + "v 0 0 0\nv 1 0 0\nv 0 1 0\n";
        // With a linear search in a list, these took a minute.
        (0..60_000).for_each(|k| text += &format!("usemtl material-{k}\nf 1 2 3\n"));
        let start = std::time::Instant::now();
        let options = MeshOptions { allow_outside: false, check_size: false };
        assert_eq!(said(root.path(), "m.obj", &text, &options), "read 60000 faces");
        assert!(start.elapsed().as_secs() < 10, "{:?}", start.elapsed());
    }

    #[test]
    fn degenerate_objects_are_explained_at_once() {
        let explain = |points: Vec<Vec3>, faces: Vec<[u32; 3]>| {
            let start = std::time::Instant::now();
            let said = check_size(&Mesh::new(points, faces).unwrap(), "o.ply", Unit::Metre);
            assert!(start.elapsed().as_secs() < 20, "{:?}", start.elapsed());
            said.map_err(|e| e.to_string())
        };
        assert!(explain(vec![Vec3::x(); 400_000], vec![]).unwrap_err().contains("the same point"));
        let two = |k: u32| if k.is_multiple_of(2) { Vec3::zeros() } else { Vec3::x() };
        explain((0..400_000).map(two).collect(), vec![]).unwrap();
        // Nearly equal points at two places: all their pairs are nearly equally long.
        let nearly = |k: u32| two(k) + Vec3::new(0.0, f64::from(k / 2) * 1e-13, 0.0);
        explain((0..400_000).map(nearly).collect(), vec![]).unwrap();
        explain((0..400_000).map(|k| Vec3::x() * (f64::from(k) / 4e5)).collect(), vec![]).unwrap();
        assert!(
            explain(vec![Vec3::repeat(1e30), -Vec3::repeat(1e30)], vec![]).unwrap_err().contains("no unit")
        );
        assert!(explain(vec![Vec3::repeat(f64::MAX), -Vec3::repeat(f64::MAX)], vec![]).is_err());
        let far = explain(vec![Vec3::x() * 1e6, Vec3::x() * 1e6 + Vec3::y()], vec![]).unwrap_err();
        assert!(far.contains("1e6 m") || far.contains("from the origin"), "{far}");
        let corners = vec![Vec3::zeros(), Vec3::x(), Vec3::y()];
        let covered = explain(corners, vec![[0, 1, 2]; 200_000]).unwrap_err();
        assert!(covered.contains("cover each other"), "{covered}");
    }

    #[test]
    fn faces_that_are_there_two_hundred_thousand_times_are_read_once() {
        let root = tempfile::tempdir().unwrap();
        let text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 4\n".to_owned()
            + &"f 1 2 3\nf 3 1 2\n".repeat(100_000);
        assert_eq!(said(root.path(), "m.obj", &text, &MeshOptions::default()), "read 2 faces");
        // A few repeated faces are kept.
        let few = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 3 2 1\n";
        assert_eq!(said(root.path(), "m.obj", few, &MeshOptions::default()), "read 2 faces");
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
