//! Errors of a taught mesh as a picture (dissertation, figure 4.15).

use anyhow::Result;
use sixfold_geometry::nalgebra::{UnitQuaternion, Vector3};
use sixfold_geometry::{KdTree, Pose, RgbImage, Vec3};
use sixfold_mesh::Mesh;
use sixfold_plot::{Canvas, INK};
use sixfold_render::portrait;

/// Distance in millimetres from which the colour does not change any more.
const LARGEST: f64 = 5.0;
/// Points of the true surface.
const POINTS: usize = 200_000;
/// Height of the scale below the views, pixels.
const SCALE: usize = 48;

/// Two opposite views of a mesh, coloured by the distance of each vertex to the true surface, and the scale of the colours. Both
/// meshes have to be in one frame.
pub(super) fn picture(found: &Mesh, truth: &Mesh) -> Result<RgbImage> {
    let tree = KdTree::new(&truth.sample_surface(POINTS, 4).points);
    let millimetres = |p: &Vec3| tree.nearest(p).map_or(LARGEST, |n| 1000.0 * n.distance);
    let colors = found.vertices().iter().map(|p| color(millimetres(p))).collect();
    let colored = found.clone().with_colors(colors)?;
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI);
    let views = [portrait(&colored), portrait(&colored.transformed(&Pose::new(turn, Vec3::zeros())))];
    let side = views[0].width();
    let mut scale = Canvas::new(2 * side, SCALE);
    let (left, width) = (0.25 * side as f64, 1.5 * side as f64);
    for step in 0..100 {
        let at = f64::from(step) / 100.0;
        scale.rectangle(left + width * at, 4.0, width / 100.0 + 0.5, 16.0, color(LARGEST * at));
    }
    scale.text(left, 26.0, 2.0, "0 mm", INK);
    scale.text(left + width - 90.0, 26.0, 2.0, &format!("{LARGEST} mm and more"), INK);
    let scale = scale.finish();
    Ok(RgbImage::from_fn(2 * side, side + SCALE, |x, y| {
        if y < side { views[x / side][(x % side, y)] } else { scale[(x, y - side)] }
    }))
}

/// White without an error, yellow at half of the largest, red from the largest on.
fn color(millimetres: f64) -> [u8; 3] {
    let at = (millimetres / LARGEST).clamp(0.0, 1.0);
    let (from, to, part) = if at < 0.5 {
        ([235.0, 240.0, 245.0], [245.0, 190.0, 60.0], 2.0 * at)
    } else {
        ([245.0, 190.0, 60.0], [190.0, 30.0, 40.0], 2.0 * at - 1.0)
    };
    std::array::from_fn(|k| {
        let (from, to): (f64, f64) = (from[k], to[k]);
        (from + part * (to - from)) as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn vertices_are_coloured_by_their_distance_from_the_true_surface() {
        // A square, and the same with two corners 5 mm higher.
        let square = |z: f64| {
            let corners = [(0.0, 0.0, 0.0), (0.1, 0.0, z), (0.1, 0.1, z), (0.0, 0.1, 0.0)];
            let corners = corners.iter().map(|&(x, y, z)| Vec3::new(x, y, z)).collect();
            Mesh::new(corners, vec![[0, 1, 2], [0, 2, 3]]).unwrap()
        };
        let is_red = |p: &[u8; 3]| p[0] > 60 && p[0] / 2 > p[1].max(p[2]);
        let reds = |found: &Mesh| {
            let picture = picture(found, &square(0.0)).unwrap();
            let views = picture.height() - SCALE;
            picture.as_slice()[..views * picture.width()].iter().filter(|p| is_red(p)).count()
        };
        assert_eq!(reds(&square(0.0)), 0);
        assert!(reds(&square(0.006)) > 1000);
        assert_eq!((color(0.0), color(5.0), color(50.0)), ([235, 240, 245], [190, 30, 40], [190, 30, 40]));
    }
}
