//! Source images of NOL in the author's HDF5 files (kirumang/NOL) as a BOP dataset, for `sixfold synthesize`.
//!
//! A file is one object: `vertices_3d` Vx3 in metres, `faces` Fx3, `images` NxSxSx3 (0 to 1, or 0 to 255 as integers), `poses`
//! Nx4x4 in metres, `masks` NxSxSx1, `bboxes` Nx4 (first row, first column, last row, last column, both last ones exclusive): the
//! part of the camera's image that was resized to SxS. In the BOP dataset each image has its own camera, that of its part.

use std::path::{Path, PathBuf};

use sixfold_geometry::nalgebra::Matrix4;
use sixfold_geometry::{Camera, Image, Mask, Pose, Progress, Rect, RgbImage, Vec3};
use sixfold_mesh::{Mesh, check_size};

use super::hdf5::{Dataset, Hdf5Error, Hdf5File};
use super::{ImportSummary, Importer, NewFrame, image_size, of_pixels, read_bytes};
use crate::dataset_error::DatasetError;
use crate::json::{At, parse};
use crate::scene_files::GroundTruth;

/// Largest file, bytes: sixteen images of 256x256 pixels take 25 MB.
const MAX_FILE: u64 = 256 << 20;

/// Options for what a NOL file does not contain.
#[derive(Debug, Clone, PartialEq)]
pub struct NolOptions {
    /// The camera of the whole images: `width`, `height` and `cam_K`, nine numbers row by row, as in the author's `cfg_camera`.
    pub camera: PathBuf,
    /// Id of the object; `None`: the number that the file's name ends with, or 1.
    pub obj_id: Option<u32>,
    /// Name of the split.
    pub split: String,
}

/// Converts a file of source images: scene 1, images from 0 on.
///
/// # Errors
/// [`DatasetError`] naming file and field.
pub fn import_nol(
    source: &Path,
    out: &Path,
    options: &NolOptions,
    progress: &dyn Progress,
) -> Result<ImportSummary, DatasetError> {
    let camera = read_camera(&options.camera)?;
    let sources = parse_sources(&read_bytes(source, MAX_FILE)?, source, &camera)?;
    let stem = source.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let digits = stem.trim_start_matches(|c: char| !c.is_ascii_digit());
    let obj_id = options.obj_id.or_else(|| digits.parse().ok()).unwrap_or(1);
    let mut importer = Importer::new(out, &options.split, 1e-3);
    importer.begin_scene(1, &stem);
    importer.add_model(obj_id, sources.mesh)?;
    let total = sources.images.len();
    for (im_id, image) in (0..).zip(sources.images) {
        importer.add(&NewFrame {
            im_id,
            camera: &image.camera,
            rgb_file: None,
            rgb: Some(&image.rgb),
            depth: None,
            mask: Some(&image.mask),
            ground_truth: &[GroundTruth::new(obj_id, image.camera_from_object)],
        })?;
        if !progress.report(im_id as usize + 1, total) {
            return Err(DatasetError::Stopped);
        }
    }
    importer.finish_scene()?;
    importer.finish()
}

/// A camera file in the author's form. The last row of the matrix is not read: one of the author's files has zeros there.
fn read_camera(path: &Path) -> Result<Camera, DatasetError> {
    let at = At::file(path);
    let json = parse(&read_bytes(path, sixfold_io::limits::SMALL_TEXT)?, path)?;
    let map = at.object(&json)?;
    let (width, height) = image_size(&at, map)?;
    let k: [f64; 9] = at.numbers("cam_K", at.get(map, "cam_K", "9 numbers, row by row")?)?;
    of_pixels(&at, "cam_K", (k[0], k[4]))?;
    let camera = Camera { fx: k[0], fy: k[4], cx: k[2], cy: k[5], width, height, distortion: None };
    camera.check().map_err(|e| at.error("cam_K", e.to_string(), "row by row: fx 0 cx, 0 fy cy"))?;
    Ok(camera)
}

struct Sources {
    mesh: Mesh,
    images: Vec<SourceImage>,
}

struct SourceImage {
    camera: Camera,
    rgb: RgbImage,
    mask: Mask,
    camera_from_object: Pose,
}

/// Reads a file's datasets and brings them into shape.
fn parse_sources(bytes: &[u8], path: &Path, whole: &Camera) -> Result<Sources, DatasetError> {
    let at = At::file(path);
    let field = |e: Hdf5Error| at.error(e.field, e.found, e.expected);
    let file = Hdf5File::parse(bytes).map_err(field)?;
    let dataset = |name: &str| file.dataset(name).map_err(field);
    let shaped = |name: &str, fits: &dyn Fn(&[usize]) -> bool, expected: &str| {
        let read = dataset(name)?;
        let finite = read.values.iter().all(|v| v.is_finite());
        match fits(&read.shape) && finite {
            true => Ok(read),
            false if finite => Err(at.error(name, format!("shape {:?}", read.shape), expected)),
            false => Err(at.error(name, "numbers that are not finite", expected)),
        }
    };
    let vertices = shaped("vertices_3d", &|s| matches!(s, [(1..), 3]), "Vx3, metres")?;
    let faces = shaped("faces", &|s| matches!(s, [(1..), 3]), "Fx3, indices of vertices")?;
    let mesh = mesh_of(&vertices, &faces, &at)?;
    let images = shaped("images", &|s| matches!(s, [(1..), h @ (1..), w, 3] if h == w), "NxSxSx3")?;
    let (count, side) = (images.shape[0], images.shape[1]);
    sixfold_io::check_pixels(side, side, sixfold_io::max_pixels())
        .map_err(|reason| at.error("images", reason, "the size of an image"))?;
    let poses = shaped("poses", &|s| *s == [count, 4, 4], "Nx4x4, one for each image")?;
    let masks = shaped("masks", &|s| *s == [count, side, side, 1] || *s == [count, side, side], "NxSxSx1")?;
    let boxes =
        shaped("bboxes", &|s| *s == [count, 4], "Nx4: first row, first column, last row, last column")?;
    let factor = if images.whole { 1.0 } else { 255.0 };
    let one = |i: usize| -> Result<SourceImage, DatasetError> {
        let camera = crop_camera(whole, &boxes.values[4 * i..4 * i + 4], side).ok_or_else(|| {
            let found = format!("[{i}] = {:?}", &boxes.values[4 * i..4 * i + 4]);
            at.error("bboxes", found, format!("a part of {}x{} pixels", whole.width, whole.height))
        })?;
        let matrix = Matrix4::from_row_slice(&poses.values[16 * i..16 * (i + 1)]);
        let camera_from_object = Pose::from_matrix(&matrix)
            .map_err(|reason| at.error("poses", format!("[{i}]: {reason}"), "a rotation and metres"))?;
        let pixels = side * side;
        let colours = &images.values[3 * pixels * i..3 * pixels * (i + 1)];
        let channel = |v: f64| (v * factor).round().clamp(0.0, 255.0) as u8;
        let rgb = Image::from_fn(side, side, |x, y| {
            std::array::from_fn(|c| channel(colours[3 * (y * side + x) + c]))
        });
        let visible = &masks.values[pixels * i..pixels * (i + 1)];
        let mask = Mask::from_fn(side, side, |x, y| visible[y * side + x] > 0.5);
        Ok(SourceImage { camera, rgb, mask, camera_from_object })
    };
    Ok(Sources { mesh, images: (0..count).map(one).collect::<Result<_, _>>()? })
}

fn mesh_of(vertices: &Dataset, faces: &Dataset, at: &At<'_>) -> Result<Mesh, DatasetError> {
    let index = |v: &f64| (v.fract() == 0.0 && (0.0..f64::from(u32::MAX)).contains(v)).then_some(*v as u32);
    let triangles: Option<Vec<[u32; 3]>> =
        faces.values.chunks_exact(3).map(|f| Some([index(&f[0])?, index(&f[1])?, index(&f[2])?])).collect();
    let Some(triangles) = triangles else {
        return Err(at.error("faces", "numbers that are no indices", "indices of vertices, from 0"));
    };
    let points = vertices.values.chunks_exact(3).map(Vec3::from_row_slice).collect();
    let mesh =
        Mesh::new(points, triangles).map_err(|e| at.error("vertices_3d, faces", e.to_string(), "a mesh"))?;
    check_size(&mesh, &at.path.display().to_string(), sixfold_mesh::Unit::Metre)
        .map_err(|e| DatasetError::Model(Box::new(e)))?;
    Ok(mesh)
}

/// The camera of the part `[first row, first column, last row, last column]` of an image, resized to `side` pixels.
fn crop_camera(whole: &Camera, part: &[f64], side: usize) -> Option<Camera> {
    let [top, left, bottom, right] = *part else { return None };
    let inside = 0.0 <= top && 0.0 <= left && bottom <= whole.height as f64 && right <= whole.width as f64;
    let whole_numbers = part.iter().all(|v| v.fract() == 0.0);
    if !(inside && whole_numbers && top < bottom && left < right) {
        return None;
    }
    let rect = Rect { x: left, y: top, width: right - left, height: bottom - top };
    let camera = whole.crop(&rect).resize(side, side);
    (0.5..=2.0).contains(&(camera.fx / camera.fy)).then_some(camera)
}
