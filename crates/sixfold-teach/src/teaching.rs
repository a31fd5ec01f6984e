//! A folder in which an object is taught: photographs are added and every step's result is kept, so that an interrupted run can be
//! resumed and a person can inspect and correct each step.
//!
//! | file | what it holds |
//! |---|---|
//! | `teaching.json` | the state: camera, board, for each photograph its pose, who gave it, why it is left out |
//! | `photographs/000000.jpg` | the photographs as they were given, under numbers |
//! | `depth/000000.png` | measured depth |
//! | `masks/000000.png` | where each shows the object, without lens distortion |
//! | `given.ply` | a mesh that was given, metres |
//! | `mesh.ply` | the mesh, metres |

use std::ops::Deref;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use sixfold_geometry::nalgebra::Matrix4;
use sixfold_geometry::{Camera, Mask, Plane, Pose, Progress, Vec3};
use sixfold_io::{
    ImageFile, WriteLock, read_mask, read_mask_and_hidden, read_rgb, write_atomically, write_mask,
    write_mask_and_hidden,
};
use sixfold_mesh::{Mesh, PlyFormat, Unit, read_mesh, write_ply};

use crate::error::TeachError;
use crate::located::{Located, SeenTags, locate};
use crate::shape::{
    FEWEST_PHOTOGRAPHS, FEWEST_WITH_DEPTH, Segmentation, Shape, ShapeOptions, lay, reconstruct, segment, step,
};
use crate::silhouette::Segmenter;
use crate::snapshot::{Snapshot, State, VERSION};
use crate::view::Volume;

/// Maximum number of photographs.
pub const MAX_PHOTOGRAPHS: usize = 200;
/// The file of a mesh that was given.
const GIVEN_MESH: &str = "given.ply";

/// Who gave a pose or a mask.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum By {
    /// Found by the program.
    Program,
    /// Given or corrected by a person.
    Person,
}

/// A photograph in the folder.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Photograph {
    /// The name it was given with; messages use it.
    pub name: String,
    /// Its file below `photographs`.
    pub file: String,
    /// Width and height, pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub size: Option<(usize, usize)>,
    /// Depth below `depth`, and metres for one of its units.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub depth: Option<(String, f64)>,
    /// Takes points of the board to the camera's frame, by rows.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera_from_board: Option<[[f64; 4]; 4]>,
    /// Who gave the pose.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pose_by: Option<By>,
    /// Who gave the mask, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mask_by: Option<By>,
    /// Why it is not used.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub left_out: Option<String>,
    /// Whether a person excluded it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub left_out_by_person: bool,
}

/// The name under which a photograph is kept: at most 200 characters, without control characters.
pub fn photograph_name(given: &str) -> String {
    given.chars().filter(|c| !c.is_control()).take(200).collect()
}

impl Photograph {
    pub(crate) fn pose(&self) -> Option<Pose> {
        let rows = self.camera_from_board?;
        let flat: Vec<f64> = rows.iter().flatten().copied().collect();
        Pose::from_matrix(&Matrix4::from_row_slice(&flat)).ok()
    }
}

/// Data of the mesh.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShapeFacts {
    /// Takes points of the object's frame to the board's, by rows.
    pub board_from_object: [[f64; 4]; 4],
    /// Fraction of the surface that no photograph shows.
    pub unseen: f64,
    /// Fraction of the object's pixels with depth, measured or by stereo comparison of photographs.
    pub with_depth: f64,
    /// Whether depth showed one side only: the other side is then assumed from symmetry.
    #[serde(default)]
    pub one_side: bool,
}

/// What the poses of the photographs are relative to.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum World {
    /// The printed board, which the photographs show.
    #[default]
    Board,
    /// Poses are given with [`Teaching::set_pose`], in a frame of the caller's choice.
    Given,
    /// The surroundings of the object, which must have texture: poses are found from local features, and the scale from [a
    /// length](Teaching::set_length) or from depth. z points up.
    Features,
}

/// Options that are set before the first photograph.
#[derive(Debug, Clone, Copy, Default)]
pub struct TeachOptions {
    /// Measured length of the ruler on the printed board, metres; `None` for 0.1.
    pub ruler: Option<f64>,
    /// The camera; `None` to find it from the photographs.
    pub camera: Option<Camera>,
    /// What the poses are relative to.
    pub world: World,
}

/// A folder in which an object is taught. One process at a time changes it.
#[derive(Debug)]
pub struct Teaching {
    pub(crate) known: Snapshot,
    _lock: WriteLock,
}

impl Deref for Teaching {
    type Target = Snapshot;

    fn deref(&self) -> &Snapshot {
        &self.known
    }
}

/// A value as it is after writing to and reading from the file: the last digit of a number may differ.
fn as_kept<T: Serialize + DeserializeOwned>(value: &T) -> Option<T> {
    serde_json::from_str(&serde_json::to_string(value).ok()?).ok()
}

/// Whether two values are equal after writing and reading.
pub(crate) fn is_same<T: Serialize + DeserializeOwned + PartialEq>(a: &T, b: &T) -> bool {
    a == b
        || as_kept(a) == as_kept(b)
        || as_kept(a).is_some_and(|a| a == *b)
        || as_kept(b).is_some_and(|b| *a == b)
}

impl Teaching {
    /// Opens or creates the folder. If the options differ from those with which it was created, all steps are repeated.
    ///
    /// # Errors
    /// [`TeachError::File`], [`TeachError::Io`].
    pub fn open(folder: impl Into<PathBuf>, options: &TeachOptions) -> Result<Teaching, TeachError> {
        let folder = folder.into();
        let lock = WriteLock::take(&folder.join("teaching.json"))
            .map_err(|e| TeachError::File { path: folder.clone(), what: e.to_string() })?;
        let path = folder.join("teaching.json");
        let known = if path.exists() {
            Snapshot::read(folder)?
        } else {
            let state = State {
                version: VERSION,
                ruler: options.ruler,
                world: options.world,
                given_camera: options.camera,
                length: None,
                photographs: vec![],
                revision: 0,
                located: None,
                floor: None,
                up: None,
                volume: None,
                shape: None,
                outdated: None,
                given_mesh: None,
            };
            Snapshot { folder, state }
        };
        let mut teaching = Teaching { known, _lock: lock };
        let given = options.ruler.is_some() || options.camera.is_some() || options.world != World::default();
        if given {
            teaching.take_options(options);
        }
        teaching.save()?;
        Ok(teaching)
    }

    /// Changes the options. If they differ from the present ones, all steps are repeated; poses that a person gave are kept only
    /// if they are still relative to the same frame.
    ///
    /// # Errors
    /// [`TeachError::Io`].
    pub fn set_options(&mut self, options: &TeachOptions) -> Result<(), TeachError> {
        if self.take_options(options) { self.save() } else { Ok(()) }
    }

    /// Returns whether anything changed.
    fn take_options(&mut self, options: &TeachOptions) -> bool {
        let state = &mut self.known.state;
        let same = state.ruler == options.ruler
            && state.world == options.world
            && is_same(&state.given_camera, &options.camera);
        if same {
            return false;
        }
        if state.world != options.world {
            for photograph in &mut state.photographs {
                photograph.pose_by = photograph.pose_by.map(|_| By::Program);
            }
        }
        (state.ruler, state.given_camera, state.world) = (options.ruler, options.camera, options.world);
        self.forget_from(Step::Poses);
        true
    }

    pub(crate) fn save(&mut self) -> Result<(), TeachError> {
        self.known.state.revision += 1;
        let path = self.known.folder.join("teaching.json");
        let text = serde_json::to_string_pretty(&self.known.state)
            .map_err(|e| TeachError::File { path: path.clone(), what: e.to_string() })?;
        write_atomically(&path, text.as_bytes()).map_err(|source| TeachError::Io { path, source })
    }

    /// Adds a photograph from the bytes of a PNG or JPEG file and returns its number. If the name exists already, equal bytes
    /// change nothing and different bytes replace the photograph.
    ///
    /// # Errors
    /// [`TeachError::Image`] for bytes that are not an image, [`TeachError::Io`].
    pub fn add_photograph(&mut self, name: &str, bytes: &[u8]) -> Result<usize, TeachError> {
        let name = photograph_name(name);
        // Refuse invalid images before anything is stored.
        let size = ImageFile::of_bytes(Path::new(&name), bytes).rgb()?.size();
        let png = bytes.starts_with(b"\x89PNG");
        let there = self.known.state.photographs.iter().position(|p| p.name == name);
        let number = there.unwrap_or(self.known.state.photographs.len());
        if number >= MAX_PHOTOGRAPHS {
            let what = format!(
                "expected at most {MAX_PHOTOGRAPHS} photographs; leave out those that show nothing new"
            );
            return Err(TeachError::File { path: PathBuf::from(name), what });
        }
        let file = format!("{number:06}.{}", if png { "png" } else { "jpg" });
        let path = self.path("photographs", &file);
        if there.is_some() && std::fs::read(&path).is_ok_and(|old| old == bytes) {
            return Ok(number);
        }
        sixfold_io::make_folder_of(&path)
            .and_then(|()| write_atomically(&path, bytes))
            .map_err(|source| TeachError::Io { path, source })?;
        let photograph = Photograph {
            name,
            file,
            size: Some(size),
            depth: None,
            camera_from_board: None,
            pose_by: None,
            mask_by: None,
            left_out: None,
            left_out_by_person: false,
        };
        match there {
            Some(number) => {
                self.known.state.photographs[number] = photograph;
                // Points that were marked in the former one.
                if let Some(length) = &mut self.known.state.length {
                    length.ends.retain(|(i, _)| *i != number);
                }
            }
            None => self.known.state.photographs.push(photograph),
        }
        self.forget_from(Step::Poses);
        self.save()?;
        Ok(number)
    }

    /// Adds measured depth to a photograph: a PNG of 16 bits of the same size, from the same camera pose.
    ///
    /// # Errors
    /// [`TeachError`].
    pub fn add_depth(&mut self, number: usize, bytes: &[u8], metres_per_unit: f64) -> Result<(), TeachError> {
        self.check_number(number)?;
        let name = format!("depth of {}", self.known.state.photographs[number].name);
        let photograph = self.path("photographs", &self.known.state.photographs[number].file);
        let size = ImageFile::new(&photograph).size()?;
        ImageFile::of_bytes(Path::new(&name), bytes).depth(metres_per_unit).and_then(|depth| {
            let expected = ImageFile::of_size(Path::new(&name), size, photograph.display().to_string());
            if depth.size() == size { Ok(()) } else { expected.units().map(|_| ()) }
        })?;
        let file = format!("{number:06}.png");
        let path = self.path("depth", &file);
        let depth = Some((file, metres_per_unit));
        if self.known.state.photographs[number].depth == depth
            && std::fs::read(&path).is_ok_and(|old| old == bytes)
        {
            return Ok(());
        }
        sixfold_io::make_folder_of(&path)
            .and_then(|()| write_atomically(&path, bytes))
            .map_err(|source| TeachError::Io { path, source })?;
        self.known.state.photographs[number].depth = depth;
        let says_scale = self.known.state.world == World::Features && self.known.state.length.is_none();
        self.forget_from(if says_scale { Step::Poses } else { Step::Masks });
        self.save()
    }

    /// Finds camera and poses, unless they were found already.
    ///
    /// # Errors
    /// [`TeachError`].
    pub fn locate(&mut self, progress: &dyn Progress) -> Result<(), TeachError> {
        if self.known.state.located.is_some() && self.lacks_poses() {
            self.forget_from(Step::Poses);
        }
        if self.known.state.located.is_some() {
            return Ok(());
        }
        match self.known.state.world {
            World::Board => self.locate_by_board(progress),
            World::Given => self.take_given_poses(),
            World::Features => self.locate_by_features(progress),
        }
    }

    /// Takes the given poses.
    fn take_given_poses(&mut self) -> Result<(), TeachError> {
        let camera = self.known.state.given_camera.ok_or(TeachError::Order { missing: "give the camera" })?;
        for photograph in &mut self.known.state.photographs {
            let (width, height) = photograph.size.unwrap_or((camera.width, camera.height));
            photograph.left_out = if photograph.pose_by != Some(By::Person) {
                Some("no pose was given".to_owned())
            } else if (width, height) != (camera.width, camera.height) {
                Some(format!(
                    "{width}x{height} pixels, the camera is that of {}x{}: expected whole images of one camera",
                    camera.width, camera.height
                ))
            } else {
                None
            };
        }
        if self.known.state.photographs.iter().all(|p| p.left_out.is_some()) {
            let found =
                TeachError::TooFewPhotographs { found: 0, minimum: self.fewest(), reasons: String::new() };
            return Err(self.with_reasons(found));
        }
        self.known.state.located = Some((None, camera, 0.0));
        self.save()
    }

    fn locate_by_board(&mut self, progress: &dyn Progress) -> Result<(), TeachError> {
        let count = self.known.state.photographs.len();
        let mut seen = vec![];
        for (done, photograph) in self.known.state.photographs.iter().enumerate() {
            step(progress, done, count)?;
            let image = read_rgb(&self.path("photographs", &photograph.file))?;
            seen.push(SeenTags::of(&photograph.name, &image));
        }
        let found = locate(&seen, self.known.state.given_camera.as_ref(), self.known.state.ruler)?;
        let Located { board, camera, camera_from_board, rms } = found;
        for (photograph, pose) in self.known.state.photographs.iter_mut().zip(camera_from_board) {
            if photograph.pose_by == Some(By::Person) {
                continue;
            }
            let (pose, reason) = match pose {
                Ok(pose) => (Some(pose.rows()), None),
                Err(reason) => (None, Some(reason)),
            };
            photograph.pose_by = pose.map(|_| By::Program);
            (photograph.camera_from_board, photograph.left_out) = (pose, reason);
        }
        self.known.state.located = Some((Some(board.paper()), camera, rms));
        self.save()
    }

    /// Finds the object in the photographs, unless it was found already.
    ///
    /// # Errors
    /// [`TeachError`].
    pub fn find_masks(
        &mut self,
        segmenter: &dyn Segmenter,
        options: &ShapeOptions,
        progress: &dyn Progress,
    ) -> Result<(), TeachError> {
        if self.known.state.volume.is_some() {
            return Ok(());
        }
        let (capture, numbers) = self.capture()?;
        let found = segment(&capture, segmenter, options, progress).map_err(|e| self.with_reasons(e))?;
        for ((number, mask), photograph) in numbers.iter().zip(&found.masks).zip(&capture.photographs) {
            let entry = &mut self.known.state.photographs[*number];
            entry.left_out = None;
            if entry.mask_by != Some(By::Person) {
                entry.mask_by = mask.as_ref().map(|_| By::Program);
            }
            if let (Some(mask), Some(By::Program)) = (mask, entry.mask_by) {
                let path = self.known.folder.join("masks").join(format!("{number:06}.png"));
                sixfold_io::make_folder_of(&path)
                    .map_err(|source| TeachError::Io { path: path.clone(), source })?;
                // A mask of the whole photograph, as a person would correct it.
                let whole = crate::reduce::enlarged_mask(
                    mask,
                    photograph,
                    self.known.state.located.as_ref().map(|l| &l.1),
                );
                write_mask(&path, &whole)?;
            }
        }
        for (index, reason) in found.left_out {
            self.known.state.photographs[numbers[index]].left_out = Some(reason);
        }
        let array = |v: &Vec3| [v.x, v.y, v.z];
        self.known.state.volume = Some([array(&found.volume.low), array(&found.volume.high)]);
        self.save()
    }

    /// Minimum number of photographs.
    fn fewest(&self) -> usize {
        let with_depth = self.photographs().iter().any(|p| p.depth.is_some() && !p.left_out_by_person);
        if with_depth { FEWEST_WITH_DEPTH } else { FEWEST_PHOTOGRAPHS }
    }

    /// Adds the reasons why photographs are not used to an error about too few.
    fn with_reasons(&self, error: TeachError) -> TeachError {
        match error {
            TeachError::TooFewPhotographs { found, minimum, .. } => {
                let all = self.known.state.photographs.iter();
                let reasons: Vec<String> = all
                    .filter_map(|p| Some(format!("; {}: {}", p.name, p.left_out.as_ref()?)))
                    .take(5)
                    .collect();
                TeachError::TooFewPhotographs { found, minimum, reasons: reasons.concat() }
            }
            other => other,
        }
    }

    /// Makes the mesh, unless it was made already.
    ///
    /// # Errors
    /// [`TeachError`].
    pub fn reconstruct(&mut self, options: &ShapeOptions, progress: &dyn Progress) -> Result<(), TeachError> {
        if self.known.state.shape.is_some() {
            return Ok(());
        }
        let Some([low, high]) = self.known.state.volume else {
            return Err(TeachError::Order { missing: "find the object in the photographs" });
        };
        let (capture, numbers) = self.capture()?;
        let mut masks = vec![];
        for (number, photograph) in numbers.iter().zip(&capture.photographs) {
            let p = &self.known.state.photographs[*number];
            let used = p.mask_by.is_some() && p.left_out.is_none();
            let path = self.path("masks", &format!("{number:06}.png"));
            masks.push(if used {
                Some(crate::reduce::reduced_mask(&read_mask(&path)?, photograph))
            } else {
                None
            });
        }
        let minimum = self.fewest();
        let found = masks.iter().flatten().count();
        if found < minimum {
            return Err(self.with_reasons(TeachError::TooFewPhotographs {
                found,
                minimum,
                reasons: String::new(),
            }));
        }
        let volume = Volume { low: low.into(), high: high.into() };
        let found = Segmentation { volume, masks, left_out: vec![] };
        let shape = match self.given_mesh()? {
            Some(given) => lay(&capture, &found, &given, options, progress)?,
            None => reconstruct(&capture, &found, options, progress)?,
        };
        self.keep_shape(&shape)
    }

    fn keep_shape(&mut self, shape: &Shape) -> Result<(), TeachError> {
        let path = self.known.folder.join("mesh.ply");
        write_ply(&path, &shape.mesh, Unit::Metre, PlyFormat::BinaryLittleEndian)
            .map_err(|e| TeachError::File { path, what: e.to_string() })?;
        self.known.state.shape = Some(ShapeFacts {
            board_from_object: shape.world_from_object.rows(),
            unseen: shape.unseen,
            with_depth: shape.with_depth,
            one_side: shape.one_side,
        });
        self.known.state.outdated = None;
        self.save()
    }

    /// Sets the object's mesh, metres: its pose in the photographs is found, instead of making a mesh from them. `None` removes it.
    ///
    /// # Errors
    /// [`TeachError::File`], [`TeachError::Io`].
    pub fn set_mesh(&mut self, mesh: Option<&Mesh>) -> Result<(), TeachError> {
        let hash = mesh.map(Mesh::contents_hash);
        if hash == self.known.state.given_mesh {
            return Ok(());
        }
        if let Some(mesh) = mesh {
            let path = self.known.folder.join(GIVEN_MESH);
            write_ply(&path, mesh, Unit::Metre, PlyFormat::BinaryLittleEndian)
                .map_err(|e| TeachError::File { path, what: e.to_string() })?;
        }
        self.known.state.given_mesh = hash;
        self.forget_from(Step::Mesh);
        self.save()
    }

    /// Discards the mesh: [`Teaching::reconstruct`] makes it again, perhaps with other options.
    ///
    /// # Errors
    /// [`TeachError::Io`].
    pub fn forget_mesh(&mut self) -> Result<(), TeachError> {
        self.forget_from(Step::Mesh);
        self.save()
    }

    fn given_mesh(&self) -> Result<Option<Mesh>, TeachError> {
        if self.known.state.given_mesh.is_none() {
            return Ok(None);
        }
        let path = self.known.folder.join(GIVEN_MESH);
        read_mesh(&path, Unit::Metre).map(Some).map_err(|e| TeachError::File { path, what: e.to_string() })
    }

    /// Corrects the pose of a photograph. Masks and mesh are made again.
    ///
    /// # Errors
    /// [`TeachError::NoPhotograph`], [`TeachError::Io`]; [`TeachError::File`] for a photograph of another size than the camera's.
    pub fn set_pose(&mut self, number: usize, camera_from_board: &Pose) -> Result<(), TeachError> {
        self.check_number(number)?;
        let photograph = &self.photographs()[number];
        if let (Some(camera), Some((width, height))) = (self.camera(), photograph.size)
            && (camera.width, camera.height) != (width, height)
        {
            let (w, h) = (camera.width, camera.height);
            let what = format!("found {width}x{height} pixels, the camera is that of {w}x{h}: leave it out");
            return Err(TeachError::File { path: PathBuf::from(&photograph.name), what });
        }
        let photograph = &mut self.known.state.photographs[number];
        let given = Some(camera_from_board.rows());
        if photograph.pose_by == Some(By::Person) && is_same(&photograph.camera_from_board, &given) {
            return Ok(());
        }
        photograph.camera_from_board = given;
        (photograph.pose_by, photograph.left_out) = (Some(By::Person), None);
        self.forget_from(Step::Masks);
        self.save()
    }

    /// Sets the up direction and the plane on which the object stands, in the frame of the given poses; nothing of the object is
    /// below the plane. If only `up` is given, the object stands on the highest plane that the masks allow.
    ///
    /// # Errors
    /// [`TeachError::Io`].
    pub fn set_floor(&mut self, up: Option<Vec3>, floor: Option<Plane>) -> Result<(), TeachError> {
        let floor = floor.map(|p| [p.normal.x, p.normal.y, p.normal.z, p.offset]);
        let up = up.map(|v| [v.x, v.y, v.z]);
        if is_same(&self.known.state.floor, &floor) && is_same(&self.known.state.up, &up) {
            return Ok(());
        }
        (self.known.state.floor, self.known.state.up) = (floor, up);
        self.forget_from(Step::Masks);
        self.save()
    }

    /// Corrects a mask, of the photograph's size, without lens distortion; `hidden` is the part of it where something may hide the
    /// object. The mesh is made again; the masks of other photographs only if this one extends beyond the volume in which the
    /// object was found.
    ///
    /// # Errors
    /// [`TeachError::NoPhotograph`], [`TeachError::MaskSize`], [`TeachError::Io`].
    pub fn set_mask(&mut self, number: usize, mask: &Mask, hidden: Option<&Mask>) -> Result<(), TeachError> {
        let size = ImageFile::new(&self.photograph_file(number)?).size()?;
        if mask.size() != size {
            let name = self.known.state.photographs[number].name.clone();
            return Err(TeachError::MaskSize {
                name,
                width: mask.width(),
                height: mask.height(),
                photograph_width: size.0,
                photograph_height: size.1,
            });
        }
        let path = self.path("masks", &format!("{number:06}.png"));
        sixfold_io::make_folder_of(&path).map_err(|source| TeachError::Io { path: path.clone(), source })?;
        if self.known.state.photographs[number].mask_by == Some(By::Person)
            && read_mask_and_hidden(&path)
                .is_ok_and(|(old, was_hidden)| old == *mask && was_hidden.as_ref() == hidden)
        {
            return Ok(());
        }
        write_mask_and_hidden(&path, mask, hidden)?;
        let within = self.is_within(number, mask);
        let photograph = &mut self.known.state.photographs[number];
        photograph.mask_by = Some(By::Person);
        if photograph.camera_from_board.is_some() {
            photograph.left_out = None;
        }
        self.forget_from(if within { Step::Mesh } else { Step::Masks });
        self.save()
    }

    /// Whether everything in a mask can be inside the volume in which the object was found.
    fn is_within(&self, number: usize, mask: &Mask) -> bool {
        let known = (self.camera(), self.camera_from_board(number), self.known.state.volume);
        let (Some(camera), Some(pose), Some([low, high])) = known else { return false };
        let volume = Volume { low: low.into(), high: high.into() };
        let seen = volume.seen_by(&camera.without_distortion(), &pose);
        let (Some([low, high]), Some([x, y, width, height])) = (seen, mask.bounding_box()) else {
            return false;
        };
        let margin = 1.0;
        let (right, bottom) = ((x + width) as f64 - 1.0, (y + height) as f64 - 1.0);
        x as f64 >= low.x - margin
            && y as f64 >= low.y - margin
            && right <= high.x + margin
            && bottom <= high.y + margin
    }

    /// Includes or excludes a photograph. The mesh is made again; the masks are made again if this photograph has none.
    ///
    /// # Errors
    /// [`TeachError::NoPhotograph`], [`TeachError::Io`].
    pub fn set_left_out(&mut self, number: usize, left_out: bool) -> Result<(), TeachError> {
        self.check_number(number)?;
        let photograph = &mut self.known.state.photographs[number];
        if photograph.left_out_by_person != left_out {
            photograph.left_out_by_person = left_out;
            let has_mask = photograph.mask_by.is_some() && photograph.left_out.is_none();
            self.forget_from(if left_out || has_mask { Step::Mesh } else { Step::Masks });
        }
        self.save()
    }

    /// Removes a person's corrections of a photograph; results that depend on them are computed again.
    ///
    /// # Errors
    /// [`TeachError::NoPhotograph`], [`TeachError::Io`].
    pub fn forget_corrections(&mut self, number: usize) -> Result<(), TeachError> {
        self.check_number(number)?;
        let photograph = &mut self.known.state.photographs[number];
        if photograph.mask_by == Some(By::Person) {
            photograph.mask_by = Some(By::Program);
            self.forget_from(Step::Masks);
        }
        let photograph = &mut self.known.state.photographs[number];
        if photograph.pose_by == Some(By::Person) {
            photograph.pose_by = Some(By::Program);
            self.forget_from(Step::Poses);
        }
        self.set_left_out(number, false)
    }

    /// Discards the results that a change invalidates; data that a person gave stays.
    pub(crate) fn forget_from(&mut self, step: Step) {
        let state = &mut self.known.state;
        state.outdated = state.shape.take().or(state.outdated);
        if step <= Step::Masks {
            for p in state.photographs.iter_mut().filter(|p| p.mask_by == Some(By::Program)) {
                p.mask_by = None;
            }
            state.volume = None;
        }
        if step <= Step::Poses {
            (state.located, state.outdated) = (None, None);
            if state.world != World::Given {
                state.floor = None;
            }
            for p in state.photographs.iter_mut().filter(|p| p.pose_by != Some(By::Person)) {
                (p.camera_from_board, p.pose_by, p.left_out) = (None, None, None);
            }
        }
    }
}

/// The step from which results are discarded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Step {
    Poses,
    Masks,
    Mesh,
}
