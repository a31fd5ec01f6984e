//! Profiles of lathed shapes: (radius, height) points from the axis at the bottom outwards, up, and back to the
//! axis.

/// A solid cylinder.
pub(crate) fn cylinder(radius: f64, height: f64) -> [(f64, f64); 4] {
    [(0.0, 0.0), (radius, 0.0), (radius, height), (0.0, height)]
}

/// A cup without a handle, as wide as `foot` at the bottom and `radius` at the rim, with a wall and a floor of these
/// thicknesses.
pub(crate) fn cup(foot: f64, radius: f64, height: f64, wall: f64, floor: f64) -> [(f64, f64); 6] {
    [(0.0, 0.0), (foot, 0.0), (radius, height), (radius - wall, height), (foot - wall, floor), (0.0, floor)]
}
