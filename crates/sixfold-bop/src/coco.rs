//! Detections and their ground truth in COCO's JSON, with BOP's `scene_id` beside `image_id`.
//!
//! Detections: a list of `{scene_id, image_id, category_id, score, bbox: [x, y, w, h], segmentation, time}`; ground
//! truth: `scene_gt_coco.json` with `images`, `annotations` and `categories`. Segmentations are run-length encoded,
//! compressed or not.

use std::path::Path;

use serde_json::{Map, Value, json};
use sixfold_geometry::Rect;

use crate::coco_rows::DetectionRows;
use crate::dataset::{BopDataset, list_ids};
use crate::dataset_error::DatasetError;
use crate::json::{At, describe, parse};
use crate::rle::Rle;

/// A detection: a box, a mask or both.
#[derive(Debug, Clone, PartialEq)]
pub struct Detection {
    /// The scene; 0 where the file has none.
    pub scene_id: u32,
    /// The image.
    pub image_id: u32,
    /// The object.
    pub category_id: u32,
    /// Confidence.
    pub score: f64,
    /// The box in pixels.
    pub bbox: Option<Rect>,
    /// The mask.
    pub segmentation: Option<Rle>,
    /// Seconds that all detections of this image took together.
    pub time: Option<f64>,
}

/// How a detection was changed on reading.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Adjustment {
    /// The box extended beyond the image's border and was clipped to it.
    Clipped,
    /// Box and mask lie outside the image or are empty; the detection was left out.
    Outside,
    /// The detection is invalid and was left out (lenient reading only).
    Broken,
    /// Detections without a scene were assigned to the dataset's only scene ([`BopDataset::detections`]).
    Scene,
}

/// A detection that was changed or left out on reading.
#[derive(Debug, Clone, PartialEq)]
pub struct AdjustedDetection {
    /// Its index in the file, from zero.
    pub index: usize,
    /// The kind of adjustment.
    pub adjustment: Adjustment,
    /// The place and the reason.
    pub message: String,
}

/// Detections read from a file.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Detections {
    /// The valid detections, in the order of the file.
    pub detections: Vec<Detection>,
    /// Detections that were clipped or left out.
    pub adjusted: Vec<AdjustedDetection>,
    /// Indices in `detections` of those without a scene, as in COCO's own files; their scene is 0.
    pub without_scene: Vec<usize>,
}

/// Options for reading detections.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ReadDetections {
    /// Leave invalid detections out and report them, rather than refuse the file.
    pub lenient: bool,
    /// Width and height of the images, where known: boxes are clipped to it.
    pub image_size: Option<(usize, usize)>,
}

/// Reads a file of detections.
///
/// # Errors
/// [`DatasetError`] naming file, entry and field.
pub fn read_detections(path: &Path, options: &ReadDetections) -> Result<Detections, DatasetError> {
    let text = sixfold_io::read_regular(path, sixfold_io::limits::LARGE_TEXT)
        .map_err(|source| DatasetError::Read { path: path.to_owned(), source })?;
    parse_detections(&text, path, options)
}

/// Parses detections; `path` is for messages.
///
/// # Errors
/// [`DatasetError`] naming entry and field.
pub fn parse_detections(
    text: &[u8],
    path: &Path,
    options: &ReadDetections,
) -> Result<Detections, DatasetError> {
    let json = parse(text, path)?;
    let at = At::file(path);
    let mut out = Detections::default();
    for (index, value) in at.list(&json)?.iter().enumerate() {
        let at = at.entry(index);
        let mut detection = match parse_detection(&at, value, options) {
            Ok(detection) => detection,
            Err(error) if options.lenient => {
                let adjustment = Adjustment::Broken;
                out.adjusted.push(AdjustedDetection { index, adjustment, message: error.to_string() });
                continue;
            }
            Err(error) => return Err(error),
        };
        let mut report = |adjustment, what: &str| {
            let image_id = detection.image_id;
            let message = format!("{}: entry {index}, image {image_id}: {what}", path.display());
            out.adjusted.push(AdjustedDetection { index, adjustment, message });
        };
        if let (Some(bbox), Some((width, height))) = (detection.bbox, options.image_size) {
            let image = Rect { x: 0.0, y: 0.0, width: width as f64, height: height as f64 };
            match bbox.intersect(&image) {
                Some(inside) if inside == bbox => {}
                // Clipping recomputes the corners, which can change the last digits: report only a box that lost area.
                Some(inside) if bbox.area() - inside.area() <= 1e-9 * bbox.area() => {}
                Some(inside) => {
                    report(Adjustment::Clipped, &format!("the box {} was clipped to the image", show(&bbox)));
                    detection.bbox = Some(inside);
                }
                None => {
                    let what = format!("the box {} lies outside the {width}x{height} image", show(&bbox));
                    report(Adjustment::Outside, &what);
                    continue;
                }
            }
        } else if let Some(bbox) = detection.bbox
            && bbox.area() == 0.0
        {
            report(Adjustment::Outside, &format!("the box {} is empty", show(&bbox)));
            continue;
        }
        if value.get("scene_id").is_none() {
            out.without_scene.push(out.detections.len());
        }
        out.detections.push(detection);
    }
    Ok(out)
}

impl BopDataset {
    /// Reads a file of detections in this dataset's images. COCO has no scenes: detections without a scene are assigned to
    /// the dataset's only scene, and this is reported. If the dataset has several scenes, such a file is refused.
    ///
    /// # Errors
    /// [`DatasetError`] naming file, entry and field.
    pub fn detections(&self, file: &Path, lenient: bool) -> Result<Detections, DatasetError> {
        let options = ReadDetections { lenient, image_size: self.image_size() };
        let mut read = read_detections(file, &options)?;
        let (Some(&first), scenes) = (read.without_scene.first(), self.scene_ids()) else { return Ok(read) };
        if scenes.contains(&0) {
            return Ok(read);
        }
        let [scene_id] = scenes[..] else {
            let (count, all) = (read.without_scene.len(), read.detections.len());
            let found = format!(
                "nothing in {count} of {all} detections, the first of image {}",
                read.detections[first].image_id
            );
            let known = list_ids(scenes.iter());
            let expected = format!("the scene of each: add \"scene_id\", one of {known}");
            return Err(At::file(file).error("scene_id", found, expected));
        };
        for &place in &read.without_scene {
            read.detections[place].scene_id = scene_id;
        }
        let message = format!(
            "{}: {} detections name no scene_id and are taken for scene {scene_id}, the only one of the dataset",
            file.display(),
            read.without_scene.len()
        );
        read.adjusted.push(AdjustedDetection { index: first, adjustment: Adjustment::Scene, message });
        Ok(read)
    }
}

fn show(r: &Rect) -> String {
    format!("[{}, {}, {}, {}]", r.x, r.y, r.width, r.height)
}

fn present<'v>(map: &'v Map<String, Value>, field: &str) -> Option<&'v Value> {
    map.get(field).filter(|v| !v.is_null() && v.as_array().is_none_or(|a| !a.is_empty()))
}

/// Largest coordinate or size of a box, in pixels: larger numbers could not be added without loss of precision.
const FURTHEST: f64 = 1e6;

fn parse_bbox(at: &At<'_>, value: &Value) -> Result<Rect, DatasetError> {
    let [x, y, width, height] = at.numbers("bbox", value)?;
    if width < 0.0 || height < 0.0 {
        let found = format!("width {width}, height {height}");
        return Err(at.error("bbox", found, "[x, y, width, height] with width and height from 0"));
    }
    if let Some(far) = [x, y, width, height].into_iter().find(|v| v.abs() > FURTHEST) {
        return Err(at.error("bbox", far.to_string(), "pixels, at most a million"));
    }
    Ok(Rect { x, y, width, height })
}

fn parse_detection(at: &At<'_>, value: &Value, options: &ReadDetections) -> Result<Detection, DatasetError> {
    let map = at.object(value)?;
    let id = |field: &str| at.id(field, at.get(map, field, "an id")?);
    let bbox = present(map, "bbox").map(|v| parse_bbox(at, v)).transpose()?;
    let segmentation = present(map, "segmentation").map(|v| parse_rle(at, v)).transpose()?;
    if bbox.is_none() && segmentation.is_none() {
        return Err(at.error("bbox", "neither bbox nor segmentation", "at least one of them"));
    }
    if let (Some(rle), Some((width, height))) = (&segmentation, options.image_size)
        && (rle.width() as usize, rle.height() as usize) != (width, height)
    {
        let found = format!("[{}, {}]", rle.height(), rle.width());
        return Err(at.error("segmentation.size", found, format!("[{height}, {width}], the image's")));
    }
    Ok(Detection {
        scene_id: if map.contains_key("scene_id") { id("scene_id")? } else { 0 },
        image_id: id("image_id")?,
        category_id: id("category_id")?,
        score: at.number("score", at.get(map, "score", "a number")?)?,
        bbox,
        segmentation,
        time: match map.get("time").filter(|v| !v.is_null()) {
            Some(value) => Some(at.number("time", value)?).filter(|t| *t >= 0.0),
            None => None,
        },
    })
}

fn parse_rle(at: &At<'_>, value: &Value) -> Result<Rle, DatasetError> {
    let bad = |found: String| {
        at.error("segmentation", found, "run lengths {\"size\": [h, w], \"counts\": ...}; no polygons")
    };
    let map = value.as_object().ok_or_else(|| bad(describe(value)))?;
    let size = map.get("size").and_then(Value::as_array).filter(|s| s.len() == 2);
    let side = |i: usize| size.and_then(|s| s[i].as_u64());
    let (Some(height), Some(width)) = (side(0), side(1)) else {
        return Err(bad(map.get("size").map_or("no size".to_owned(), |s| format!("size {s}"))));
    };
    let rle = match map.get("counts") {
        Some(Value::String(text)) => Rle::from_compressed(width, height, text),
        Some(Value::Array(runs)) => {
            let runs: Option<Vec<u32>> =
                runs.iter().map(|r| r.as_u64().and_then(|r| u32::try_from(r).ok())).collect();
            Rle::new(width, height, runs.ok_or_else(|| bad("counts that are no run lengths".into()))?)
        }
        other => return Err(bad(other.map_or("no counts".to_owned(), describe))),
    };
    rle.map_err(|e| bad(e.to_string()))
}

fn rle_json(rle: &Rle) -> Value {
    json!({ "size": [rle.height(), rle.width()], "counts": rle.to_compressed() })
}

/// Writes detections in BOP's form, masks compressed.
///
/// # Errors
/// [`DatasetError::Write`].
pub fn write_detections(path: &Path, detections: &[Detection]) -> Result<(), DatasetError> {
    let mut rows = DetectionRows::default();
    rows.add(detections);
    rows.write(path)
}

/// A detection as a row of its file.
pub(crate) fn detection_row(d: &Detection) -> String {
    let mut map = Map::new();
    map.insert("scene_id".into(), json!(d.scene_id));
    map.insert("image_id".into(), json!(d.image_id));
    map.insert("category_id".into(), json!(d.category_id));
    map.insert("score".into(), json!(d.score));
    if let Some(b) = &d.bbox {
        map.insert("bbox".into(), json!([b.x, b.y, b.width, b.height]));
    }
    if let Some(rle) = &d.segmentation {
        map.insert("segmentation".into(), rle_json(rle));
    }
    map.insert("time".into(), json!(d.time.unwrap_or(-1.0)));
    Value::Object(map).to_string()
}

/// One annotated object of the ground truth.
#[derive(Debug, Clone, PartialEq)]
pub struct Annotation {
    /// The scene.
    pub scene_id: u32,
    /// The image.
    pub image_id: u32,
    /// The object.
    pub category_id: u32,
    /// The box.
    pub bbox: Rect,
    /// Area in pixels; it decides whether the object counts as small, medium or large.
    pub area: f64,
    /// A region with many objects: detections in it count neither as right nor as wrong.
    pub iscrowd: bool,
    /// The mask.
    pub segmentation: Option<Rle>,
}

/// Ground truth of detections: images and the objects in them.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CocoGroundTruth {
    /// `(scene_id, image_id)` of every image, including those without objects.
    pub images: Vec<(u32, u32)>,
    /// The annotated objects.
    pub annotations: Vec<Annotation>,
}

impl CocoGroundTruth {
    /// Adds the content of a `scene_gt_coco.json`; `path` is for messages.
    ///
    /// An `ignore` flag is ignored, as in pycocotools, which overwrites it with `iscrowd`.
    ///
    /// # Errors
    /// [`DatasetError`] naming entry and field.
    pub fn add_scene(&mut self, scene_id: u32, text: &[u8], path: &Path) -> Result<(), DatasetError> {
        let json = parse(text, path)?;
        let whole = At::file(path);
        let map = whole.object(&json)?;
        let images = whole.list(whole.get(map, "images", "a list of images")?)?;
        for (index, image) in images.iter().enumerate() {
            let at = whole.entry(index);
            let image = at.object(image)?;
            self.images.push((scene_id, at.id("images.id", at.get(image, "id", "an image id")?)?));
        }
        let annotations = whole.list(whole.get(map, "annotations", "a list of annotations")?)?;
        for (index, value) in annotations.iter().enumerate() {
            let at = whole.entry(index);
            let entry = at.object(value)?;
            let id = |field: &str| at.id(field, at.get(entry, field, "an id")?);
            let bbox = parse_bbox(&at, at.get(entry, "bbox", "[x, y, width, height]")?)?;
            let segmentation = present(entry, "segmentation").map(|v| parse_rle(&at, v)).transpose()?;
            let area = match entry.get("area") {
                Some(value) => at.number("area", value)?,
                None => segmentation.as_ref().map_or(bbox.area(), |rle| rle.area() as f64),
            };
            let iscrowd = match entry.get("iscrowd") {
                None | Some(Value::Null) => false,
                Some(Value::Bool(flag)) => *flag,
                Some(value) => at.number("iscrowd", value)? != 0.0,
            };
            let (image_id, category_id) = (id("image_id")?, id("category_id")?);
            self.annotations.push(Annotation {
                scene_id,
                image_id,
                category_id,
                bbox,
                area,
                iscrowd,
                segmentation,
            });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const TEXT: &str = r#"[
        {"scene_id": 2, "image_id": 3, "category_id": 5, "score": 0.9, "bbox": [10, 20, 30.5, 40], "time": 0.25},
        {"image_id": 4, "category_id": 6, "score": 0.5,
         "segmentation": {"size": [2, 3], "counts": [1, 3, 2]}, "time": -1},
        {"image_id": 4, "category_id": 6, "score": 0.5, "bbox": [], "segmentation": {"size": [2, 3], "counts": "132"}}
    ]"#;

    fn parse_text(text: &str, options: &ReadDetections) -> Result<Detections, DatasetError> {
        parse_detections(text.as_bytes(), Path::new("dets.json"), options)
    }

    #[test]
    fn both_forms_of_masks_are_the_same() {
        let d = parse_text(TEXT, &ReadDetections::default()).unwrap().detections;
        assert_eq!((d[0].scene_id, d[0].time), (2, Some(0.25)));
        assert_eq!(d[0].bbox.unwrap(), Rect { x: 10.0, y: 20.0, width: 30.5, height: 40.0 });
        assert_eq!(d[1].segmentation, d[2].segmentation);
        assert_eq!((d[1].time, d[2].bbox), (None, None));
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("out.json");
        write_detections(&path, &d).unwrap();
        assert_eq!(read_detections(&path, &ReadDetections::default()).unwrap().detections, d);
    }

    #[test]
    fn boxes_off_the_image_are_clipped_or_left_out_and_reported() {
        let text = r#"[{"image_id": 1, "category_id": 1, "score": 1, "bbox": [-10, 5, 30, 10]},
            {"image_id": 1, "category_id": 1, "score": 1, "bbox": [700, 5, 30, 10]},
            {"image_id": 1, "category_id": 1, "score": 1, "bbox": [0, 0, 640, 480]},
            {"image_id": 1, "category_id": 1, "score": 1, "bbox": [0, 0, 0, 48]}]"#;
        let options = ReadDetections { image_size: Some((640, 480)), ..Default::default() };
        let read = parse_text(text, &options).unwrap();
        assert_eq!(read.detections.len(), 2);
        let clipped = Rect { x: 0.0, y: 5.0, width: 20.0, height: 10.0 };
        assert_eq!(read.detections[0].bbox.unwrap(), clipped);
        let what: Vec<_> = read.adjusted.iter().map(|a| (a.index, a.adjustment)).collect();
        assert_eq!(what, [(0, Adjustment::Clipped), (1, Adjustment::Outside), (3, Adjustment::Outside)]);
        assert!(read.adjusted[1].message.contains("entry 1, image 1"), "{}", read.adjusted[1].message);
    }

    #[test]
    fn broken_detections_are_named_or_skipped() {
        let cases = [
            (TEXT.replace("[10, 20, 30.5, 40]", "[10, 20, 30.5]"), "entry 0, field bbox: found a list of 3"),
            (TEXT.replace("30.5", "-30.5"), "width -30.5"),
            (TEXT.replace("30.5", "3e307"), "at most a million"),
            (TEXT.replace("\"score\": 0.9", "\"score\": \"high\""), "score: found \"high\""),
            (TEXT.replace("[1, 3, 2]", "[1, 3, 9]"), "entry 1, field segmentation"),
            (TEXT.replace("{\"size\": [2, 3], \"counts\": \"132\"}", "[[1, 2, 3, 4, 5, 6]]"), "no polygons"),
            (TEXT.replace("\"image_id\": 3,", ""), "image_id: found nothing"),
            (TEXT.replace("\"bbox\": [10, 20, 30.5, 40],", ""), "neither bbox nor segmentation"),
            (TEXT.replace("[2, 3]", "[99999999, 99999999]"), "field segmentation"),
        ];
        for (text, part) in cases {
            let message = parse_text(&text, &ReadDetections::default()).unwrap_err().to_string();
            assert!(message.contains(part) && message.contains("dets.json"), "{message} lacks {part}");
            let read = parse_text(&text, &ReadDetections { lenient: true, ..Default::default() }).unwrap();
            assert!(!read.adjusted.is_empty());
            assert_eq!(read.detections.len() + read.adjusted.len(), 3);
        }
        let options = ReadDetections { image_size: Some((640, 480)), ..Default::default() };
        let message = parse_text(TEXT, &options).unwrap_err().to_string();
        assert!(message.contains("segmentation.size: found [2, 3]"), "{message}");
    }

    proptest! {
        #[test]
        fn mutated_text_never_panics(at in 0usize..500, byte: u8, cut in 0usize..600, lenient: bool) {
            let mut text = TEXT.as_bytes().to_vec();
            let at = at % text.len();
            text[at] = byte;
            text.truncate(cut.max(1));
            let options = ReadDetections { lenient, image_size: Some((64, 48)) };
            let _ = parse_detections(&text, Path::new("x"), &options);
            let _ = CocoGroundTruth::default().add_scene(1, &text, Path::new("x"));
        }
    }
}
