//! Photographs and their tags.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::progress::{Progress, check_interrupt};
use anyhow::{Context, Result, bail};
use sixfold_board::{BoardError, Tag, detect_tags};
use sixfold_geometry::{Image, RgbImage};
use sixfold_io::read_rgb;

/// Width of a photograph in the overview, pixels.
pub(super) const THUMBNAIL: usize = 480;

/// A photograph and the tags of the board in it.
pub struct Photograph {
    /// Path of the file.
    pub file: PathBuf,
    /// Width and height, pixels; zero where it cannot be read.
    pub size: (usize, usize),
    /// The tags in it.
    pub tags: Vec<Tag>,
    pub(super) thumbnail: RgbImage,
    /// Why it is not used, if that follows from this photograph alone.
    pub left_out: Option<String>,
    /// Whether it cannot be read.
    pub unreadable: bool,
}

/// The photographs among these files and in these folders; within a folder, sorted by name.
///
/// # Errors
/// For a folder that cannot be read, or has none.
pub fn photograph_files(given: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let mut files = vec![];
    for path in given {
        if path.is_dir() {
            let before = files.len();
            let entries =
                std::fs::read_dir(path).with_context(|| format!("cannot read {}", path.display()))?;
            for entry in entries {
                let file = entry.with_context(|| format!("cannot read {}", path.display()))?.path();
                if is_photograph(&file) {
                    files.push(file);
                }
            }
            files[before..].sort();
            if files.len() == before {
                bail!(
                    "{}: found no photograph, expected files that end in .png, .jpg or .jpeg",
                    path.display()
                );
            }
        } else {
            files.push(path.clone());
        }
    }
    Ok(files)
}

/// Whether a file is a photograph. HEIF files count: they are refused by name with advice, not skipped.
fn is_photograph(file: &Path) -> bool {
    let extension = file.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
    extension.is_some_and(|e| ["png", "jpg", "jpeg", "heic", "heif"].contains(&e.as_str()))
}

/// Reads photographs and finds their tags. A photograph that cannot be read is marked and does not stop the
/// others.
///
/// # Errors
/// When the user interrupts.
pub fn read_photographs(files: &[PathBuf]) -> Result<Vec<Photograph>> {
    let mut progress = Progress::new("finding tags", files.len());
    let mut photographs = vec![];
    for file in files {
        check_interrupt("nothing was written")?;
        photographs.push(photograph(file));
        progress.step(file.display().to_string());
    }
    progress.finish();
    Ok(photographs)
}

fn photograph(file: &Path) -> Photograph {
    let file = file.to_owned();
    match read_rgb(&file) {
        Ok(image) => {
            let found = detect_tags(&image);
            let mirrored = found.mirrored > found.tags.len();
            let left_out = mirrored.then(|| BoardError::Mirrored.to_string());
            let thumbnail = reduced(&image);
            Photograph { file, size: image.size(), tags: found.tags, thumbnail, left_out, unreadable: false }
        }
        Err(error) => Photograph {
            file,
            size: (0, 0),
            tags: vec![],
            thumbnail: Image::filled(THUMBNAIL, THUMBNAIL * 3 / 4, [90; 3]),
            left_out: Some(error.to_string()),
            unreadable: true,
        },
    }
}

/// The most common size of the photographs; photographs of other sizes are left out.
///
/// # Errors
/// When none shows a tag.
pub(crate) fn leave_out_other_sizes(photographs: &mut [Photograph]) -> Result<(usize, usize)> {
    let mut counts: BTreeMap<(usize, usize), usize> = BTreeMap::new();
    for photograph in photographs.iter().filter(|p| !p.tags.is_empty()) {
        *counts.entry(photograph.size).or_default() += 1;
    }
    let Some((&(width, height), _)) = counts.iter().max_by_key(|(_, count)| **count) else {
        bail!("no photograph shows a tag");
    };
    for p in photographs.iter_mut().filter(|p| p.left_out.is_none() && p.size != (width, height)) {
        let (w, h) = p.size;
        p.left_out = Some(format!(
            "{w}x{h} pixels, most photographs have {width}x{height}: expected whole images of one camera, as it stores them"
        ));
    }
    Ok((width, height))
}

/// A smaller image: each pixel is the mean of the pixels that it replaces.
fn reduced(image: &RgbImage) -> RgbImage {
    let (width, height) = image.size();
    let factor = (width as f64 / THUMBNAIL as f64).max(1.0);
    let (w, h) = ((width as f64 / factor) as usize, (height as f64 / factor) as usize);
    Image::from_fn(w.max(1), h.max(1), |x, y| {
        let range = |i: usize, end: usize| {
            let (from, to) = ((i as f64 * factor) as usize, ((i + 1) as f64 * factor) as usize);
            from.min(end - 1)..to.clamp(from + 1, end.max(from + 1))
        };
        let (mut sum, mut count) = ([0u32; 3], 0);
        for v in range(y, height) {
            for u in range(x, width) {
                if let Some(pixel) = image.get(u, v) {
                    (0..3).for_each(|c| sum[c] += u32::from(pixel[c]));
                    count += 1;
                }
            }
        }
        sum.map(|s| (s / count.max(1)) as u8)
    })
}
