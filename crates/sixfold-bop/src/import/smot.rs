//! SMOT, the dissertation's dataset of chapter 4 (sections 4.3.2 and 4.3.7), as a BOP dataset.
//!
//! `camera_intrinsic.json` holds width, height and `intrinsic_matrix`, nine numbers column by column. A split (`train`, `test`) has
//! folders `seq1`, `seq2`, ... with `scene_gt.json` as in BOP, but in metres, `color/000000.png` and `depth/000000.png` in
//! millimetres. Models are `models/obj_01.ply` in metres. This is how the author's script reads it (kirumang/NOL,
//! `process_SMOT.py`). The script opens the sequences of `train` only; those of `test` are assumed to have the same layout.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::Value;
use sixfold_geometry::{Camera, Mat3, Pose, Progress, Vec3};
use sixfold_io::ImageFile;
use sixfold_mesh::{Unit, read_mesh};

use super::{
    ImportSummary, Importer, NewFrame, Sequence, folders_in, image_size, images_in, of_pixels, read_bytes,
};
use crate::dataset_error::DatasetError;
use crate::json::{At, by_image, describe, parse};
use crate::scene_files::GroundTruth;

/// Metres per unit of depth.
const DEPTH_SCALE: f64 = 1e-3;
/// Longest plausible translation in metres: longer ones are not in metres.
const FARTHEST: f64 = 20.0;

/// Which part of SMOT is converted.
#[derive(Debug, Clone, PartialEq)]
pub struct SmotOptions {
    /// `train` or `test`.
    pub split: String,
    /// Every n-th frame of a sequence, at least 1.
    pub every: usize,
}

/// Converts a split of SMOT. A scene has its sequence's number; masks of visible parts are computed from the depth images.
///
/// # Errors
/// [`DatasetError`] naming file and field.
pub fn import_smot(
    source: &Path,
    out: &Path,
    options: &SmotOptions,
    progress: &dyn Progress,
) -> Result<ImportSummary, DatasetError> {
    let camera = read_camera(&source.join("camera_intrinsic.json"))?;
    let root = source.join(&options.split);
    let sequences = folders_in(&root, "a folder of sequences, such as train/seq1")?;
    let mut chosen = vec![];
    for (name, folder) in sequences {
        let number = name.strip_prefix("seq").and_then(|number| number.parse().ok());
        let Some(scene_id) = number else {
            return Err(At::file(&root).error("(folder)", name, "seq and a number, such as seq1"));
        };
        let images = images_in(&folder.join("color"), options.every)?;
        chosen.push(Sequence { scene_id, name, folder, images });
    }
    let mut importer = Importer::new(out, &options.split, DEPTH_SCALE);
    let truth_of = |sequence: &Sequence| {
        let path = sequence.folder.join("scene_gt.json");
        parse_truth(&read_bytes(&path, sixfold_io::limits::LARGE_TEXT)?, &path)
    };
    importer.add_sequences(&chosen, progress, truth_of, |importer, sequence, truth, (im_id, rgb)| {
        match truth.get(&im_id) {
            Some(truth) => add_frame(importer, source, &sequence.folder, (im_id, rgb), &camera, truth)?,
            None => importer.leave_out(),
        }
        Ok(())
    })?;
    importer.finish()
}

fn add_frame(
    importer: &mut Importer,
    source: &Path,
    sequence: &Path,
    (im_id, rgb): (u32, &Path),
    camera: &Camera,
    truth: &[GroundTruth],
) -> Result<(), DatasetError> {
    for obj_id in truth.iter().map(|g| g.obj_id) {
        if !importer.has_model(obj_id) {
            let file = source.join("models").join(format!("obj_{obj_id:02}.ply"));
            let mesh = read_mesh(&file, Unit::Metre).map_err(|e| DatasetError::Model(Box::new(e)))?;
            importer.add_model(obj_id, mesh)?;
        }
    }
    let of_image = |error| DatasetError::of_image(im_id, error);
    let (size, from) = ((camera.width, camera.height), "camera_intrinsic.json");
    ImageFile::of_size(rgb, size, from).rgb().map_err(of_image)?;
    let depth = sequence.join("depth").join(format!("{im_id:06}.png"));
    let depth = match depth.is_file() {
        true => Some(ImageFile::of_size(&depth, size, from).depth(DEPTH_SCALE).map_err(of_image)?),
        false => None,
    };
    importer.add(&NewFrame {
        im_id,
        camera,
        rgb_file: Some(rgb),
        rgb: None,
        depth: depth.as_ref(),
        mask: None,
        ground_truth: truth,
    })
}

/// The camera of all images.
fn read_camera(path: &Path) -> Result<Camera, DatasetError> {
    let at = At::file(path);
    let json = parse(&read_bytes(path, sixfold_io::limits::SMALL_TEXT)?, path)?;
    let map = at.object(&json)?;
    let (width, height) = image_size(&at, map)?;
    let expected = "9 numbers, column by column";
    let k: [f64; 9] = at.numbers("intrinsic_matrix", at.get(map, "intrinsic_matrix", expected)?)?;
    of_pixels(&at, "intrinsic_matrix", (k[0], k[4]))?;
    let camera = Camera { fx: k[0], fy: k[4], cx: k[6], cy: k[7], width, height, distortion: None };
    camera.check().map_err(|e| {
        at.error("intrinsic_matrix", e.to_string(), "column by column: fx 0 0, 0 fy 0, cx cy 1")
    })?;
    Ok(camera)
}

/// The poses of a sequence by image.
fn parse_truth(text: &[u8], path: &Path) -> Result<BTreeMap<u32, Vec<GroundTruth>>, DatasetError> {
    let json = parse(text, path)?;
    let mut images = BTreeMap::new();
    for (im_id, value) in by_image(&json, path)? {
        let at = At::image(path, im_id);
        let entries = at.list(value)?.iter().enumerate();
        let poses = entries.map(|(index, entry)| pose_of(&at.entry(index), entry));
        images.insert(im_id, poses.collect::<Result<_, _>>()?);
    }
    Ok(images)
}

fn pose_of(at: &At<'_>, entry: &Value) -> Result<GroundTruth, DatasetError> {
    let map = at.object(entry)?;
    let id = at.get(map, "obj_id", "a whole number")?;
    // Some files store the id as text.
    let obj_id = match id.as_str().map(str::parse) {
        Some(Ok(id)) => id,
        Some(Err(_)) => return Err(at.error("obj_id", describe(id), "a whole number")),
        None => at.id("obj_id", id)?,
    };
    let r: [f64; 9] =
        at.numbers("cam_R_m2c", at.get(map, "cam_R_m2c", "a rotation, 9 numbers row by row")?)?;
    let t: [f64; 3] =
        at.numbers("cam_t_m2c", at.get(map, "cam_t_m2c", "a translation, 3 numbers in metres")?)?;
    if t.iter().any(|t| t.abs() > FARTHEST) {
        return Err(at.error(
            "cam_t_m2c",
            format!("{t:?}"),
            "metres, at most 20; these look like millimetres",
        ));
    }
    let written = Mat3::from_row_slice(&r);
    let camera_from_object = Pose::from_parts(&written, Vec3::from(t)).map_err(|reason| {
        at.error("cam_R_m2c", format!("{r:?} ({reason})"), "a rotation: orthonormal, determinant 1")
    })?;
    Ok(GroundTruth { obj_id, camera_from_object, rotation_as_written: Some(written) })
}
