//! Object coordinates of a view as an image of 16 bits: training data of Pix2Pose.

use std::io;
use std::path::Path;

use sixfold_geometry::{Camera, Pose, Vec3};
use sixfold_io::write_atomically_with;
use sixfold_mesh::Mesh;
use sixfold_render::{BoundingBoxScale, RenderOptions, SceneObject, VisibilityBuffer};

/// Writes object coordinates as colours of 16 bits: -1 to 1 over the object's bounding box becomes 1 to 65535, 0 is outside the
/// object.
///
/// # Errors
/// The system's error.
pub(crate) fn write_coordinates(path: &Path, mesh: &Mesh, camera: &Camera, pose: &Pose) -> io::Result<()> {
    let (low, high) = mesh.bounding_box();
    let scale = BoundingBoxScale::of_corners(&low, &high);
    let mut frame = VisibilityBuffer::new(camera);
    let objects = [SceneObject { mesh, camera_from_object: *pose }];
    frame.render(&objects, &RenderOptions::default());
    let points = frame.object_coordinates(&objects);
    let (width, height) = points.size();
    let mut data = Vec::with_capacity(3 * width * height);
    for point in points.as_slice() {
        if point[0].is_nan() {
            data.extend([0u16; 3]);
            continue;
        }
        let n = scale.normalise(&Vec3::from(point.map(f64::from)));
        data.extend([n.x, n.y, n.z].map(|v| 1 + ((v.clamp(-1.0, 1.0) + 1.0) * 0.5 * 65534.0).round() as u16));
    }
    let image = image::ImageBuffer::<image::Rgb<u16>, _>::from_raw(width as u32, height as u32, data)
        .ok_or_else(|| io::Error::other("coordinates have another size than their image"))?;
    if let Some(parent) = path.parent() {
        std::fs::create_dir_all(parent)?;
    }
    write_atomically_with(path, |file| {
        let mut bytes = io::Cursor::new(vec![]);
        image.write_to(&mut bytes, image::ImageFormat::Png).map_err(io::Error::other)?;
        io::Write::write_all(file, bytes.get_ref())
    })
}
