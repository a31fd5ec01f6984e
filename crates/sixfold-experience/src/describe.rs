//! Human-readable descriptions of an experience: its numbers without the images, and a visualisation.

use serde::Serialize;
use sixfold_geometry::{Image, Pose, RgbImage};
use sixfold_grasp::{DrawnGrasp, Gripper, draw_grasps};
use sixfold_mesh::MeshError;

use super::{Crop, Experience, Stored, Summary};

/// An experience without its images, as `sixfold grasp store export` writes it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Description {
    /// Its line in a list.
    #[serde(flatten)]
    pub summary: Summary,
    /// Pose of the gripper when it closed, row by row, metres.
    pub camera_from_gripper: [[f64; 4]; 4],
    /// Distance of the pads before closing, metres.
    pub opening: f64,
    /// Focal lengths and principal point of the crop, pixels.
    pub camera: [f64; 4],
    /// Side of the crop, pixels.
    pub side: usize,
    /// The plane on which the object stood: unit normal and offset in metres, camera frame; `None` if unknown.
    pub table: Option<[f64; 4]>,
    /// Pixels that show the object.
    pub object_pixels: usize,
    /// Those of the object's pixels that are near the gripper.
    pub region_pixels: usize,
    /// Number of copies: the experience and its in-plane copies.
    pub copies: usize,
    /// The feature, 256 numbers, if requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub feature: Option<Vec<f32>>,
}

impl Description {
    /// The description of a stored experience.
    pub fn new(stored: &Stored, with_feature: bool) -> Description {
        let e = &stored.experience;
        let c = &e.crop.camera;
        Description {
            summary: Summary {
                id: stored.id,
                time: e.time,
                object: e.object.clone(),
                part: e.part.clone(),
                gripper: e.gripper.name.clone(),
                width: e.width,
                network: e.network.clone(),
                provenance: e.provenance.clone(),
            },
            camera_from_gripper: e.camera_from_gripper.rows(),
            opening: e.opening,
            camera: [c.fx, c.fy, c.cx, c.cy],
            side: e.crop.side,
            table: e.crop.table.map(|t| [t.normal.x, t.normal.y, t.normal.z, t.offset]),
            object_pixels: e.crop.pixels().count(),
            region_pixels: e.region.iter().filter(|r| **r).count(),
            copies: e.copies.len(),
            feature: e.copies.first().filter(|_| with_feature).map(|c| c.feature.clone()),
        }
    }
}

impl Experience {
    /// Three squares side by side, each pixel four times as large: normals with the gripper, VD-NOC, and the region of
    /// interest over the normals.
    ///
    /// # Errors
    /// [`MeshError`] for a gripper whose sizes are not finite.
    pub fn picture(&self) -> Result<RgbImage, MeshError> {
        let crop = &self.crop;
        let side = crop.side * ZOOM;
        let normals = colors(crop, &crop.normals);
        let with_gripper = self.with_gripper()?;
        let vd_noc = colors(crop, &crop.vd_noc);
        let region = Image::from_fn(side, side, |x, y| {
            let i = (y / ZOOM) * crop.side + x / ZOOM;
            if self.region[i] { [240, 170, 40] } else { normals[(x, y)] }
        });
        Ok(Image::from_fn(3 * side, side, |x, y| match x / side {
            0 => with_gripper[(x, y)],
            1 => vd_noc[(x - side, y)],
            _ => region[(x - 2 * side, y)],
        }))
    }

    /// Normals with the gripper.
    fn with_gripper(&self) -> Result<RgbImage, MeshError> {
        grasp_on(&self.crop, &self.camera_from_gripper, self.opening, &self.gripper)
    }
}

/// An object beside the experiences nearest to it (dissertation, figure 6.8): normals above, VD-NOC below, a column each, of crops of
/// the same size. The grippers are that of `grasp` (pose, opening in metres and gripper) and those of the experiences.
///
/// # Errors
/// [`MeshError`] for a gripper whose sizes are not finite.
pub fn picture_with_nearest(
    crop: &Crop,
    grasp: Option<(&Pose, f64, &Gripper)>,
    nearest: &[&Experience],
) -> Result<RgbImage, MeshError> {
    let first = match grasp {
        Some((pose, opening, gripper)) => grasp_on(crop, pose, opening, gripper)?,
        None => colors(crop, &crop.normals),
    };
    let mut columns = vec![[first, colors(crop, &crop.vd_noc)]];
    for experience in nearest {
        columns.push([experience.with_gripper()?, colors(&experience.crop, &experience.crop.vd_noc)]);
    }
    let side = crop.side * ZOOM;
    let at = |x: usize, y: usize| columns[x / side][y / side].get(x % side, y % side).copied();
    // Stored crops of another network may be smaller.
    Ok(Image::from_fn(columns.len() * side, 2 * side, |x, y| at(x, y).unwrap_or(OUTSIDE)))
}

/// Pixels of a picture for each pixel of a crop, along each axis.
const ZOOM: usize = 4;
/// Colour of pixels that do not show the object.
const OUTSIDE: [u8; 3] = [24; 3];

/// Values from -1 to 1 of a crop's pixels as colours.
fn colors(crop: &Crop, values: &[[f32; 3]]) -> RgbImage {
    let side = crop.side * ZOOM;
    Image::from_fn(side, side, |x, y| {
        let i = (y / ZOOM) * crop.side + x / ZOOM;
        if crop.mask[i] { values[i].map(|v| (127.5 + 127.5 * v).clamp(0.0, 255.0) as u8) } else { OUTSIDE }
    })
}

/// A crop's normals with a grasp.
fn grasp_on(crop: &Crop, pose: &Pose, opening: f64, gripper: &Gripper) -> Result<RgbImage, MeshError> {
    let side = crop.side * ZOOM;
    let drawn = [DrawnGrasp { camera_from_gripper: *pose, opening, color: [60, 220, 80] }];
    draw_grasps(&colors(crop, &crop.normals), None, &crop.camera.resize(side, side), gripper, &drawn)
}
