//! The description of an object on disk, in the object's folder, so that the renderings of [`ObjectModel::new`] are computed once.
//!
//! Little-endian: magic, format version, a hash of mesh and options, the simplified mesh, the samples with the views in which they
//! are visible, and a checksum. The feature table is not stored: it is twenty times as large and is built from the samples in a
//! tenth of a second.

use std::io;
use std::path::{Path, PathBuf};

use sixfold_align::could_be_simplified;
use sixfold_geometry::{PointCloud, Pose, Vec3};
use sixfold_io::{Fnv1a, fnv1a, limits, read_regular, write_atomically};
use sixfold_mesh::Mesh;
use thiserror::Error;

use crate::model::{Description, MAX_SAMPLES, MIN_SAMPLES, ModelError, ModelOptions, ObjectModel};

/// Largest difference between a length in the file and that of the mesh, as a fraction of the diameter: rounding errors.
const SAME_LENGTH: f64 = 1e-9;
/// Largest deviation of a normal's length from 1.
const SAME_NORMAL: f64 = 1e-6;

const MAGIC: &[u8; 8] = b"SIXFPPF\0";
const VERSION: u32 = 1;

/// Why a stored description was not used; it is then recomputed.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ModelFileError {
    /// The file cannot be read or written.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The file is not a description, has another version, or is damaged.
    #[error("{path}: {what}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: &'static str,
    },
    /// It was made from another mesh or with other options.
    #[error("{path}: made from another mesh or with other options")]
    Stale {
        /// The file.
        path: PathBuf,
    },
    /// No model can be made from the mesh itself.
    #[error(transparent)]
    Model(#[from] ModelError),
}

impl ObjectModel {
    /// The model of `mesh`: its description is read from `path` if the file belongs to this mesh and these options, otherwise
    /// computed and written there. The second value says why an existing file was not used or the new one could not be written.
    ///
    /// # Errors
    /// [`ModelError`] as [`ObjectModel::new`].
    pub fn cached(
        path: &Path,
        mesh: &Mesh,
        symmetries: &[Pose],
        options: &ModelOptions,
    ) -> Result<(ObjectModel, Option<ModelFileError>), ModelError> {
        options.check()?;
        let key = fingerprint(mesh, options);
        let mut note = None;
        match read(path, key, mesh, options) {
            Ok(description) => return Ok((ObjectModel::assemble(description, symmetries), None)),
            Err(ModelFileError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => {}
            Err(error) => note = Some(error),
        }
        let model = ObjectModel::new(mesh, symmetries, options)?;
        if let Err(error) = write(path, key, &model) {
            note = Some(error);
        }
        Ok((model, note))
    }
}

/// FNV-1a over everything on which the description depends.
fn fingerprint(mesh: &Mesh, options: &ModelOptions) -> u64 {
    let mut hash = Fnv1a::default();
    hash.write(&options.sampling_step.to_le_bytes());
    hash.write(&(options.angle_steps as u64).to_le_bytes());
    for v in mesh.vertices() {
        for c in v.iter() {
            hash.write(&c.to_le_bytes());
        }
    }
    for f in mesh.faces() {
        for i in f {
            hash.write(&i.to_le_bytes());
        }
    }
    hash.value()
}

fn write(path: &Path, key: u64, model: &ObjectModel) -> Result<(), ModelFileError> {
    let mut out = Vec::new();
    out.extend_from_slice(MAGIC);
    out.extend_from_slice(&VERSION.to_le_bytes());
    out.extend_from_slice(&key.to_le_bytes());
    out.extend_from_slice(&model.diameter.to_le_bytes());
    let vector = |out: &mut Vec<u8>, v: &Vec3| v.iter().for_each(|c| out.extend_from_slice(&c.to_le_bytes()));
    vector(&mut out, &model.centre);
    out.extend_from_slice(&(model.mesh.vertices().len() as u32).to_le_bytes());
    out.extend_from_slice(&(model.mesh.faces().len() as u32).to_le_bytes());
    out.extend_from_slice(&(model.samples.len() as u32).to_le_bytes());
    model.mesh.vertices().iter().for_each(|v| vector(&mut out, v));
    for i in model.mesh.faces().iter().flatten() {
        out.extend_from_slice(&i.to_le_bytes());
    }
    model.samples.points.iter().for_each(|v| vector(&mut out, v));
    model.samples.normals.iter().for_each(|v| vector(&mut out, v));
    for v in &model.visible_from {
        out.extend_from_slice(&v.to_le_bytes());
    }
    let sum = fnv1a(&out);
    out.extend_from_slice(&sum.to_le_bytes());
    write_atomically(path, &out).map_err(|source| ModelFileError::Io { path: path.to_path_buf(), source })
}

fn read(path: &Path, key: u64, mesh: &Mesh, options: &ModelOptions) -> Result<Description, ModelFileError> {
    let bytes = read_regular(path, limits::DERIVED)
        .map_err(|source| ModelFileError::Io { path: path.to_path_buf(), source })?;
    let damaged = |what| ModelFileError::Damaged { path: path.to_path_buf(), what };
    if bytes.len() < 20 || &bytes[..8] != MAGIC {
        return Err(damaged("no description of an object"));
    }
    let (body, sum) = bytes.split_at(bytes.len() - 8);
    if fnv1a(body).to_le_bytes() != sum {
        return Err(damaged("the checksum does not match: the file is damaged or cut off"));
    }
    let mut reader = Reader { bytes: &body[8..] };
    let short = || damaged("the file is too short");
    if reader.u32().ok_or_else(short)? != VERSION {
        return Err(damaged("written by another version"));
    }
    if reader.u64().ok_or_else(short)? != key {
        return Err(ModelFileError::Stale { path: path.to_path_buf() });
    }
    let mut rest = || -> Option<Description> {
        let diameter = reader.f64()?;
        let centre = reader.vector()?;
        let (vertices, faces, samples) =
            (reader.u32()? as usize, reader.u32()? as usize, reader.u32()? as usize);
        // The sizes must match the remaining bytes exactly; checked before anything is allocated.
        let needed = vertices.checked_mul(24)?.checked_add(faces.checked_mul(12)?)?;
        if reader.bytes.len() != needed.checked_add(samples.checked_mul(56)?)? {
            return None;
        }
        let vertices = (0..vertices).map(|_| reader.vector()).collect::<Option<Vec<_>>>()?;
        let faces = (0..faces)
            .map(|_| Some([reader.u32()?, reader.u32()?, reader.u32()?]))
            .collect::<Option<Vec<_>>>()?;
        let points = (0..samples).map(|_| reader.vector()).collect::<Option<Vec<_>>>()?;
        let normals = (0..samples).map(|_| reader.vector()).collect::<Option<Vec<_>>>()?;
        let visible_from = (0..samples).map(|_| reader.u64()).collect::<Option<Vec<_>>>()?;
        let mesh = Mesh::new(vertices, faces).ok()?;
        Some(Description {
            mesh,
            options: *options,
            diameter,
            centre,
            samples: PointCloud { points, normals },
            visible_from,
        })
    };
    let description = rest().ok_or_else(|| damaged("its parts do not fit together"))?;
    check(&description, mesh).map_err(damaged)?;
    Ok(description)
}

/// Checks every field against the mesh: a checksum detects accidental damage, not forgery, and an invalid value would later cause a
/// wrong pose, a panic or the use of all memory.
fn check(found: &Description, mesh: &Mesh) -> Result<(), &'static str> {
    let (low, high) = mesh.bounding_box();
    let (diameter, centre) = (mesh.diameter(), (low + high) * 0.5);
    let same = |a: f64, b: f64| (a - b).abs() <= SAME_LENGTH * diameter;
    let samples = &found.samples;
    let near = |p: &Vec3| (p - centre).norm() <= diameter;
    if !same(found.diameter, diameter) {
        return Err("field diameter: not that of the mesh");
    }
    if !(0..3).all(|k| same(found.centre[k], centre[k])) {
        return Err("field centre: not that of the mesh");
    }
    if !could_be_simplified(&found.mesh, mesh) {
        return Err("field mesh: not the simplified mesh");
    }
    if !(MIN_SAMPLES..=MAX_SAMPLES).contains(&samples.len()) {
        return Err("field samples: too few or too many");
    }
    if !samples.points.iter().all(near) {
        return Err("field samples: a point that is not on the object");
    }
    if !samples.normals.iter().all(|n| (n.norm() - 1.0).abs() <= SAME_NORMAL) {
        return Err("field normals: a normal has length zero or is not finite");
    }
    if found.visible_from.contains(&0) {
        return Err("field visible_from: a sample that no view sees");
    }
    Ok(())
}

struct Reader<'a> {
    bytes: &'a [u8],
}

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (head, tail) = self.bytes.split_first_chunk::<N>()?;
        self.bytes = tail;
        Some(*head)
    }
    fn u32(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }
    fn u64(&mut self) -> Option<u64> {
        self.take().map(u64::from_le_bytes)
    }
    fn f64(&mut self) -> Option<f64> {
        self.take().map(f64::from_le_bytes)
    }
    fn vector(&mut self) -> Option<Vec3> {
        Some(Vec3::new(self.f64()?, self.f64()?, self.f64()?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tetrahedron() -> Mesh {
        let corners = vec![Vec3::zeros(), Vec3::x() * 0.05, Vec3::y() * 0.05, Vec3::z() * 0.05];
        Mesh::new(corners, vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]).unwrap()
    }

    /// Descriptions that claim to be intact, of this version and of this mesh: earlier they caused an index panic, an allocation of
    /// 97 GB or an endless loop.
    #[test]
    fn a_forged_description_is_made_again_with_a_note_that_names_the_field() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("ppf.bin");
        let (mesh, options) = (tetrahedron(), ModelOptions { sampling_step: 0.2, ..ModelOptions::default() });
        let key = fingerprint(&mesh, &options);
        let honest = ObjectModel::new(&mesh, &[], &options).unwrap();
        write(&path, key, &honest).unwrap();
        let (read_back, note) = ObjectModel::cached(&path, &mesh, &[], &options).unwrap();
        assert!(note.is_none() && read_back.table == honest.table);
        type Forge = fn(&mut ObjectModel);
        let forgeries: [(&str, Forge); 12] = [
            ("diameter", |m| m.diameter = f64::NAN),
            ("diameter", |m| m.diameter = 0.0),
            ("diameter", |m| m.diameter *= 1000.0),
            ("centre", |m| m.centre.x = f64::INFINITY),
            ("mesh", |m| m.mesh = m.mesh.scaled(50.0)),
            ("mesh", |m| m.mesh = Mesh::new(m.mesh.vertices().to_vec(), vec![]).unwrap()),
            ("samples", |m| m.samples.points[3].y = f64::NAN),
            ("samples", |m| m.samples.points[3].y = 1e30),
            ("samples", |m| {
                m.samples.points = vec![m.samples.points[0]; 20_000];
                m.samples.normals = vec![m.samples.normals[0]; 20_000];
                m.visible_from = vec![u64::MAX; 20_000];
            }),
            ("samples", |m| {
                m.samples = PointCloud::default();
                m.visible_from.clear();
            }),
            ("normals", |m| m.samples.normals[2] = Vec3::repeat(f64::NAN)),
            ("visible_from", |m| m.visible_from[1] = 0),
        ];
        for (field, forge) in forgeries {
            let mut forged = honest.clone();
            forge(&mut forged);
            write(&path, key, &forged).unwrap();
            let (model, note) = ObjectModel::cached(&path, &mesh, &[], &options).unwrap();
            let note = note.unwrap().to_string();
            assert!(note.contains(field) && note.contains("ppf.bin"), "{field}: {note}");
            assert!(model.table == honest.table && model.diameter == honest.diameter, "{field}");
            // The file is intact again.
            assert!(ObjectModel::cached(&path, &mesh, &[], &options).unwrap().1.is_none(), "{field}");
        }
    }
}
