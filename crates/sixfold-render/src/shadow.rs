//! The shadow of a depth camera's projector: what the camera sees and the projector (or second camera) does not reach, which a
//! structured-light or stereo camera cannot measure (dissertation, figure 5.1).
//!
//! Projector and camera look the same way, the projector to the right of the camera. A point at depth `z` is then seen
//! `f b / z` pixels further left in the projector's image of the same row.

/// Which pixels of a row of ideal depth (metres, 0 where nothing is seen) lie in the shadow. `baseline_focal` is the distance
/// of camera and projector in metres times the focal length in pixels.
pub(crate) fn shadow_row(depth: &[f32], baseline_focal: f64) -> Vec<bool> {
    let mut dark = vec![false; depth.len()];
    // From right to left the projector's columns fall. Where one does not, something further right and nearer is in the way.
    let mut lowest = f64::INFINITY;
    for (x, &z) in depth.iter().enumerate().rev() {
        if z <= 0.0 {
            continue;
        }
        let column = x as f64 - baseline_focal / f64::from(z);
        // Half a column: a slanted surface may well be seen by two pixels in one column of the projector.
        dark[x] = column > lowest + 0.5;
        lowest = lowest.min(column);
    }
    dark
}
