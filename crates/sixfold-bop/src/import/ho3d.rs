//! HO-3D (Hampali et al. 2020) as a BOP dataset: figure 4.13 of the dissertation.
//!
//! A split is `train` or `evaluation`; in it a folder for each sequence with `rgb/0000.png` (version 3: `.jpg`), `depth/0000.png`
//! and `meta/0000.pkl`. Depth is spread over the channels of a colour image: red + 256 green, in units of 0.125 mm. The meta
//! file is a pickled dictionary: `camMat` 3x3, `objRot` a rotation vector, `objTrans` in metres, `objName` such as
//! `003_cracker_box`; `objRot` is None where a frame is not annotated. Poses are in OpenGL's camera frame (y up, z back).

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use sixfold_geometry::nalgebra::{Quaternion, UnitQuaternion};
use sixfold_geometry::{Camera, DepthImage, Image, Pose, Progress, RgbImage, Vec3};
use sixfold_io::ImageFile;
use sixfold_mesh::{Mesh, Unit, read_mesh};

use super::pickle::{Item, PickledDict};
use super::{ImportSummary, Importer, NewFrame, Sequence, folders_in, images_in, of_pixels, read_bytes};
use crate::dataset_error::DatasetError;
use crate::json::At;
use crate::scene_files::GroundTruth;

/// Metres per unit of depth, as in the dataset's own scripts.
const DEPTH_SCALE: f64 = 0.000_124_986_647_279_001_77;
/// Largest meta file, bytes: they have about 10 kB.
const MAX_META: u64 = 4 << 20;

/// Which part of HO-3D is converted.
#[derive(Debug, Clone, PartialEq)]
pub struct Ho3dOptions {
    /// `train` or `evaluation`.
    pub split: String,
    /// Folder of the YCB-Video models: `003_cracker_box/textured_simple.obj` and so on, or a folder `models` with these.
    pub models: PathBuf,
    /// Only these sequences; all where empty.
    pub sequences: Vec<String>,
    /// Every n-th frame of a sequence, at least 1.
    pub every: usize,
}

/// The content of the meta file of an annotated frame.
#[derive(Debug, Clone, PartialEq)]
struct Meta {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    camera_from_object: Pose,
    object: String,
}

/// Converts a folder of HO-3D. An object's id is the number its YCB name begins with. Masks of visible parts are computed from the
/// depth images, because hands occlude objects.
///
/// # Errors
/// [`DatasetError`] naming file and field.
pub fn import_ho3d(
    source: &Path,
    out: &Path,
    options: &Ho3dOptions,
    progress: &dyn Progress,
) -> Result<ImportSummary, DatasetError> {
    let root = source.join(&options.split);
    let sequences = folders_in(&root, "a folder of sequences, such as train/ABF10")?;
    if let Some(missing) = options.sequences.iter().find(|s| !sequences.iter().any(|(name, _)| name == *s)) {
        let known: Vec<&str> = sequences.iter().map(|(name, _)| name.as_str()).collect();
        return Err(At::file(&root).error(
            "sequence",
            missing.as_str(),
            format!("one of {}", known.join(", ")),
        ));
    }
    let mut chosen = vec![];
    // Scenes are numbered among all sequences, so a sequence that is converted alone keeps its number.
    for (scene_id, (name, folder)) in (1..).zip(sequences) {
        if options.sequences.is_empty() || options.sequences.contains(&name) {
            let images = images_in(&folder.join("rgb"), options.every)?;
            chosen.push(Sequence { scene_id, name, folder, images });
        }
    }
    let mut importer = Importer::new(out, &options.split, DEPTH_SCALE);
    let mut models = BTreeMap::new();
    importer.add_sequences(
        &chosen,
        progress,
        |_| Ok(()),
        |importer, sequence, (), image| {
            add_frame(importer, &sequence.folder, image, &options.models, &mut models)
        },
    )?;
    importer.finish()
}

fn add_frame(
    importer: &mut Importer,
    sequence: &Path,
    (im_id, rgb): (u32, &Path),
    models: &Path,
    known: &mut BTreeMap<String, u32>,
) -> Result<(), DatasetError> {
    let stem = rgb.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let path = sequence.join("meta").join(format!("{stem}.pkl"));
    let Some(meta) = parse_meta(&read_bytes(&path, MAX_META)?, &path)? else {
        importer.leave_out();
        return Ok(());
    };
    let obj_id = match known.get(&meta.object) {
        Some(id) => *id,
        None => {
            let (id, mesh) = read_model(models, &meta.object, &path)?;
            importer.add_model(id, mesh)?;
            known.insert(meta.object.clone(), id);
            id
        }
    };
    let of_image = |error| DatasetError::of_image(im_id, error);
    let (width, height) = ImageFile::new(rgb).rgb().map_err(of_image)?.size();
    let (fx, fy, cx, cy) = (meta.fx, meta.fy, meta.cx, meta.cy);
    let camera = Camera { fx, fy, cx, cy, width, height, distortion: None };
    camera
        .check_lens()
        .map_err(|e| At::file(&path).error("camMat", e.to_string(), "a camera of this image"))?;
    let depth = sequence.join("depth").join(format!("{stem}.png"));
    let depth = match depth.is_file() {
        true => {
            let file = ImageFile::of_size(&depth, (width, height), rgb.display().to_string());
            Some(depth_of(&file.rgb().map_err(of_image)?))
        }
        false => None,
    };
    importer.add(&NewFrame {
        im_id,
        camera: &camera,
        rgb_file: Some(rgb),
        rgb: None,
        depth: depth.as_ref(),
        mask: None,
        ground_truth: &[GroundTruth::new(obj_id, meta.camera_from_object)],
    })
}

/// Metres from the channels of a depth file.
fn depth_of(image: &RgbImage) -> DepthImage {
    Image::from_fn(image.width(), image.height(), |x, y| {
        let [red, green, _] = image[(x, y)];
        (f64::from(u32::from(red) + 256 * u32::from(green)) * DEPTH_SCALE) as f32
    })
}

/// The model of a YCB object, with the number that its name begins with.
fn read_model(folder: &Path, name: &str, meta: &Path) -> Result<(u32, Mesh), DatasetError> {
    let is_plain = name.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_' || b == b'-');
    let digits: String = name.chars().take_while(char::is_ascii_digit).collect();
    let Some(id) = digits.parse().ok().filter(|_| is_plain) else {
        let expected = "the name of a YCB object, such as 003_cracker_box";
        return Err(At::file(meta).error("objName", format!("{name:?}"), expected));
    };
    let places = [folder.join(name), folder.join("models").join(name)];
    let files =
        places.iter().flat_map(|dir| ["textured_simple.obj", "textured.obj"].map(|file| dir.join(file)));
    let Some(file) = files.into_iter().find(|file| file.is_file()) else {
        return Err(DatasetError::Missing {
            path: folder.join(name).join("textured_simple.obj"),
            what: "the model of an object",
            advice: "give the folder of the YCB-Video models",
        });
    };
    let mesh = read_mesh(&file, Unit::Metre).map_err(|e| DatasetError::Model(Box::new(e)))?;
    Ok((id, mesh))
}

/// Reads a meta file; `None` where the frame is not annotated.
fn parse_meta(bytes: &[u8], path: &Path) -> Result<Option<Meta>, DatasetError> {
    let at = At::file(path);
    let meta = PickledDict::parse(bytes)
        .map_err(|e| at.error(format!("(pickle, byte {})", e.at), e.found, e.expected))?;
    let get = |field: &str, expected: &'static str| {
        meta.get(field).ok_or_else(|| at.error(field, "nothing", expected))
    };
    if get("objRot", "a rotation vector, or None")? == Item::None {
        return Ok(None);
    }
    let array = |field: &str, count: usize, expected: &'static str| match get(field, expected)? {
        Item::Array(a) if a.values.len() == count && a.values.iter().all(|v| v.is_finite()) => {
            Ok(a.values.clone())
        }
        Item::Array(a) if a.values.len() == count => {
            Err(at.error(field, "numbers that are not finite", expected))
        }
        other => Err(at.error(field, described(&other), expected)),
    };
    let rotation = array("objRot", 3, "an array of 3 numbers: a rotation vector")?;
    let translation = array("objTrans", 3, "an array of 3 numbers: metres")?;
    let k = array("camMat", 9, "an array of 3x3 numbers")?;
    let Item::Text(object) = get("objName", "the name of a YCB object")? else {
        let found = described(&get("objName", "text")?);
        return Err(at.error("objName", found, "the name of a YCB object, such as 003_cracker_box"));
    };
    let rotation = UnitQuaternion::from_scaled_axis(Vec3::from_row_slice(&rotation));
    let gl_from_object = Pose::new(rotation, Vec3::from_row_slice(&translation));
    // OpenGL's camera looks along -z with y up: half a turn about x, exactly.
    let camera_from_gl = UnitQuaternion::new_unchecked(Quaternion::new(0.0, 1.0, 0.0, 0.0));
    let camera_from_object = Pose::new(camera_from_gl, Vec3::zeros()) * gl_from_object;
    of_pixels(&at, "camMat", (k[0], k[4]))?;
    let object = object.to_owned();
    Ok(Some(Meta { fx: k[0], fy: k[4], cx: k[2], cy: k[5], camera_from_object, object }))
}

fn described(item: &Item<'_>) -> String {
    match item {
        Item::None => "None".into(),
        Item::Number(number) => format!("the number {number}"),
        Item::Text(_) => "text".into(),
        Item::Array(array) => format!("an array of shape {:?}", array.shape),
        Item::Other(what) => (*what).into(),
    }
}
