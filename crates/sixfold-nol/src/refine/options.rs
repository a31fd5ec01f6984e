//! Options and results of the refinement of poses.

use sixfold_geometry::Pose;

use crate::error::NolError;

/// Options of the refinement.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseRefinementOptions {
    /// Pixels along a side of the crops that are compared.
    pub side: usize,
    /// Points of the surface that are compared.
    pub points: usize,
    /// Blur of the colours from coarse to fine, crop pixels.
    pub blurs: Vec<f32>,
    /// Distance from the outline within which the border is searched at each blur, crop pixels.
    pub reaches: Vec<f64>,
    /// Steps at each blur; the common appearance is recomputed before each.
    pub steps: usize,
    /// Slow changes of colour are removed with means over this many times the blur; 0 compares unfiltered colours.
    pub wide: f32,
    /// Rounds at each blur that search for the error common to all poses of an object. They find it on uniformly painted objects
    /// under uniform light; on LM-O's photographs they did not improve poses, so there are none by default.
    pub shared: usize,
    /// Weight of the colours' differences as a whole, in independent measurements; 0 leaves them out.
    pub colors: f64,
    /// Weight of one line across the outline, in independent measurements; 0 leaves the outline out.
    pub line: f64,
    /// Bonus to the log likelihood of a border where colours change sharply; 0 uses only the likelihood of colours.
    pub edges: f64,
    /// Whether the objects stood still while the photographs were taken. Their places relative to each other are then the same in
    /// all of them, which constrains a pose more than its own pixels do.
    pub scene: SceneKind,
    /// Standard deviation of the given poses: metres along each axis, radians about each.
    pub rough: [f64; 2],
    /// A photograph whose pose moved by more than this many standard deviations is dropped.
    pub max_moved: f64,
    /// A photograph whose colours differ from the others' by more than this many times their median difference is dropped.
    pub max_different: f64,
    /// Seed of the points.
    pub seed: u64,
}

impl Default for PoseRefinementOptions {
    fn default() -> Self {
        PoseRefinementOptions {
            side: 128,
            points: 4000,
            blurs: vec![3.0, 2.0, 1.4, 1.0],
            reaches: vec![12.0, 8.0, 5.0, 4.0],
            steps: 5,
            wide: 4.0,
            shared: 0,
            colors: 10.0,
            line: 0.02,
            edges: 60.0,
            scene: SceneKind::Judge,
            rough: [0.006, 0.03],
            max_moved: 6.0,
            max_different: 3.5,
            seed: 0,
        }
    }
}

/// Whether objects moved between photographs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SceneKind {
    /// Decided from the given poses: whether they agree with one arrangement as well as expected for their roughness; if not, which
    /// objects stood still between which of the images.
    #[default]
    Judge,
    /// Only the camera moved.
    Still,
    /// Every object in every photograph is refined separately.
    Moving,
}

/// The result for one photograph.
#[derive(Debug, Clone, PartialEq)]
pub struct SourceReport {
    /// The new pose; the given one if the photograph was dropped.
    pub camera_from_object: Pose,
    /// Distance by which the object's origin moved, metres.
    pub moved: f64,
    /// Angle by which it was rotated, radians.
    pub rotated: f64,
    /// Mean difference in colour to the other photographs (0 to 1) before and after.
    pub difference: [f64; 2],
    /// Lines of the outline on which the border was found at the end.
    pub lines: usize,
    /// Why the photograph should not be used.
    pub dropped: Option<String>,
}

/// The refined poses.
#[derive(Debug, Clone, PartialEq)]
pub struct Refinement {
    /// One report per source, in their order.
    pub sources: Vec<SourceReport>,
    /// Whether the objects were assumed to have stood still in all photographs.
    pub still: bool,
    /// Number of places at which they stood: the number of objects if nothing moved or this is unknown; more if some were moved
    /// between some of the photographs.
    pub places: usize,
    /// Disagreement of the given poses with one common arrangement, in units of that explained by their roughness (1: as expected);
    /// `None` if there is nothing to compare.
    pub disagreement: Option<f64>,
}

impl PoseRefinementOptions {
    /// Tests every field.
    ///
    /// # Errors
    /// [`NolError::Option`].
    pub fn check(&self) -> Result<(), NolError> {
        let wrong = |field, expected, found: String| Err(NolError::Option { field, expected, found });
        if !(16..=1024).contains(&self.side) {
            return wrong("refine.side", "16 to 1024 pixels", self.side.to_string());
        }
        if !(100..=1_000_000).contains(&self.points) {
            return wrong("refine.points", "100 to 1000000", self.points.to_string());
        }
        if self.blurs.is_empty() || !self.blurs.iter().all(|b| (0.0..=64.0).contains(b)) {
            return wrong(
                "refine.blurs",
                "one number or more of 0 to 64 pixels",
                format!("{:?}", self.blurs),
            );
        }
        if self.reaches.is_empty() || !self.reaches.iter().all(|b| (1.0..=256.0).contains(b)) {
            return wrong(
                "refine.reaches",
                "one number or more of 1 to 256 pixels",
                format!("{:?}", self.reaches),
            );
        }
        for (field, value) in
            [("refine.colors", self.colors), ("refine.line", self.line), ("refine.edges", self.edges)]
        {
            if !(value >= 0.0 && value.is_finite()) {
                return wrong(field, "0 or more", value.to_string());
            }
        }
        if !self.rough.iter().all(|v| *v > 0.0 && v.is_finite()) {
            return wrong("refine.rough", "metres and radians above 0", format!("{:?}", self.rough));
        }
        Ok(())
    }
}
