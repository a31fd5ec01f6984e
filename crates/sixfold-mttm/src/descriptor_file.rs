//! Descriptors of an object's templates on disk, so that they are computed once: magic, format version, fingerprints of network and
//! templates, the numbers, a checksum; written in the same way as templates.

use std::path::Path;

use sixfold_io::{fnv1a, limits, read_regular};

use crate::error::StoreError;
use crate::model::Descriptor;
use crate::network::DESCRIPTOR;
use crate::store::write_bytes;

const MAGIC: &[u8; 8] = b"SIXFDSC\0";
const VERSION: u32 = 1;
/// Magic, version, two fingerprints, count.
const HEAD: usize = 8 + 4 + 16 + 4;

pub(crate) fn write(path: &Path, made_from: [u64; 2], descriptors: &[Descriptor]) -> Result<(), StoreError> {
    let mut out = Vec::with_capacity(HEAD + descriptors.len() * 4 * DESCRIPTOR + 8);
    out.extend_from_slice(MAGIC);
    out.extend_from_slice(&VERSION.to_le_bytes());
    made_from.iter().for_each(|m| out.extend_from_slice(&m.to_le_bytes()));
    out.extend_from_slice(&(descriptors.len() as u32).to_le_bytes());
    descriptors.iter().flatten().for_each(|v| out.extend_from_slice(&v.to_le_bytes()));
    let sum = fnv1a(&out);
    out.extend_from_slice(&sum.to_le_bytes());
    write_bytes(path, &out)
}

/// Reads what [`write`] wrote, if it was made from the same network and templates.
pub(crate) fn read(path: &Path, made_from: [u64; 2]) -> Result<Vec<Descriptor>, StoreError> {
    let bytes = read_regular(path, limits::DERIVED)
        .map_err(|source| StoreError::Io { path: path.to_path_buf(), source })?;
    let damaged = |what| StoreError::Damaged { path: path.to_path_buf(), what };
    if bytes.len() < HEAD + 8 || &bytes[..8] != MAGIC {
        return Err(damaged("not a file of descriptors, or cut off"));
    }
    let word = |at: usize| u32::from_le_bytes([0, 1, 2, 3].map(|k| bytes[at + k]));
    if word(8) != VERSION {
        let (found, expected) = (word(8), VERSION);
        return Err(StoreError::Version { path: path.to_path_buf(), found, expected });
    }
    let (body, sum) = bytes.split_at(bytes.len() - 8);
    if fnv1a(body).to_le_bytes() != sum {
        return Err(damaged("the checksum does not match: damaged or cut off"));
    }
    let long = |at: usize| u64::from(word(at)) | u64::from(word(at + 4)) << 32;
    if [long(12), long(20)] != made_from {
        return Err(StoreError::OtherInput { path: path.to_path_buf() });
    }
    let numbers = &body[HEAD..];
    if numbers.len() != (word(28) as usize).saturating_mul(4 * DESCRIPTOR) {
        return Err(damaged("its parts do not fit together"));
    }
    let number = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
    if !numbers.chunks_exact(4).all(|b| number(b).is_finite()) {
        return Err(damaged("a number that is not finite"));
    }
    let rows = numbers.chunks_exact(4 * DESCRIPTOR);
    Ok(rows.map(|row| std::array::from_fn(|k| number(&row[4 * k..]))).collect())
}
