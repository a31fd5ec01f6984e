//! The mesh that verification renders: without colours, and simplified if it is very fine.

use std::io;
use std::path::{Path, PathBuf};

use sixfold_geometry::Vec3;
use sixfold_io::{fnv1a, limits, read_regular, write_atomically};
use sixfold_mesh::{Mesh, MeshError, simplify};
use thiserror::Error;

/// Finer meshes are simplified to this many faces for verification: at 4,000 the surface moves by less than a
/// thousandth of the diameter, and rendering costs a fifth.
const RENDERED_FACES: usize = 4000;

/// The mesh for rendering in the verification.
///
/// # Errors
/// [`MeshError`] if it has no surface.
pub fn verification_mesh(mesh: &Mesh) -> Result<Mesh, MeshError> {
    let bare = Mesh::new(mesh.vertices().to_vec(), mesh.faces().to_vec())?;
    Ok(if bare.faces().len() > RENDERED_FACES { simplify(&bare, RENDERED_FACES) } else { bare })
}

/// Largest extent of the simplified mesh beyond the bounding box of the original, as a fraction of the box's diagonal: collapsing
/// edges moves vertices slightly.
const OVERHANG: f64 = 0.5;

/// Whether `simple` can be a simplified form of `mesh`: it has a surface, not more faces, and is in the same place. The content of
/// a file is tested with this before it is used.
pub fn could_be_simplified(simple: &Mesh, mesh: &Mesh) -> bool {
    let (low, high) = mesh.bounding_box();
    let margin = Vec3::repeat(OVERHANG * (high - low).norm());
    let (simple_low, simple_high) = simple.bounding_box();
    !simple.faces().is_empty()
        && simple.faces().len() <= mesh.faces().len()
        && simple_low >= low - margin
        && simple_high <= high + margin
}

const MAGIC: &[u8; 8] = b"SIXFVMSH";
const VERSION: u32 = 1;
/// Magic, version, fingerprint of the source, counts of vertices and faces.
const HEAD: usize = 8 + 4 + 8 + 4 + 4;

/// Why a stored verification mesh was not used; it is then computed again.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum VerificationMeshError {
    /// The file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The file is of another kind, version or mesh, or damaged.
    #[error("{}: damaged, of another version or made from another mesh", path.display())]
    Unusable {
        /// The file.
        path: PathBuf,
    },
}

/// A verification mesh, and why it could not be read or stored.
#[derive(Debug)]
pub struct VerificationMesh {
    /// The mesh.
    pub mesh: Mesh,
    /// Why an existing file was not used, or the new one could not be written.
    pub note: Option<VerificationMeshError>,
}

impl VerificationMesh {
    /// [`verification_mesh`], kept in `file` (little-endian, with a checksum) if the simplification takes time.
    ///
    /// # Errors
    /// As [`verification_mesh`].
    pub fn cached(file: Option<&Path>, mesh: &Mesh) -> Result<VerificationMesh, MeshError> {
        let Some(path) = file.filter(|_| mesh.faces().len() > RENDERED_FACES) else {
            return Ok(VerificationMesh { mesh: verification_mesh(mesh)?, note: None });
        };
        let key = mesh.shape_hash();
        let mut note = None;
        match read_regular(path, limits::DERIVED) {
            Ok(bytes) => match decode(&bytes, key).filter(|kept| could_be_simplified(kept, mesh)) {
                Some(mesh) => return Ok(VerificationMesh { mesh, note: None }),
                None => note = Some(VerificationMeshError::Unusable { path: path.into() }),
            },
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(source) => note = Some(VerificationMeshError::Io { path: path.into(), source }),
        }
        let mesh = verification_mesh(mesh)?;
        if let Err(source) = write_atomically(path, &encode(&mesh, key)) {
            note = Some(VerificationMeshError::Io { path: path.into(), source });
        }
        Ok(VerificationMesh { mesh, note })
    }
}

fn encode(mesh: &Mesh, key: u64) -> Vec<u8> {
    let mut out = Vec::new();
    out.extend_from_slice(MAGIC);
    out.extend_from_slice(&VERSION.to_le_bytes());
    out.extend_from_slice(&key.to_le_bytes());
    out.extend_from_slice(&(mesh.vertices().len() as u32).to_le_bytes());
    out.extend_from_slice(&(mesh.faces().len() as u32).to_le_bytes());
    out.extend(mesh.vertices().iter().flat_map(|v| [v.x, v.y, v.z]).flat_map(f64::to_le_bytes));
    out.extend(mesh.faces().iter().flatten().flat_map(|i| i.to_le_bytes()));
    let sum = fnv1a(&out);
    out.extend_from_slice(&sum.to_le_bytes());
    out
}

fn decode(bytes: &[u8], key: u64) -> Option<Mesh> {
    let (body, sum) = bytes.split_last_chunk::<8>()?;
    if fnv1a(body).to_le_bytes() != *sum || body.get(..8)? != MAGIC {
        return None;
    }
    let word = |at: usize| body.get(at..at + 4)?.try_into().ok().map(u32::from_le_bytes);
    let long = |at: usize| body.get(at..at + 8)?.try_into().ok().map(u64::from_le_bytes);
    if word(8)? != VERSION || long(12)? != key {
        return None;
    }
    let (vertices, faces) = (word(20)? as usize, word(24)? as usize);
    // The sizes must match the file exactly; checked before anything is allocated.
    if body.len() != vertices.checked_mul(24)?.checked_add(faces.checked_mul(12)?)?.checked_add(HEAD)? {
        return None;
    }
    let (points, corners) = body[HEAD..].split_at(24 * vertices);
    let number = |b: &[u8; 8]| f64::from_le_bytes(*b);
    let points: Vec<f64> = points.as_chunks::<8>().0.iter().map(number).collect();
    let corners: Vec<u32> = corners.as_chunks::<4>().0.iter().map(|b| u32::from_le_bytes(*b)).collect();
    let points = points.as_chunks::<3>().0.iter().map(|p| Vec3::from(*p)).collect();
    Mesh::new(points, corners.as_chunks::<3>().0.to_vec()).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A bumpy grid with more faces than are rendered.
    fn fine() -> Mesh {
        let side = 60u32;
        let at = |i: u32| {
            let (x, y) = (f64::from(i % side) * 1e-3, f64::from(i / side) * 1e-3);
            Vec3::new(x, y, 0.002 * (300.0 * x).sin() * (200.0 * y).cos())
        };
        let faces = (0..(side - 1) * (side - 1)).flat_map(|k| {
            let i = k / (side - 1) * side + k % (side - 1);
            [[i, i + 1, i + side], [i + 1, i + side + 1, i + side]]
        });
        Mesh::new((0..side * side).map(at).collect(), faces.collect()).unwrap()
    }

    #[test]
    fn a_kept_mesh_is_the_same_and_a_damaged_or_foreign_file_is_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("deep/mesh.bin");
        let mesh = fine();
        let expected = verification_mesh(&mesh).unwrap();
        assert!(expected.faces().len() <= RENDERED_FACES && mesh.faces().len() > RENDERED_FACES);
        let same = |found: &VerificationMesh| {
            found.mesh.vertices() == expected.vertices() && found.mesh.faces() == expected.faces()
        };
        let first = VerificationMesh::cached(Some(&file), &mesh).unwrap();
        assert!(same(&first) && first.note.is_none());
        let kept = std::fs::read(&file).unwrap();
        assert!(decode(&kept, mesh.shape_hash()).is_some());
        assert!(same(&VerificationMesh::cached(Some(&file), &mesh).unwrap()));
        for broken in
            [&kept[..kept.len() / 2], &kept[..5], b"something else, longer than a head of such a file"]
        {
            std::fs::write(&file, broken).unwrap();
            let again = VerificationMesh::cached(Some(&file), &mesh).unwrap();
            assert!(same(&again) && again.note.is_some());
            assert_eq!(std::fs::read(&file).unwrap(), kept);
        }
        // A file that claims to be intact and of this mesh, but has a vertex far away, or no faces.
        for (shift, faces) in [(9.0, expected.faces()), (0.0, &[])] {
            let mut vertices = expected.vertices().to_vec();
            vertices[0].x += shift;
            let forged = Mesh::new(vertices, faces.to_vec()).unwrap();
            std::fs::write(&file, encode(&forged, mesh.shape_hash())).unwrap();
            let again = VerificationMesh::cached(Some(&file), &mesh).unwrap();
            assert!(same(&again) && again.note.is_some());
        }
        // A file of another mesh.
        let moved: Vec<Vec3> = mesh.vertices().iter().map(|v| v * 1.01).collect();
        let other = Mesh::new(moved, mesh.faces().to_vec()).unwrap();
        let found = VerificationMesh::cached(Some(&file), &other).unwrap();
        assert!(!same(&found) && found.note.is_some());
    }
}
