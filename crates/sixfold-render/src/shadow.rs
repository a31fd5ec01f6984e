//! The shadow of a depth camera's projector: surfaces that are visible to the camera but not to the projector (or second
//! camera), which a structured-light or stereo camera cannot measure (dissertation, figure 5.1).
//!
//! Projector and camera have the same orientation, with the projector to the right of the camera. A point at depth `z` is then
//! `f b / z` pixels further left in the same row of the projector's image.

/// The pixels of a row of ideal depth (metres, 0 where nothing was rendered) that are in the shadow. `baseline_focal` is the
/// distance of camera and projector in metres times the focal length in pixels.
pub(crate) fn shadow_row(depth: &[f32], baseline_focal: f64) -> Vec<bool> {
    let mut dark = vec![false; depth.len()];
    // From right to left the projector's columns decrease. Where they do not, something further right and nearer occludes the
    // point.
    let mut lowest = f64::INFINITY;
    for (x, &z) in depth.iter().enumerate().rev() {
        if z <= 0.0 {
            continue;
        }
        let column = x as f64 - baseline_focal / f64::from(z);
        // Half a column: two pixels of a slanted surface may fall into one column of the projector.
        dark[x] = column > lowest + 0.5;
        lowest = lowest.min(column);
    }
    dark
}
