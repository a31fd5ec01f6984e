//! Templates on disk: one file per object, little-endian: magic, format version, a hash of what they were made from, the numbers,
//! and a checksum over all before it.
//!
//! A file is written under a temporary name, flushed to disk and then renamed: a crash or a power failure never leaves half a file,
//! and the old one stays until the new one is complete.

use std::io::Write;
use std::path::Path;

use sixfold_geometry::nalgebra::{Quaternion, UnitQuaternion};
use sixfold_geometry::{Pose, Vec3};
use sixfold_io::{fnv1a, limits, read_regular, write_atomically_with};

use crate::error::StoreError;
use crate::template::{ObjectTemplates, SIDE, Source, Template, TemplateOptions};
use crate::views::ViewCoverage;

const MAGIC: &[u8; 8] = b"SIXFTPL\0";
const VERSION: u32 = 1;
const NUMBERS_PER_TEMPLATE: usize = 8;
const TEMPLATE_BYTES: usize = 8 * NUMBERS_PER_TEMPLATE + 2 * SIDE * SIDE;
/// Largest number of templates of an object: six times as many as are rendered from a mesh.
pub(crate) const MAX_TEMPLATES: usize = 4096;
/// Diameters, metres, and distances of views, metres, that a file may contain: a wider range than any caller produces.
const DIAMETERS: (f64, f64) = (1e-4, 1e3);
const DISTANCES: (f64, f64) = (1e-3, 1e3);
/// Largest distance of the origin of an object's frame from a view's reference point, metres.
const FURTHEST: f64 = 1e5;
/// Largest relative difference between a patch's size and the margin times the diameter: rounding errors.
const SAME_SIZE: f64 = 1e-9;
const HEAD_BYTES: usize = 8 + 4 + 1 + 1 + 2 + 8 + 4 * 8 + 4;

/// Replaces a file atomically.
pub(crate) fn write_bytes(path: &Path, bytes: &[u8]) -> Result<(), StoreError> {
    write_atomically_with(path, |file| file.write_all(bytes))
        .map_err(|source| StoreError::Io { path: path.to_path_buf(), source })
}

impl ObjectTemplates {
    /// The file's bytes; the same templates give the same bytes.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut out = Vec::with_capacity(HEAD_BYTES + self.templates.len() * TEMPLATE_BYTES + 8);
        out.extend_from_slice(MAGIC);
        out.extend_from_slice(&VERSION.to_le_bytes());
        out.push(match self.source {
            Source::Mesh => 0,
            Source::PosedDepth => 1,
            Source::Depth => 2,
        });
        out.push(match self.options.coverage {
            ViewCoverage::Above => 0,
            ViewCoverage::Around => 1,
        });
        out.extend_from_slice(&(SIDE as u16).to_le_bytes());
        out.extend_from_slice(&self.made_from.to_le_bytes());
        for number in [self.diameter, self.size, self.options.margin, self.options.distance] {
            out.extend_from_slice(&number.to_le_bytes());
        }
        out.extend_from_slice(&(self.templates.len() as u32).to_le_bytes());
        for t in &self.templates {
            let (q, p) = (t.view_from_object.rotation(), t.view_from_object.translation());
            for number in [t.distance, q.w, q.i, q.j, q.k, p.x, p.y, p.z] {
                out.extend_from_slice(&number.to_le_bytes());
            }
            t.depth.iter().for_each(|z| out.extend_from_slice(&z.to_le_bytes()));
        }
        let sum = fnv1a(&out);
        out.extend_from_slice(&sum.to_le_bytes());
        out
    }

    /// Writes the file; an existing file stays until the new one is complete and on disk.
    ///
    /// # Errors
    /// [`StoreError::Io`].
    pub fn write(&self, path: &Path) -> Result<(), StoreError> {
        write_bytes(path, &self.to_bytes())
    }

    /// Reads a file that [`ObjectTemplates::write`] wrote.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn read(path: &Path) -> Result<ObjectTemplates, StoreError> {
        let bytes = read_regular(path, limits::DERIVED)
            .map_err(|source| StoreError::Io { path: path.to_path_buf(), source })?;
        ObjectTemplates::parse(&bytes, path)
    }

    /// Reads the bytes of a file; `path` is for messages.
    ///
    /// # Errors
    /// [`StoreError::Damaged`], [`StoreError::Version`].
    pub fn parse(bytes: &[u8], path: &Path) -> Result<ObjectTemplates, StoreError> {
        let damaged = |what| StoreError::Damaged { path: path.to_path_buf(), what };
        if bytes.len() < 8 || &bytes[..8] != MAGIC {
            return Err(damaged("not a file of templates"));
        }
        let mut reader = Reader(&bytes[8..]);
        let version = reader.u32().ok_or_else(|| damaged("cut off"))?;
        if version != VERSION {
            return Err(StoreError::Version { path: path.to_path_buf(), found: version, expected: VERSION });
        }
        if bytes.len() < HEAD_BYTES + 8 {
            return Err(damaged("cut off"));
        }
        let (body, sum) = bytes.split_at(bytes.len() - 8);
        if fnv1a(body).to_le_bytes() != sum {
            return Err(damaged("the checksum does not match: damaged or cut off"));
        }
        reader = Reader(&body[12..]);
        let templates = reader.templates().ok_or_else(|| damaged("its parts do not fit together"))?;
        templates.check().map_err(damaged)?;
        Ok(templates)
    }

    /// Checks what is true of all templates, whatever they were made from: a checksum detects accidental damage, not forgery.
    fn check(&self) -> Result<(), &'static str> {
        let within = |value: f64, (low, high): (f64, f64)| (low..=high).contains(&value);
        if !within(self.diameter, DIAMETERS) {
            return Err("field diameter: not that of an object");
        }
        if self.options.check().is_err() {
            return Err("field options: out of their range");
        }
        if !((self.size / (self.options.margin * self.diameter) - 1.0).abs() <= SAME_SIZE) {
            return Err("field size: not the margin times the diameter");
        }
        if !(1..=MAX_TEMPLATES).contains(&self.templates.len()) {
            return Err("field templates: none, or too many");
        }
        for t in &self.templates {
            if !within(t.distance, DISTANCES) {
                return Err("field distance: not that of a view");
            }
            if !(t.view_from_object.translation().norm() <= FURTHEST) {
                return Err("field view_from_object: too far away");
            }
            if t.depth.iter().all(|z| *z == 0) {
                return Err("field depth: a view that shows nothing");
            }
        }
        Ok(())
    }
}

struct Reader<'a>(&'a [u8]);

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (head, tail) = self.0.split_first_chunk::<N>()?;
        self.0 = tail;
        Some(*head)
    }

    fn u32(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn number(&mut self) -> Option<f64> {
        self.take().map(f64::from_le_bytes)
    }

    fn templates(&mut self) -> Option<ObjectTemplates> {
        let [source, coverage] = self.take()?;
        let source = [Source::Mesh, Source::PosedDepth, Source::Depth].get(usize::from(source)).copied()?;
        let coverage = [ViewCoverage::Above, ViewCoverage::Around].get(usize::from(coverage)).copied()?;
        if usize::from(u16::from_le_bytes(self.take()?)) != SIDE {
            return None;
        }
        let made_from = self.take().map(u64::from_le_bytes)?;
        let [diameter, size] = [self.number()?, self.number()?];
        let options = TemplateOptions { coverage, margin: self.number()?, distance: self.number()? };
        let count = self.u32()? as usize;
        // The count must match the remaining bytes exactly; checked before anything is allocated.
        if self.0.len() != count.checked_mul(TEMPLATE_BYTES)? {
            return None;
        }
        let templates = (0..count).map(|_| self.template()).collect::<Option<Vec<_>>>()?;
        Some(ObjectTemplates { diameter, size, options, source, made_from, templates })
    }

    fn template(&mut self) -> Option<Template> {
        let distance = self.number()?;
        let q = Quaternion::new(self.number()?, self.number()?, self.number()?, self.number()?);
        if !((q.norm() - 1.0).abs() <= 1e-9) {
            return None;
        }
        let rotation = UnitQuaternion::new_unchecked(q);
        let translation = Vec3::new(self.number()?, self.number()?, self.number()?);
        let depth =
            (0..SIDE * SIDE).map(|_| self.take().map(u16::from_le_bytes)).collect::<Option<Vec<_>>>()?;
        Some(Template { view_from_object: Pose::new(rotation, translation), distance, depth })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn templates() -> ObjectTemplates {
        let template = |k: u16| Template {
            view_from_object: Pose::exp(&[0.01, 0.02, f64::from(k) * 0.01, 0.3, f64::from(k), 0.1].into()),
            distance: 0.8,
            depth: (0..SIDE * SIDE)
                .map(|i| if i % 3 == 0 { 0 } else { 32_000 + k + i as u16 % 50 })
                .collect(),
        };
        ObjectTemplates {
            diameter: 0.12,
            size: 0.132,
            options: TemplateOptions::default(),
            source: Source::Mesh,
            made_from: 77,
            templates: (0..3).map(template).collect(),
        }
    }

    #[test]
    fn what_is_written_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("templates.bin");
        let written = templates();
        written.write(&path).unwrap();
        assert_eq!(ObjectTemplates::read(&path).unwrap(), written);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
        // A process killed while writing leaves its own unfinished file; the old one is intact.
        std::fs::write(path.with_extension("1.tmp"), &written.to_bytes()[..1000]).unwrap();
        assert_eq!(ObjectTemplates::read(&path).unwrap(), written);
    }

    #[test]
    fn damage_is_noticed_wherever_it_is() {
        let path = Path::new("templates.bin");
        let bytes = templates().to_bytes();
        for place in (0..bytes.len()).step_by(211) {
            let mut bad = bytes.clone();
            bad[place] ^= 0x10;
            assert!(ObjectTemplates::parse(&bad, path).is_err(), "byte {place}");
        }
        for length in (0..bytes.len()).step_by(997) {
            assert!(ObjectTemplates::parse(&bytes[..length], path).is_err(), "cut at {length}");
        }
        let mut newer = bytes.clone();
        newer[8] = 9;
        let message = ObjectTemplates::parse(&newer, path).unwrap_err().to_string();
        assert!(message.contains("found format 9, expected 1"), "{message}");
    }

    #[test]
    fn a_count_that_asks_for_all_memory_is_refused() {
        let mut bytes = templates().to_bytes();
        let at = HEAD_BYTES - 4;
        bytes[at..at + 4].copy_from_slice(&u32::MAX.to_le_bytes());
        let end = bytes.len() - 8;
        let sum = fnv1a(&bytes[..end]);
        bytes[end..].copy_from_slice(&sum.to_le_bytes());
        assert!(matches!(
            ObjectTemplates::parse(&bytes, Path::new("t")).unwrap_err(),
            StoreError::Damaged { .. }
        ));
    }
}
