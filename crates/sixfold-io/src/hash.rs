//! FNV-1a with 64 bits (Fowler, Noll, Vo): distinguishes files and settings, with the same value on every machine. It gives
//! no protection against deliberate collisions.

use std::io::{self, Read};
use std::path::Path;

use crate::regular::open_regular;

/// A hash that is updated with bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fnv1a(u64);

impl Default for Fnv1a {
    fn default() -> Self {
        Fnv1a(0xcbf2_9ce4_8422_2325)
    }
}

impl Fnv1a {
    /// Updates the hash with `bytes`; equivalent to one call per byte.
    pub fn write(&mut self, bytes: &[u8]) {
        for &b in bytes {
            self.0 = (self.0 ^ u64::from(b)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }

    /// The hash of all bytes so far.
    pub fn value(&self) -> u64 {
        self.0
    }
}

/// The hash of `bytes`.
pub fn fnv1a(bytes: &[u8]) -> u64 {
    let mut hash = Fnv1a::default();
    hash.write(bytes);
    hash.value()
}

/// The hash of a file's bytes, read piece by piece.
///
/// # Errors
/// The system's error; a folder, a pipe or a device is refused, as by [`open_regular`].
pub fn fnv1a_of_file(path: &Path) -> io::Result<u64> {
    let mut file = open_regular(path, u64::MAX)?;
    let (mut hash, mut buffer) = (Fnv1a::default(), vec![0; 1 << 16]);
    loop {
        match file.read(&mut buffer)? {
            0 => return Ok(hash.value()),
            count => hash.write(&buffer[..count]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hash_is_fnv_1a() {
        assert_eq!(fnv1a(b""), 0xcbf2_9ce4_8422_2325);
        assert_eq!(fnv1a(b"foobar"), 0x8594_4171_f739_67e8);
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("f"), b"foobar").unwrap();
        assert_eq!(fnv1a_of_file(&folder.path().join("f")).unwrap(), 0x8594_4171_f739_67e8);
    }
}
