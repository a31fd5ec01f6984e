//! The inputs from which an object is taught, given as files; and the photographs that were not used.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use serde::Serialize;
use sixfold_geometry::Camera;
use sixfold_io::{CameraFile, ImageFile, limits, read_regular};
use sixfold_mesh::{Mesh, Unit, read_mesh};
use sixfold_teach::{By, KnownLength, Photograph, TeachOptions, Teaching, World};

use crate::board::{Ends, photograph_files, ruler_in_metres};

/// All that is given to teach an object.
#[derive(Debug, Clone, Copy)]
pub struct TeachingFiles<'a> {
    /// Photographs and folders of them; or one JSON file that lists photographs with poses.
    pub photographs: &'a [PathBuf],
    /// Depth images taken from the same viewpoints, and folders of them, in the same order.
    pub depth: &'a [PathBuf],
    /// Millimetres per unit of the depth images.
    pub depth_scale: Option<f64>,
    /// Camera file of the photographs.
    pub camera: Option<&'a Path>,
    /// Measured length of the printed ruler, millimetres.
    pub ruler: Option<f64>,
    /// The photographs show no board.
    pub without_board: bool,
    /// Measured length between the two points of `ends`, metres.
    pub length: Option<f64>,
    /// The ends of that length in photographs.
    pub ends: &'a [Ends],
    /// A mesh of the object, and its unit.
    pub mesh: Option<(&'a Path, Unit)>,
}

impl TeachingFiles<'_> {
    /// Opens the teaching in the folder `out` and adds these files.
    ///
    /// # Errors
    /// For files that cannot be read or do not belong together; messages name the options of `sixfold teach`.
    pub fn open(&self, out: &Path) -> Result<Teaching> {
        match self.photographs {
            [file] if file.extension().is_some_and(|e| e.eq_ignore_ascii_case("json")) => {
                self.with_poses(file, out)
            }
            _ => self.without_poses(out),
        }
    }

    /// Photographs with poses, from a file.
    fn with_poses(&self, file: &Path, out: &Path) -> Result<Teaching> {
        if self.ruler.is_some() || self.camera.is_some() || !self.depth.is_empty() || self.without_board {
            bail!(
                "--ruler, --camera, --depth and --no-board belong to photographs without poses: {} names what it has",
                file.display()
            );
        }
        Ok(Teaching::open_file(out, file, self.read_mesh()?.as_ref())?)
    }

    /// Photographs of the object, on the board or without one.
    fn without_poses(&self, out: &Path) -> Result<Teaching> {
        let ruler = ruler_in_metres(self.ruler)?;
        let files = photograph_files(self.photographs)?;
        let depth = if self.depth.is_empty() { vec![] } else { photograph_files(self.depth)? };
        if !depth.is_empty() && depth.len() != files.len() {
            bail!(
                "--depth: found {} images, expected one for each of {} photographs",
                depth.len(),
                files.len()
            );
        }
        let camera = self.read_camera(&files)?;
        let mesh = self.read_mesh()?;
        let world = if self.without_board { World::Features } else { World::Board };
        let ends = self.length.map(|_| Ends::numbered(self.ends, &files)).transpose()?;
        let mut teaching = Teaching::open(out, &TeachOptions { ruler, camera, world })?;
        teaching.set_mesh(mesh.as_ref())?;
        for (i, file) in files.iter().enumerate() {
            let number = teaching.add_photograph(&file.display().to_string(), &read(file)?)?;
            if let (Some(depth), Some(scale)) = (depth.get(i), self.depth_scale) {
                teaching.add_depth(number, &read(depth)?, scale / 1000.0)?;
            }
        }
        let given: Vec<String> = files.iter().map(|f| f.display().to_string()).collect();
        teaching.leave_out_others(&given)?;
        if self.without_board {
            let in_folder = |i: usize| teaching.photographs().iter().position(|p| p.name == given[i]);
            let length = self.length.zip(ends).map(|(metres, ends)| KnownLength {
                metres,
                ends: ends.iter().filter_map(|(i, ends)| Some((in_folder(*i)?, *ends))).collect(),
            });
            teaching.set_length(length)?;
        }
        Ok(teaching)
    }

    fn read_camera(&self, photographs: &[PathBuf]) -> Result<Option<Camera>> {
        let (Some(file), Some(first)) = (self.camera, photographs.first()) else { return Ok(None) };
        let (width, height) = ImageFile::new(first).size()?;
        Ok(Some(CameraFile::read(file)?.for_image(width, height, file)?))
    }

    fn read_mesh(&self) -> Result<Option<Mesh>> {
        Ok(self.mesh.map(|(file, unit)| read_mesh(file, unit)).transpose()?)
    }
}

fn read(image: &Path) -> Result<Vec<u8>> {
    read_regular(image, limits::IMAGE).with_context(|| image.display().to_string())
}

/// A photograph that is not used.
#[derive(Debug, Serialize)]
pub struct LeftOut {
    /// Its name.
    pub photograph: String,
    /// Why it is not used.
    pub reason: String,
}

impl LeftOut {
    /// All of a teaching.
    pub fn all(teaching: &Teaching) -> Vec<LeftOut> {
        let of = |p: &Photograph| {
            let by_person = p.left_out_by_person.then(|| "not given this time".to_owned());
            let reason =
                by_person.or_else(|| p.left_out.clone().filter(|_| p.pose_by != Some(By::Person)))?;
            Some(LeftOut { photograph: p.name.clone(), reason })
        };
        teaching.photographs().iter().filter_map(of).collect()
    }
}
