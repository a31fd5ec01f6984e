//! Images of the views: one row per object, with the photograph and the view of each variant.

use std::path::{Path, PathBuf};

use anyhow::Result;
use sixfold_geometry::RgbImage;
use sixfold_io::{read_rgb, write_rgb};
use sixfold_plot::Canvas;
use sixfold_synth::augment::Patch;

use super::views::ViewRow;

/// Height of the headings.
const HEAD: usize = 40;

/// Strips of crops, stored beside the rows, so that a row that is not made again still has its images.
pub(super) struct Strips {
    folder: PathBuf,
}

impl Strips {
    pub fn new(out: &Path) -> Strips {
        Strips { folder: out.join("rows") }
    }

    fn path(&self, key: &str) -> PathBuf {
        self.folder.join(format!("{key}.png"))
    }

    /// Stores the crops of a row: the photograph, then its cells.
    pub fn keep(&self, row: &ViewRow, pictures: &[Patch]) -> Result<()> {
        let Some(first) = pictures.first() else { return Ok(()) };
        if row.cells.is_empty() {
            return Ok(());
        }
        let side = first.width;
        let crops: Vec<RgbImage> = pictures.iter().map(Patch::to_rgb).collect();
        let strip = RgbImage::from_fn(side * crops.len(), side, |x, y| crops[x / side][(x % side, y)]);
        std::fs::create_dir_all(&self.folder)?;
        Ok(write_rgb(&self.path(&row.key), &strip)?)
    }

    /// Writes one image of the strips of these rows, with the cells of these sets; nothing if there is no
    /// strip.
    pub fn sheet(&self, file: &Path, rows: &[ViewRow], sets: &[&str]) -> Result<()> {
        let mut strips = vec![];
        for row in rows {
            let path = self.path(&row.key);
            if path.is_file() {
                strips.push((row, read_rgb(&path)?));
            }
        }
        let Some((_, first)) = strips.first() else { return Ok(()) };
        let side = first.height();
        let mut columns: Vec<(&str, &str)> = vec![];
        for cell in strips.iter().flat_map(|(row, _)| &row.cells) {
            let name = (cell.set.as_str(), cell.method.as_str());
            if sets.contains(&name.0) && !columns.contains(&name) {
                columns.push(name);
            }
        }
        columns.sort_by_key(|(set, _)| sets.iter().position(|s| s == set));
        let width = side * (columns.len() + 1);
        let mut head = Canvas::new(width, HEAD);
        let ink = [30; 3];
        head.text(4.0, 6.0, 1.0, "photograph", ink);
        for (k, (set, method)) in columns.iter().enumerate() {
            let x = (side * (k + 1)) as f64 + 4.0;
            head.text(x, 6.0, 1.0, set, ink);
            head.text(x, 22.0, 1.0, method, ink);
        }
        let head = head.finish();
        let picture = RgbImage::from_fn(width, HEAD + side * strips.len(), |x, y| {
            let Some(y) = y.checked_sub(HEAD) else {
                return head[(x, y)];
            };
            let (row, strip) = &strips[y / side];
            let from = match (x / side).checked_sub(1) {
                None => Some(0),
                Some(k) => row
                    .cells
                    .iter()
                    .position(|c| (c.set.as_str(), c.method.as_str()) == columns[k])
                    .map(|i| i + 1),
            };
            from.and_then(|i| strip.get(i * side + x % side, y % side)).copied().unwrap_or([255; 3])
        });
        Ok(write_rgb(file, &picture)?)
    }
}
