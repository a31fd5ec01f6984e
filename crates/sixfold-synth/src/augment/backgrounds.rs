//! Sources of backgrounds: photographs of a folder, images in memory, or procedural textures.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use image::DynamicImage;
use image::imageops::FilterType;
use rand::RngExt;
use sixfold_geometry::random::{Random, uniform};
use sixfold_geometry::{Image, Rect, RgbImage};
use sixfold_io::read_rgb;

use super::error::AugmentError;
use super::patch::{AffineMap, Patch};
use super::texture::procedural_texture;

/// Options for reading a folder of photographs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhotographOptions {
    /// Photographs are reduced until their longer side has at most this many pixels.
    pub longest_side: usize,
    /// At most this many are read, in the order of their names.
    pub most: usize,
}

impl Default for PhotographOptions {
    fn default() -> Self {
        PhotographOptions { longest_side: 400, most: 2000 }
    }
}

/// The image with at most `side` pixels along its longer side.
fn reduced(image: RgbImage, side: usize) -> Option<RgbImage> {
    if image.width().max(image.height()) <= side {
        return Some(image);
    }
    let data = image.as_slice().as_flattened().to_vec();
    let pixels = image::RgbImage::from_raw(image.width() as u32, image.height() as u32, data)?;
    let pixels =
        DynamicImage::from(pixels).resize(side as u32, side as u32, FilterType::Triangle).into_rgb8();
    let data = pixels.as_raw().as_chunks::<3>().0.to_vec();
    Image::from_vec(pixels.width() as usize, pixels.height() as usize, data).ok()
}

/// An image and the rectangles that its crops should avoid.
#[derive(Debug, Clone)]
struct Source {
    image: Arc<RgbImage>,
    keep_out: Vec<Rect>,
}

/// A source of backgrounds: photographs, images in memory, procedural textures, or a mix.
#[derive(Debug, Clone)]
pub struct Backgrounds {
    sources: Vec<Source>,
    procedural_fraction: f32,
}

impl Backgrounds {
    /// Only textures made from noise, without files.
    pub fn procedural() -> Self {
        Backgrounds { sources: Vec::new(), procedural_fraction: 1.0 }
    }

    /// The PNG and JPEG files of a folder, decoded once and kept in memory at reduced size. Other files are skipped.
    ///
    /// # Errors
    /// [`AugmentError`] when the folder cannot be listed or holds no readable photograph.
    pub fn from_folder(path: impl AsRef<Path>, options: &PhotographOptions) -> Result<Self, AugmentError> {
        let path = path.as_ref();
        let mut images = Vec::new();
        for file in Backgrounds::files(path, options)? {
            let Ok(decoded) = read_rgb(&file) else { continue };
            let side = options.longest_side.clamp(16, 1 << 14);
            let Some(image) = reduced(decoded, side) else { continue };
            if image.width().min(image.height()) >= 8 {
                images.push(Arc::new(image));
            }
        }
        if images.is_empty() {
            return Err(AugmentError::NoPhotographs { path: path.to_owned(), found: 0 });
        }
        Backgrounds::from_images(images)
    }

    /// The files that [`Backgrounds::from_folder`] reads, in its order.
    ///
    /// # Errors
    /// [`AugmentError::Folder`] when the folder cannot be listed.
    pub fn files(path: &Path, options: &PhotographOptions) -> Result<Vec<PathBuf>, AugmentError> {
        let folder = |source| AugmentError::Folder { path: path.to_owned(), source };
        let mut files = Vec::new();
        for entry in std::fs::read_dir(path).map_err(folder)? {
            let file = entry.map_err(folder)?.path();
            let end = file.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
            if matches!(end.as_deref(), Some("png" | "jpg" | "jpeg")) {
                files.push(file);
            }
        }
        // The order in which files are listed depends on the system.
        files.sort();
        files.truncate(options.most);
        Ok(files)
    }

    /// Images that are already in memory.
    ///
    /// # Errors
    /// [`AugmentError::SmallImage`] for an image below 8x8 pixels.
    pub fn from_images(images: Vec<Arc<RgbImage>>) -> Result<Self, AugmentError> {
        let mut backgrounds = Backgrounds { sources: Vec::new(), procedural_fraction: 0.0 };
        for image in images {
            backgrounds = backgrounds.with_image(image, Vec::new())?;
        }
        if backgrounds.sources.is_empty() {
            backgrounds.procedural_fraction = 1.0;
        }
        Ok(backgrounds)
    }

    /// Adds one image; its crops avoid the rectangles if possible (objects that must not appear).
    ///
    /// # Errors
    /// [`AugmentError::SmallImage`].
    pub fn with_image(mut self, image: Arc<RgbImage>, keep_out: Vec<Rect>) -> Result<Self, AugmentError> {
        let (width, height) = image.size();
        if width.min(height) < 8 {
            return Err(AugmentError::SmallImage { index: self.sources.len(), width, height });
        }
        self.sources.push(Source { image, keep_out });
        Ok(self)
    }

    /// Sets the fraction of procedural textures among the photographs, 0..1.
    pub fn with_procedural_fraction(mut self, fraction: f32) -> Self {
        self.procedural_fraction = if self.sources.is_empty() { 1.0 } else { fraction.clamp(0.0, 1.0) };
        self
    }

    /// Number of images.
    pub fn images(&self) -> usize {
        self.sources.len()
    }

    /// A background of the given size.
    pub fn patch(&self, width: usize, height: usize, random: &mut Random) -> Patch {
        if self.sources.is_empty() || random.random::<f32>() < self.procedural_fraction {
            return procedural_texture(width, height, random);
        }
        let source = &self.sources[random.random_range(0..self.sources.len())];
        let map = source.crop(width, height, random);
        Patch::warp(&source.image, &map, width, height, [0.5; 3]).0
    }
}

impl Source {
    /// A random window of a third of the image to the whole image, flipped with probability one half.
    fn crop(&self, width: usize, height: usize, random: &mut Random) -> AffineMap {
        let (w, h) = self.image.size();
        let largest = f32::min((w - 1) as f32 / width as f32, (h - 1) as f32 / height as f32);
        let mut best = (f64::INFINITY, [0.0; 3]);
        let tries = if self.keep_out.is_empty() { 1 } else { 8 };
        for _ in 0..tries {
            let scale = largest * uniform(random, [0.33, 1.0]);
            let x = random.random::<f32>() * ((w - 1) as f32 - scale * width as f32).max(0.0);
            let y = random.random::<f32>() * ((h - 1) as f32 - scale * height as f32).max(0.0);
            let window = Rect {
                x: f64::from(x),
                y: f64::from(y),
                width: f64::from(scale * width as f32),
                height: f64::from(scale * height as f32),
            };
            let forbidden: f64 =
                self.keep_out.iter().filter_map(|r| r.intersect(&window)).map(|r| r.area()).sum();
            let fraction = forbidden / window.area().max(1.0);
            if fraction < best.0 {
                best = (fraction, [scale, x, y]);
            }
            if fraction == 0.0 {
                break;
            }
        }
        let [scale, x, y] = best.1;
        let half = 0.5 * (scale - 1.0);
        if random.random() {
            AffineMap { x: [scale, 0.0, x + half], y: [0.0, scale, y + half] }
        } else {
            AffineMap { x: [-scale, 0.0, x + half + scale * (width as f32 - 1.0)], y: [0.0, scale, y + half] }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::random::stream;

    #[test]
    fn photographs_of_a_folder() {
        let folder = tempfile::tempdir().unwrap();
        let message = Backgrounds::from_folder(folder.path(), &PhotographOptions::default()).unwrap_err();
        assert!(message.to_string().contains("expected at least one PNG or JPEG"), "{message}");
        std::fs::write(folder.path().join("broken.png"), b"no image").unwrap();
        std::fs::write(folder.path().join("notes.txt"), b"hello").unwrap();
        assert!(Backgrounds::from_folder(folder.path(), &PhotographOptions::default()).is_err());
        let photograph = image::RgbImage::from_fn(900, 30, |x, _| image::Rgb([(x / 4) as u8, 90, 200]));
        photograph.save(folder.path().join("a.png")).unwrap();
        let backgrounds = Backgrounds::from_folder(folder.path(), &PhotographOptions::default()).unwrap();
        assert_eq!(backgrounds.images(), 1);
        assert_eq!(backgrounds.sources[0].image.size(), (400, 13));
        let patch = backgrounds.patch(20, 20, &mut stream(1, 1));
        assert!((patch.data[400] - 90.0 / 255.0).abs() < 0.01);
        assert!(Backgrounds::from_folder("/nowhere/at/all", &PhotographOptions::default()).is_err());
    }

    #[test]
    fn crops_keep_away_from_objects() {
        let red = Rect { x: 0.0, y: 0.0, width: 50.0, height: 100.0 };
        let image = RgbImage::from_fn(200, 100, |x, _| if x < 50 { [255, 0, 0] } else { [0, 255, 0] });
        let backgrounds =
            Backgrounds::from_images(vec![]).unwrap().with_image(Arc::new(image), vec![red]).unwrap();
        let backgrounds = backgrounds.with_procedural_fraction(0.0);
        let clean = (0..50)
            .filter(|&n| backgrounds.patch(16, 16, &mut stream(2, n)).data[..256].iter().all(|r| *r < 0.5))
            .count();
        assert!(clean >= 45, "{clean}");
        let tiny = Arc::new(RgbImage::filled(4, 4, [0; 3]));
        assert!(Backgrounds::from_images(vec![tiny]).unwrap_err().to_string().contains("4x4"));
    }
}
