//! The forms of teachings: photographs with their data, checked when they arrive.

use std::collections::BTreeMap;
use std::path::Path;

use sixfold_board::{Board, Paper};
use sixfold_geometry::Camera;
use sixfold_io::{CameraFile, ImageFile};
use sixfold_teach::{TeachOptions, Teaching};

use super::of_teach;
use crate::error::{Answer, ApiError};
use crate::form::{Form, FormRule, UploadedFile};

pub(super) const NEW: FormRule = FormRule {
    files: &["camera"],
    many_files: &["photographs", "depth"],
    texts: &["name", "depth_scale", "ruler", "hull_only", "replace", "start"],
};

pub(super) const MORE: FormRule =
    FormRule { files: &["camera"], many_files: &["photographs", "depth"], texts: &["depth_scale", "ruler"] };

/// The form of `POST /v1/teachings`.
#[derive(utoipa::ToSchema)]
#[allow(dead_code)]
pub(crate) struct TeachingForm {
    /// The name that the object will have: up to 100 letters, digits, - and _.
    name: String,
    /// Photographs of the object on the printed board, PNG or JPEG, from all sides: 8 to 40 in all, more by further requests.
    #[schema(value_type = Vec<String>, format = Binary)]
    photographs: Vec<Vec<u8>>,
    /// Depth images from the same viewpoints (PNG, one channel of 16 bits), in the order of the photographs' names.
    #[schema(value_type = Option<Vec<String>>, format = Binary)]
    depth: Option<Vec<Vec<u8>>>,
    /// Millimetres per unit of the depth images; needed with them.
    depth_scale: Option<f64>,
    /// Camera file of BOP, OpenCV or ROS (default: the camera is found from the photographs).
    #[schema(value_type = Option<String>, format = Binary)]
    camera: Option<Vec<u8>>,
    /// Measured length of the ruler on the printed board, millimetres (default: 100).
    ruler: Option<f64>,
    /// Do not search for hollows by comparing photographs (default: false).
    hull_only: Option<bool>,
    /// Replace an object of the same name when this one is accepted (default: false).
    replace: Option<bool>,
    /// Start at once (default: true); otherwise `/run` starts it, after more photographs.
    start: Option<bool>,
}

/// The form of `POST /v1/teachings/{id}/photographs`.
#[derive(utoipa::ToSchema)]
#[allow(dead_code)]
pub(crate) struct MoreForm {
    /// More photographs; one with the name of an existing photograph replaces it.
    #[schema(value_type = Option<Vec<String>>, format = Binary)]
    photographs: Option<Vec<Vec<u8>>>,
    /// Depth images of these photographs, in the order of their names.
    #[schema(value_type = Option<Vec<String>>, format = Binary)]
    depth: Option<Vec<Vec<u8>>>,
    /// Millimetres per unit of the depth images.
    depth_scale: Option<f64>,
    /// Camera file for all photographs.
    #[schema(value_type = Option<String>, format = Binary)]
    camera: Option<Vec<u8>>,
    /// Measured length of the ruler on the printed board, millimetres.
    ruler: Option<f64>,
}

/// The content of a form: photographs by name, some with depth.
pub(super) struct Given<'f> {
    photographs: Vec<(&'f UploadedFile, Option<&'f UploadedFile>)>,
    /// Metres per unit of depth.
    depth_unit: f64,
    pub options: TeachOptions,
}

impl<'f> Given<'f> {
    /// Decodes everything once before anything is stored. `there` is the size of photographs that exist already.
    pub fn of_form(form: &'f Form, there: Option<(usize, usize)>) -> Answer<Given<'f>> {
        let photographs = by_name(form.files("photographs"))?;
        let depth = by_name(form.files("depth"))?;
        if !depth.is_empty() && depth.len() != photographs.len() {
            return Err(ApiError::field(
                "depth",
                format!("{} images", depth.len()),
                format!("one for each of {} photographs, or none", photographs.len()),
                "send the depth image of every photograph",
            ));
        }
        let mut sizes: BTreeMap<(usize, usize), usize> = BTreeMap::new();
        for photograph in &photographs {
            let name = Path::new(&photograph.name);
            let image = ImageFile::of_bytes(name, &photograph.bytes).rgb();
            let size = image.map_err(|e| ApiError::of_image("photographs", &e))?.size();
            *sizes.entry(size).or_default() += 1;
        }
        let expected = "millimetres per unit of the depth images, above 0: 1 for most cameras";
        let scale = form.number("depth_scale", expected, |v| v > 0.0 && v.is_finite())?;
        if !depth.is_empty() && scale.is_none() {
            return Err(ApiError::field("depth_scale", "nothing", expected, "give it"));
        }
        let depth_unit = scale.unwrap_or(1.0) / 1000.0;
        for image in &depth {
            let image = ImageFile::of_bytes(Path::new(&image.name), &image.bytes).depth(depth_unit);
            image.map_err(|e| ApiError::of_image("depth", &e))?;
        }
        let most = sizes.iter().max_by_key(|(_, count)| **count).map(|(size, _)| *size);
        let options = TeachOptions {
            ruler: ruler(form)?,
            camera: camera(form, there.or(most))?,
            ..TeachOptions::default()
        };
        let pairs = photographs.iter().enumerate().map(|(i, p)| (*p, depth.get(i).copied()));
        Ok(Given { photographs: pairs.collect(), depth_unit, options })
    }

    pub fn is_empty(&self) -> bool {
        self.photographs.is_empty() && self.options.camera.is_none() && self.options.ruler.is_none()
    }

    pub fn photographs(&self) -> usize {
        self.photographs.len()
    }

    /// Adds photographs to a teaching.
    pub fn into(self, teaching: &mut Teaching) -> Answer<()> {
        for (photograph, depth) in self.photographs {
            let number = teaching.add_photograph(&photograph.name, &photograph.bytes);
            let number = number.map_err(|e| of_teach(&e))?;
            if let Some(depth) = depth {
                let added = teaching.add_depth(number, &depth.bytes, self.depth_unit);
                added.map_err(|e| of_teach(&e))?;
            }
        }
        Ok(())
    }
}

/// Files in the order of their names, which must be unique.
fn by_name(files: &[UploadedFile]) -> Answer<Vec<&UploadedFile>> {
    let mut sorted: Vec<&UploadedFile> = files.iter().collect();
    sorted.sort_by(|a, b| a.name.cmp(&b.name));
    let twice = sorted.windows(2).find(|pair| pair[0].name == pair[1].name).map(|pair| pair[0]);
    match sorted.iter().find(|f| f.name.is_empty()).copied().or(twice) {
        None => Ok(sorted),
        Some(bad) => Err(ApiError::field(
            "photographs",
            format!("a file named {:?} without a name of its own", bad.name),
            "files with different names",
            "rename them: the names order photographs and depth",
        )),
    }
}

fn ruler(form: &Form) -> Answer<Option<f64>> {
    let expected = "10 to 1000 millimetres";
    let good = |mm: f64| Board::new(Paper::A4).with_ruler(mm / 1000.0).is_some();
    Ok(form.number("ruler", expected, good)?.map(|mm| mm / 1000.0))
}

fn camera(form: &Form, size: Option<(usize, usize)>) -> Answer<Option<Camera>> {
    let (Some(file), Some((width, height))) = (form.file("camera"), size) else { return Ok(None) };
    let name = Path::new("camera");
    let parsed = CameraFile::parse(&file.bytes, name).map_err(|e| ApiError::of_camera(&e))?;
    parsed.for_image(width, height, name).map(Some).map_err(|e| ApiError::of_camera(&e))
}
