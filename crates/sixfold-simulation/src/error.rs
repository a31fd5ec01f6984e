//! Why something cannot be simulated.

use thiserror::Error;

/// Why something cannot be simulated.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum SimulationError {
    /// The mesh has no faces, or nothing with a volume came out of it.
    #[error("the mesh has {faces} faces and gives no solid part, expected a surface with a volume: {advice}")]
    NoSolid {
        /// Faces of the mesh.
        faces: usize,
        /// What to do.
        advice: &'static str,
    },
    /// An option is out of range.
    #[error("option {field}: found {found}, expected {expected}")]
    Option {
        /// Name of the field.
        field: &'static str,
        /// What it holds.
        found: f64,
        /// What it may hold.
        expected: &'static str,
    },
}

/// Tests that options lie within their ranges: name, value, lowest, highest, what is expected.
pub(crate) fn check_ranges(
    ranges: &[(&'static str, f64, f64, f64, &'static str)],
) -> Result<(), SimulationError> {
    for &(field, found, low, high, expected) in ranges {
        if !(found >= low && found <= high) {
            return Err(SimulationError::Option { field, found, expected });
        }
    }
    Ok(())
}
