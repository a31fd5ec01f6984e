//! Errors of the simulation.

use thiserror::Error;

/// Why something cannot be simulated.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum SimulationError {
    /// The mesh has no faces, or its decomposition has no part with a volume.
    #[error("the mesh has {faces} faces and gives no solid part, expected a surface with a volume: {advice}")]
    NoSolid {
        /// Faces of the mesh.
        faces: usize,
        /// Advice for the user.
        advice: &'static str,
    },
    /// An option is out of range.
    #[error("option {field}: found {found}, expected {expected}")]
    Option {
        /// Name of the field.
        field: &'static str,
        /// Its value.
        found: f64,
        /// The values allowed.
        expected: &'static str,
    },
}

/// Tests that options are within their ranges, each given as name, value, lowest, highest, expected values.
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
