//! A file of detections that grows while a detector runs. Rows are kept as text, so that rows that are read and written again stay
//! the same to the last digit.

use std::path::Path;

use sixfold_io::write_atomically;

use crate::coco::{Detection, ReadDetections, detection_row, parse_detections};
use crate::dataset_error::DatasetError;

/// Detections as rows of their file, by scene and image.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct DetectionRows(Vec<((u32, u32), String)>);

impl DetectionRows {
    /// The rows of a file that [`DetectionRows::write`] wrote, one a line.
    ///
    /// # Errors
    /// [`DatasetError`] naming file and field.
    pub fn read(path: &Path) -> Result<DetectionRows, DatasetError> {
        let text = sixfold_io::read_regular_text(path, sixfold_io::limits::LARGE_TEXT)
            .map_err(|source| DatasetError::Read { path: path.to_owned(), source })?;
        let mut rows = vec![];
        for line in text.lines().map(|line| line.trim_end_matches(',')) {
            if !["[", "]", ""].contains(&line) {
                let read =
                    parse_detections(format!("[{line}]").as_bytes(), path, &ReadDetections::default())?;
                let image = |d: &Detection| ((d.scene_id, d.image_id), line.to_owned());
                rows.extend(read.detections.iter().map(image));
            }
        }
        Ok(DetectionRows(rows))
    }

    /// Adds detections.
    pub fn add(&mut self, detections: &[Detection]) {
        self.0.extend(detections.iter().map(|d| ((d.scene_id, d.image_id), detection_row(d))));
    }

    /// Scene and image of each detection.
    pub fn images(&self) -> impl Iterator<Item = (u32, u32)> {
        self.0.iter().map(|(image, _)| *image)
    }

    /// Keeps only the detections of the wanted images.
    pub fn keep_images(&mut self, mut wanted: impl FnMut(u32, u32) -> bool) {
        self.0.retain(|((scene_id, im_id), _)| wanted(*scene_id, *im_id));
    }

    /// Sorts the detections by scene and image; within an image their order stays.
    pub fn sort_by_image(&mut self) {
        self.0.sort_by_key(|(image, _)| *image);
    }

    /// Number of detections.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether there are no detections.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Writes the file.
    ///
    /// # Errors
    /// [`DatasetError::Write`].
    pub fn write(&self, path: &Path) -> Result<(), DatasetError> {
        let rows: Vec<&str> = self.0.iter().map(|(_, row)| row.as_str()).collect();
        write_atomically(path, format!("[\n{}\n]\n", rows.join(",\n")).as_bytes())
            .map_err(|source| DatasetError::Write { path: path.to_owned(), source })
    }
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::Rect;

    use super::*;

    #[test]
    fn rows_that_are_read_and_written_again_keep_every_digit() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("found.json");
        let detection = |image_id: u32, score: f64| Detection {
            scene_id: 2,
            image_id,
            category_id: 5,
            score,
            bbox: Some(Rect { x: score / 3.0, y: 0.1 + score, width: 7.0 / 3.0, height: 1e-3 }),
            segmentation: None,
            time: Some(score * 0.7),
        };
        let mut rows = DetectionRows::default();
        // A fast but inexact parser reads the shortest decimals of many numbers wrong in the last bit.
        let all: Vec<Detection> =
            (0..500).map(|i| detection(499 - i / 2, f64::from((i as f32).sin().abs()))).collect();
        rows.add(&all);
        rows.write(&path).unwrap();
        let before = std::fs::read(&path).unwrap();
        crate::write_detections(&path, &all).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), before);
        let mut again = DetectionRows::read(&path).unwrap();
        assert_eq!(again, rows);
        again.write(&path).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), before);

        again.keep_images(|_, im_id| im_id < 252);
        again.sort_by_image();
        assert_eq!(again.images().collect::<Vec<_>>(), [(2, 250), (2, 250), (2, 251), (2, 251)]);
        DetectionRows::default().write(&path).unwrap();
        assert!(DetectionRows::read(&path).unwrap().is_empty());
        std::fs::write(&path, "[\n{\"scene_id\": 2}\n]\n").unwrap();
        assert!(DetectionRows::read(&path).unwrap_err().to_string().contains("found.json"));
    }
}
