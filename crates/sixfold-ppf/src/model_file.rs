//! The description of an object on disk, beside the object: what [`ObjectModel::new`] renders is computed once.
//!
//! Little-endian: magic, format version, a hash of the mesh and options it was made from, the simplified mesh, the
//! samples with the views that see them, and a checksum. The feature table is not stored: it is twenty times as
//! large and is built from the samples in a tenth of a second.

use std::io;
use std::path::{Path, PathBuf};

use sixfold_geometry::{PointCloud, Pose, Vec3};
use sixfold_io::{Fnv1a, fnv1a, write_atomically};
use sixfold_mesh::Mesh;
use thiserror::Error;

use crate::model::{Description, ModelError, ModelOptions, ObjectModel};

const MAGIC: &[u8; 8] = b"SIXFPPF\0";
const VERSION: u32 = 1;

/// Why a stored description was not taken; it is then recomputed.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ModelFileError {
    /// The file cannot be read or written.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// The file is no description, another version, or damaged.
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
    /// The mesh itself cannot be described.
    #[error(transparent)]
    Model(#[from] ModelError),
}

impl ObjectModel {
    /// The description of `mesh`, read from `path` when it is there and belongs to this mesh and these options,
    /// otherwise computed and written there. The second value tells why a file that was there was not taken, or that
    /// the new one could not be written.
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
        match read(path, key, options) {
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

/// FNV-1a over what the description depends on.
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

fn read(path: &Path, key: u64, options: &ModelOptions) -> Result<Description, ModelFileError> {
    let bytes =
        std::fs::read(path).map_err(|source| ModelFileError::Io { path: path.to_path_buf(), source })?;
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
        // The sizes must be exactly what is left before anything is allocated.
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
    rest().ok_or_else(|| damaged("its parts do not fit together"))
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
