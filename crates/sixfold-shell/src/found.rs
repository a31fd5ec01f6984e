//! Output of the poses found in an image: first `poses.json` and the table, then the images.

use anyhow::Result;
use sixfold_geometry::{Camera, DepthImage, Mask, RgbImage};
use sixfold_runner::{FoundObject, ImageReport, ImageResult, pose_table};

use crate::Outcome;
use crate::folder::OutputFolder;
use crate::output::{JsonArguments, report, write_atomically};
use crate::overlay::{self, Drawn, Shape};
use crate::pictures::Pictures;

/// An image and the objects that were searched in it.
pub struct SearchedImage<'a> {
    /// The camera, without lens distortion.
    pub camera: &'a Camera,
    /// The colour image.
    pub rgb: Option<&'a RgbImage>,
    /// The depth image.
    pub depth: Option<&'a DepthImage>,
    /// The objects.
    pub found: &'a [FoundObject],
}

impl SearchedImage<'_> {
    /// Writes the poses into the folder `out` and prints them, then writes the images. An image that cannot be written is
    /// reported; the poses are kept.
    ///
    /// # Errors
    /// When the poses cannot be written.
    pub fn finish(
        &self,
        out: Option<OutputFolder>,
        json: &JsonArguments,
        mut whole: ImageReport,
    ) -> Result<Outcome> {
        let diagnostics = || self.found.iter().flat_map(|f| &f.estimates).flat_map(|e| &e.diagnostics);
        if let Some(folder) = out.as_ref().map(OutputFolder::path) {
            whole.overlay = Some(folder.join("overlay.png"));
            let named = diagnostics().map(|d| (d.name.to_owned(), folder.join(format!("{}.png", d.name))));
            whole.diagnostics = named.collect();
            write_atomically(&folder.join("poses.json"), serde_json::to_string_pretty(&whole)?.as_bytes())?;
        }
        report(json, &whole, || {
            print!("{}", pose_table(&whole));
            if let Some(folder) = out.as_ref().map(OutputFolder::path) {
                let names: Vec<String> = diagnostics().map(|d| format!("{}.png", d.name)).collect();
                let names = [vec!["overlay.png".to_owned()], names].concat();
                println!("poses.json, {} are in {}", names.join(", "), folder.display());
            }
        })?;
        let is_asked_for = out.is_some();
        let mut pictures = Pictures::of(out);
        if is_asked_for {
            pictures.write("overlay.png", &self.overlay());
            for diagnostic in diagnostics() {
                pictures.write(&format!("{}.png", diagnostic.name), &diagnostic.image);
            }
            self.write_masks(&mut pictures);
        }
        Ok(pictures.outcome(if whole.poses.is_empty() { Outcome::NothingFound } else { Outcome::Found }))
    }

    /// The masks of all poses that have one.
    fn write_masks(&self, pictures: &mut Pictures) {
        for (i, f) in self.found.iter().enumerate() {
            for (k, estimate) in f.estimates.iter().enumerate() {
                let Some(pixels) = &estimate.mask else { continue };
                let name = format!("masks/{}-{}-{}.png", i + 1, file_name(f.object.name()), k + 1);
                let mut mask = Mask::filled(self.camera.width, self.camera.height, false);
                for &p in pixels {
                    if let Some(pixel) = mask.as_mut_slice().get_mut(p as usize) {
                        *pixel = true;
                    }
                }
                pictures.write_mask(&name, &mask);
            }
        }
    }

    /// The poses over the image; where an object has no mesh, its mask.
    pub fn overlay(&self) -> RgbImage {
        let background = match (self.rgb, self.depth) {
            (Some(rgb), _) => rgb.clone(),
            (None, Some(depth)) => overlay::depth_picture(depth),
            (None, None) => RgbImage::filled(self.camera.width, self.camera.height, [0; 3]),
        };
        let mut drawn = vec![];
        for (i, f) in self.found.iter().enumerate() {
            for estimate in &f.estimates {
                let shape = match (f.object.mesh(), &estimate.mask) {
                    (Some(mesh), _) => Shape::Mesh(mesh, estimate.camera_from_object),
                    (None, Some(mask)) => Shape::Pixels(mask),
                    (None, None) => continue,
                };
                drawn.push(Drawn {
                    shape,
                    color: overlay::color(i),
                    name: f.object.name().to_owned(),
                    certainty: overlay::certainty(estimate),
                });
            }
        }
        overlay::draw(&background, self.camera, &drawn)
    }
}

/// An image of a dataset with the poses found in it drawn over; `None` for an image without pixels.
///
/// # Errors
/// When the image cannot be read.
pub fn overlay_of(result: &ImageResult<'_>) -> Result<Option<RgbImage>> {
    let (scene, im_id) = (result.scene, result.im_id);
    let camera = scene.camera(im_id)?;
    let background = match (scene.rgb(im_id)?, scene.depth(im_id)?) {
        (Some(rgb), _) => rgb,
        (None, Some(depth)) => overlay::depth_picture(&depth),
        (None, None) => return Ok(None),
    };
    let drawn: Vec<Drawn<'_>> = result
        .found
        .iter()
        .map(|p| {
            let certainty = overlay::certainty(&p.estimate);
            Drawn::of_dataset(p.obj_id, p.mesh, p.estimate.camera_from_object, certainty)
        })
        .collect();
    Ok(Some(overlay::draw(&background, &camera, &drawn)))
}

fn file_name(name: &str) -> String {
    name.chars().map(|c| if c.is_ascii_alphanumeric() || c == '-' || c == '_' { c } else { '_' }).collect()
}
