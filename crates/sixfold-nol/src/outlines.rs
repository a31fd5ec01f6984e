//! Outlines of objects in photographs, at the given and at the refined poses.

use std::path::Path;

use sixfold_data::RoughImages;
use sixfold_geometry::{Camera, Pose, RgbImage};
use sixfold_mesh::Mesh;
use sixfold_render::render_depth;

use crate::pose_file::{PoseFile, PoseFileError};
use crate::source::SourceView;

/// Side of an image in pixels.
const SIDE: usize = 160;
const GIVEN: [u8; 3] = [255, 220, 0];
const REFINED: [u8; 3] = [0, 255, 120];

impl PoseFile {
    /// Two rows of square images for each object, with a column per photograph: above the outline at the given pose, below at the
    /// refined one. Each image has a text to write into it, often empty. `file` is used in errors.
    ///
    /// # Errors
    /// When a pose does not belong to the images, or an image does not show its object.
    pub fn outlines(
        &self,
        images: &RoughImages,
        file: &Path,
    ) -> Result<Vec<Vec<(RgbImage, String)>>, PoseFileError> {
        let content = |reason| PoseFileError::Content { path: file.to_owned(), reason };
        let mut rows = vec![];
        let mut records = self.photographs.iter();
        for object in &images.objects {
            let (mut given, mut refined) = (vec![], vec![]);
            for (image, record) in object.images.iter().zip(records.by_ref()) {
                let pose = record.pose().map_err(content)?;
                let view = SourceView::new(&image.posed, &object.mesh, SIDE)?;
                let drawn = |pose: &Pose, color| {
                    let mut picture = view.patch.to_rgb();
                    draw_outline(&mut picture, &object.mesh, &view.camera, pose, color);
                    picture
                };
                let text = |text: &str| if given.is_empty() { text.to_owned() } else { String::new() };
                let texts = [text("given"), text("refined")];
                let [of_given, of_refined] = texts;
                given.push((drawn(image.posed.camera_from_object(), GIVEN), of_given));
                refined.push((drawn(&pose, REFINED), of_refined));
            }
            rows.extend([given, refined]);
        }
        Ok(rows)
    }
}

/// Draws the outline of a mesh into an image.
fn draw_outline(image: &mut RgbImage, mesh: &Mesh, camera: &Camera, pose: &Pose, color: [u8; 3]) {
    let covered = render_depth(mesh, pose, camera).map(|depth| *depth > 0.0);
    let (width, height) = image.size();
    for y in 1..height - 1 {
        for x in 1..width - 1 {
            let border = [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)];
            if covered[(x, y)] && border.iter().any(|neighbour| !covered[*neighbour]) {
                image[(x, y)] = color;
            }
        }
    }
}
