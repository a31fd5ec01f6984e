//! Options of a reconstruction.

use sixfold_geometry::OptionError;

/// Options of a reconstruction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SfmOptions {
    /// Two features of a pair of photographs agree within this distance, pixels.
    pub threshold_px: f64,
    /// Maximum number of samples of five matches per pair.
    pub samples: usize,
    /// Minimum number of matches of a pair of photographs, and of a photograph with the known points.
    pub min_matches: usize,
    /// Minimum number of features of a photograph.
    pub min_features: usize,
    /// Minimum number of registered photographs.
    pub min_photographs: usize,
    /// Smallest angle between two rays to a point, degrees.
    pub min_angle: f64,
    /// Whether the camera is a guess: then its focal length is searched, and refined together with principal point and two
    /// radial coefficients.
    pub refine_camera: bool,
    /// Whether the guess's focal length comes from the camera (EXIF): then it is tried unchanged before others.
    pub focal_length_from_camera: bool,
    /// Seed of all samples.
    pub seed: u64,
}

impl Default for SfmOptions {
    fn default() -> Self {
        SfmOptions {
            threshold_px: 3.0,
            samples: 500,
            min_matches: 24,
            min_features: 80,
            min_photographs: 3,
            min_angle: 2.0,
            refine_camera: false,
            focal_length_from_camera: false,
            seed: 0,
        }
    }
}

impl SfmOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_positive("sfm.threshold_px", self.threshold_px, "pixels above 0")?;
        OptionError::unless_some("sfm.samples", self.samples)?;
        OptionError::unless_some("sfm.min_features", self.min_features)?;
        OptionError::unless_within("sfm.min_matches", self.min_matches as f64, 8.0.., "at least 8")?;
        OptionError::unless_within("sfm.min_photographs", self.min_photographs as f64, 2.0.., "at least 2")?;
        OptionError::unless_within("sfm.min_angle", self.min_angle, 0.1..=45.0, "between 0.1 and 45 degrees")
    }
}
