//! A teaching from a file that lists photographs with the object's pose in each, for example from a robot arm, a tracker or
//! annotators.

use std::path::{Path, PathBuf};

use sixfold_data::{PhotographEntry, PhotographFile};
use sixfold_geometry::Camera;
use sixfold_io::{CameraFile, ImageFile, limits, read_mask_and_hidden, read_regular};
use sixfold_mesh::Mesh;

use crate::error::TeachError;
use crate::teaching::{TeachOptions, Teaching, World};

fn wrong(path: &Path, error: impl std::fmt::Display) -> TeachError {
    TeachError::File { path: path.to_owned(), what: error.to_string() }
}

fn bytes_of(path: &Path) -> Result<Vec<u8>, TeachError> {
    read_regular(path, limits::IMAGE).map_err(|e| wrong(path, e))
}

impl Teaching {
    /// Opens or creates the folder, with the photographs, poses, masks and depth images that a [`PhotographFile`] lists. `mesh`
    /// (metres) replaces the mesh that the file names; without either, the mesh is made from the photographs. Photographs of the
    /// folder that the file does not list are left out.
    ///
    /// # Errors
    /// [`TeachError`]; [`TeachError::File`] names the file and what is wrong in it.
    pub fn open_file(
        folder: impl Into<PathBuf>,
        file: &Path,
        mesh: Option<&Mesh>,
    ) -> Result<Teaching, TeachError> {
        let list = PhotographFile::read(file).map_err(|e| wrong(file, e))?;
        let named = list.read_mesh(file).map_err(|e| wrong(file, e))?;
        if mesh.is_some() && named.is_some() {
            return Err(wrong(file, "field mesh: found one, and another mesh was given: give one of them"));
        }
        let beside = file.parent().unwrap_or(Path::new(""));
        let camera = Some(common_camera(&list, file, beside)?);
        let options = TeachOptions { camera, world: World::Given, ..TeachOptions::default() };
        let mut teaching = Teaching::open(folder, &options)?;
        teaching.set_mesh(mesh.or(named.as_ref()))?;
        for entry in &list.photographs {
            teaching.add_entry(entry, file, beside)?;
        }
        teaching.set_floor(list.floor.and_then(|f| f.up()), list.floor.and_then(|f| f.plane()))?;
        let name = |entry: &PhotographEntry| beside.join(&entry.image).display().to_string();
        teaching.leave_out_others(&list.photographs.iter().map(name).collect::<Vec<String>>())?;
        Ok(teaching)
    }

    fn add_entry(&mut self, entry: &PhotographEntry, file: &Path, beside: &Path) -> Result<(), TeachError> {
        let image = beside.join(&entry.image);
        let number = self.add_photograph(&image.display().to_string(), &bytes_of(&image)?)?;
        self.set_pose(number, &entry.pose().map_err(|e| wrong(file, e))?)?;
        if let (Some(depth), Some(scale)) = (&entry.depth, entry.depth_scale) {
            self.add_depth(number, &bytes_of(&beside.join(depth))?, scale / 1000.0)?;
        }
        if let Some(mask) = &entry.mask {
            let (mask, hidden) = read_mask_and_hidden(&beside.join(mask))?;
            self.set_mask(number, &mask, hidden.as_ref())?;
        }
        Ok(())
    }

    /// Uses the photographs with these names and leaves out all others, such as those of an earlier run in the same folder.
    ///
    /// # Errors
    /// [`TeachError::Io`].
    pub fn leave_out_others(&mut self, names: &[String]) -> Result<(), TeachError> {
        for number in 0..self.photographs().len() {
            let left_out = !names.contains(&self.photographs()[number].name);
            self.set_left_out(number, left_out)?;
        }
        Ok(())
    }
}

/// The camera that all photographs of a file share.
fn common_camera(list: &PhotographFile, file: &Path, beside: &Path) -> Result<Camera, TeachError> {
    let mut common: Option<(Camera, &str)> = None;
    for entry in &list.photographs {
        let camera_file = beside.join(&entry.camera);
        let (width, height) = ImageFile::new(&beside.join(&entry.image)).size()?;
        let camera = CameraFile::read(&camera_file)
            .and_then(|camera| camera.for_image(width, height, &camera_file))
            .map_err(|e| wrong(&camera_file, e))?;
        match common {
            Some((first, image)) if first != camera => {
                let what = format!(
                    "the camera of {} differs from that of {image}: expected photographs of one camera",
                    entry.image
                );
                return Err(wrong(file, what));
            }
            Some(_) => {}
            None => common = Some((camera, &entry.image)),
        }
    }
    common.map(|(camera, _)| camera).ok_or_else(|| wrong(file, "field photographs: found none"))
}
