//! A folder in which an object is taught: photographs go in, every step's result is kept, so that a killed run resumes, and a person can
//! inspect and correct each step.
//!
//! | file | what it holds |
//! |---|---|
//! | `teaching.json` | the state: camera, board, for each photograph its pose, who gave it, why it is left out |
//! | `photographs/000000.jpg` | the photographs as they were given, under numbers |
//! | `depth/000000.png` | measured depth |
//! | `masks/000000.png` | where each shows the object, without lens distortion |
//! | `mesh.ply` | the mesh, metres |

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use sixfold_board::{Board, Paper};
use sixfold_geometry::nalgebra::Matrix4;
use sixfold_geometry::{Camera, Mask, Pose, Progress, Vec3};
use sixfold_io::{
    ImageFile, WriteLock, limits, read_depth, read_mask, read_regular_text, read_rgb, write_atomically,
    write_mask,
};
use sixfold_mesh::{Mesh, PlyFormat, Unit, read_mesh, write_ply};

use crate::error::TeachError;
use crate::located::{Located, SeenTags, locate};
use crate::record::Posed;
use crate::reduce::reduced_photograph;
use crate::shape::{Capture, Segmentation, Shape, ShapeOptions, reconstruct, segment, step};
use crate::silhouette::Segmenter;
use crate::view::{PosedPhotograph, Volume};

/// The only version of `teaching.json` there is.
const VERSION: u32 = 1;
/// Most photographs.
pub const MOST_PHOTOGRAPHS: usize = 200;
/// Longer side at which photographs are worked on, pixels.
const SIDE: usize = 2048;

/// Who gave a pose or a mask.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum By {
    /// Found.
    Program,
    /// Given, or corrected.
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
    /// Somebody said not to use it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub left_out_by_person: bool,
}

impl Photograph {
    fn pose(&self) -> Option<Pose> {
        let rows = self.camera_from_board?;
        let flat: Vec<f64> = rows.iter().flatten().copied().collect();
        Pose::from_matrix(&Matrix4::from_row_slice(&flat)).ok()
    }
}

/// What is known of the mesh.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShapeFacts {
    /// Takes points of the object's frame to the board's, by rows.
    pub board_from_object: [[f64; 4]; 4],
    /// Fraction of the surface that no photograph shows.
    pub unseen: f64,
    /// Fraction of the object's pixels with depth, measured or by comparison of photographs.
    pub with_depth: f64,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    version: u32,
    /// What the ruler on the printed board measures, metres.
    ruler: Option<f64>,
    /// A camera that was given.
    given_camera: Option<Camera>,
    photographs: Vec<Photograph>,
    /// What was found: paper, camera, error in pixels.
    located: Option<(Paper, Camera, f64)>,
    /// The space that holds the object: least and largest coordinates.
    volume: Option<[[f64; 3]; 2]>,
    shape: Option<ShapeFacts>,
}

/// What is known before the first photograph.
#[derive(Debug, Clone, Copy, Default)]
pub struct TeachOptions {
    /// What the ruler on the printed board measures, metres; `None` for 0.1.
    pub ruler: Option<f64>,
    /// The camera; `None` to find it from the photographs.
    pub camera: Option<Camera>,
}

/// A folder in which an object is taught. One process at a time changes it.
#[derive(Debug)]
pub struct Teaching {
    folder: PathBuf,
    state: State,
    _lock: WriteLock,
}

fn rows(pose: &Pose) -> [[f64; 4]; 4] {
    let m = pose.to_matrix();
    std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)]))
}

impl Teaching {
    /// Opens the folder, or begins in a new one. Options that differ from those that it was begun with begin the steps again.
    ///
    /// # Errors
    /// [`TeachError::File`], [`TeachError::Io`].
    pub fn open(folder: impl Into<PathBuf>, options: &TeachOptions) -> Result<Teaching, TeachError> {
        let folder = folder.into();
        let lock = WriteLock::take(&folder.join("teaching.json"))
            .map_err(|e| TeachError::File { path: folder.clone(), what: e.to_string() })?;
        let path = folder.join("teaching.json");
        let state = if path.exists() {
            let wrong = |what: String| TeachError::File { path: path.clone(), what };
            let text = read_regular_text(&path, limits::SMALL_TEXT).map_err(|e| wrong(e.to_string()))?;
            let state: State = serde_json::from_str(&text).map_err(|e| wrong(e.to_string()))?;
            if state.version != VERSION {
                return Err(wrong(format!("field version: found {}, expected {VERSION}", state.version)));
            }
            state
        } else {
            State {
                version: VERSION,
                ruler: options.ruler,
                given_camera: options.camera,
                photographs: vec![],
                located: None,
                volume: None,
                shape: None,
            }
        };
        let mut teaching = Teaching { folder, state, _lock: lock };
        let given = options.ruler.is_some() || options.camera.is_some();
        let same = teaching.state.ruler == options.ruler && teaching.state.given_camera == options.camera;
        if given && !same {
            teaching.state.ruler = options.ruler;
            teaching.state.given_camera = options.camera;
            teaching.forget_from(Step::Poses);
        }
        teaching.save()?;
        Ok(teaching)
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    fn path(&self, kind: &str, file: &str) -> PathBuf {
        self.folder.join(kind).join(file)
    }

    fn save(&self) -> Result<(), TeachError> {
        let path = self.folder.join("teaching.json");
        let text = serde_json::to_string_pretty(&self.state)
            .map_err(|e| TeachError::File { path: path.clone(), what: e.to_string() })?;
        write_atomically(&path, text.as_bytes()).map_err(|source| TeachError::Io { path, source })
    }

    /// Adds a photograph from the bytes of a PNG or JPEG file; its number. A name that is there already is taken once: the same
    /// bytes again change nothing, others replace it.
    ///
    /// # Errors
    /// [`TeachError::Image`] for bytes that are none, [`TeachError::Io`].
    pub fn add_photograph(&mut self, name: &str, bytes: &[u8]) -> Result<usize, TeachError> {
        let name: String = name.chars().filter(|c| !c.is_control()).take(200).collect();
        // Refused before anything is kept.
        ImageFile::of_bytes(Path::new(&name), bytes).rgb()?;
        let png = bytes.starts_with(b"\x89PNG");
        let there = self.state.photographs.iter().position(|p| p.name == name);
        let number = there.unwrap_or(self.state.photographs.len());
        if number >= MOST_PHOTOGRAPHS {
            let what = format!(
                "expected at most {MOST_PHOTOGRAPHS} photographs; leave out those that show nothing new"
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
            depth: None,
            camera_from_board: None,
            pose_by: None,
            mask_by: None,
            left_out: None,
            left_out_by_person: false,
        };
        match there {
            Some(number) => self.state.photographs[number] = photograph,
            None => self.state.photographs.push(photograph),
        }
        self.forget_from(Step::Poses);
        self.save()?;
        Ok(number)
    }

    /// Adds measured depth to a photograph: a PNG of 16 bits of the same size, from the same place.
    ///
    /// # Errors
    /// [`TeachError`].
    pub fn add_depth(&mut self, number: usize, bytes: &[u8], metres_per_unit: f64) -> Result<(), TeachError> {
        self.check_number(number)?;
        let name = format!("depth of {}", self.state.photographs[number].name);
        let photograph = self.path("photographs", &self.state.photographs[number].file);
        let size = ImageFile::new(&photograph).size()?;
        ImageFile::of_bytes(Path::new(&name), bytes).depth(metres_per_unit).and_then(|depth| {
            let expected = ImageFile::of_size(Path::new(&name), size, photograph.display().to_string());
            if depth.size() == size { Ok(()) } else { expected.units().map(|_| ()) }
        })?;
        let file = format!("{number:06}.png");
        let path = self.path("depth", &file);
        let depth = Some((file, metres_per_unit));
        if self.state.photographs[number].depth == depth && std::fs::read(&path).is_ok_and(|old| old == bytes)
        {
            return Ok(());
        }
        sixfold_io::make_folder_of(&path)
            .and_then(|()| write_atomically(&path, bytes))
            .map_err(|source| TeachError::Io { path, source })?;
        self.state.photographs[number].depth = depth;
        self.forget_from(Step::Masks);
        self.save()
    }

    /// The photographs.
    pub fn photographs(&self) -> &[Photograph] {
        &self.state.photographs
    }

    /// The file of a photograph.
    ///
    /// # Errors
    /// [`TeachError::NoPhotograph`].
    pub fn photograph_file(&self, number: usize) -> Result<PathBuf, TeachError> {
        self.check_number(number)?;
        Ok(self.path("photographs", &self.state.photographs[number].file))
    }

    fn check_number(&self, index: usize) -> Result<(), TeachError> {
        let photographs = self.state.photographs.len();
        if index < photographs { Ok(()) } else { Err(TeachError::NoPhotograph { index, photographs }) }
    }

    /// The camera, once it is found.
    pub fn camera(&self) -> Option<&Camera> {
        self.state.located.as_ref().map(|(_, camera, _)| camera)
    }

    /// The board, once it is found.
    pub fn board(&self) -> Option<Board> {
        let (paper, ..) = self.state.located.as_ref()?;
        let board = Board::new(*paper);
        Some(self.state.ruler.and_then(|ruler| board.with_ruler(ruler)).unwrap_or(board))
    }

    /// A photograph's pose, if it has one.
    pub fn camera_from_board(&self, number: usize) -> Option<Pose> {
        self.state.photographs.get(number)?.pose()
    }

    /// Finds camera and poses, unless that is done.
    ///
    /// # Errors
    /// [`TeachError`].
    pub fn locate(&mut self, progress: &dyn Progress) -> Result<(), TeachError> {
        if self.state.located.is_some() {
            return Ok(());
        }
        let count = self.state.photographs.len();
        let mut seen = vec![];
        for (done, photograph) in self.state.photographs.iter().enumerate() {
            step(progress, done, count)?;
            let image = read_rgb(&self.path("photographs", &photograph.file))?;
            seen.push(SeenTags::of(&photograph.name, &image));
        }
        let found = locate(&seen, self.state.given_camera.as_ref(), self.state.ruler)?;
        let Located { board, camera, camera_from_board, rms } = found;
        for (photograph, pose) in self.state.photographs.iter_mut().zip(camera_from_board) {
            if photograph.pose_by == Some(By::Person) {
                continue;
            }
            let (pose, reason) = match pose {
                Ok(pose) => (Some(rows(&pose)), None),
                Err(reason) => (None, Some(reason)),
            };
            photograph.pose_by = pose.map(|_| By::Program);
            (photograph.camera_from_board, photograph.left_out) = (pose, reason);
        }
        self.state.located = Some((board.paper(), camera, rms));
        self.save()
    }

    /// The photographs that can be used, with their numbers.
    ///
    /// # Errors
    /// [`TeachError`].
    fn capture(&self) -> Result<(Capture, Vec<usize>), TeachError> {
        let Some((_, camera, _)) = &self.state.located else {
            return Err(TeachError::Order { missing: "find the poses of the photographs" });
        };
        let board = self.board().ok_or(TeachError::Order { missing: "find the board" })?;
        let (mut photographs, mut numbers) = (vec![], vec![]);
        for (number, p) in self.state.photographs.iter().enumerate() {
            let Some(pose) = p.pose().filter(|_| !p.left_out_by_person) else { continue };
            let image = read_rgb(&self.path("photographs", &p.file))?;
            let depth = match &p.depth {
                Some((file, unit)) => Some(read_depth(&self.path("depth", file), *unit)?),
                None => None,
            };
            let mask = match p.mask_by {
                Some(By::Person) => Some(read_mask(&self.path("masks", &format!("{number:06}.png")))?),
                _ => None,
            };
            let posed = PosedPhotograph {
                name: p.name.clone(),
                image: Arc::new(image),
                depth: depth.map(Arc::new),
                mask: mask.map(Arc::new),
                camera: *camera,
                camera_from_world: pose,
            };
            photographs.push(reduced_photograph(posed, SIDE));
            numbers.push(number);
        }
        Ok((Capture::on_board(photographs, board), numbers))
    }

    /// Finds the object in the photographs, unless that is done.
    ///
    /// # Errors
    /// [`TeachError`].
    pub fn find_masks(
        &mut self,
        segmenter: &dyn Segmenter,
        options: &ShapeOptions,
        progress: &dyn Progress,
    ) -> Result<(), TeachError> {
        if self.state.volume.is_some() {
            return Ok(());
        }
        let (capture, numbers) = self.capture()?;
        let found = segment(&capture, segmenter, options, progress).map_err(|e| self.with_reasons(e))?;
        for ((number, mask), photograph) in numbers.iter().zip(&found.masks).zip(&capture.photographs) {
            let entry = &mut self.state.photographs[*number];
            entry.left_out = None;
            if entry.mask_by != Some(By::Person) {
                entry.mask_by = mask.as_ref().map(|_| By::Program);
            }
            if let (Some(mask), Some(By::Program)) = (mask, entry.mask_by) {
                let path = self.folder.join("masks").join(format!("{number:06}.png"));
                sixfold_io::make_folder_of(&path)
                    .map_err(|source| TeachError::Io { path: path.clone(), source })?;
                // Of the whole photograph, as somebody who corrects it would give it.
                let whole =
                    crate::reduce::enlarged_mask(mask, photograph, self.state.located.as_ref().map(|l| &l.1));
                write_mask(&path, &whole)?;
            }
        }
        for (index, reason) in found.left_out {
            self.state.photographs[numbers[index]].left_out = Some(reason);
        }
        let array = |v: &Vec3| [v.x, v.y, v.z];
        self.state.volume = Some([array(&found.volume.low), array(&found.volume.high)]);
        self.save()
    }

    /// Says why photographs are not used, where there are too few.
    fn with_reasons(&self, error: TeachError) -> TeachError {
        match error {
            TeachError::TooFewPhotographs { found, least, .. } => {
                let all = self.state.photographs.iter();
                let reasons: Vec<String> = all
                    .filter_map(|p| Some(format!("; {}: {}", p.name, p.left_out.as_ref()?)))
                    .take(5)
                    .collect();
                TeachError::TooFewPhotographs { found, least, reasons: reasons.concat() }
            }
            other => other,
        }
    }

    /// Makes the mesh, unless that is done.
    ///
    /// # Errors
    /// [`TeachError`].
    pub fn reconstruct(&mut self, options: &ShapeOptions, progress: &dyn Progress) -> Result<(), TeachError> {
        if self.state.shape.is_some() {
            return Ok(());
        }
        let Some([low, high]) = self.state.volume else {
            return Err(TeachError::Order { missing: "find the object in the photographs" });
        };
        let (capture, numbers) = self.capture()?;
        let mut masks = vec![];
        for (number, photograph) in numbers.iter().zip(&capture.photographs) {
            let p = &self.state.photographs[*number];
            let used = p.mask_by.is_some() && p.left_out.is_none();
            let path = self.path("masks", &format!("{number:06}.png"));
            masks.push(if used {
                Some(crate::reduce::reduced_mask(&read_mask(&path)?, photograph))
            } else {
                None
            });
        }
        let volume = Volume { low: low.into(), high: high.into() };
        let found = Segmentation { volume, masks, left_out: vec![] };
        let shape = reconstruct(&capture, &found, options, progress)?;
        self.keep_shape(&shape)
    }

    fn keep_shape(&mut self, shape: &Shape) -> Result<(), TeachError> {
        let path = self.folder.join("mesh.ply");
        write_ply(&path, &shape.mesh, Unit::Metre, PlyFormat::BinaryLittleEndian)
            .map_err(|e| TeachError::File { path, what: e.to_string() })?;
        self.state.shape = Some(ShapeFacts {
            board_from_object: rows(&shape.world_from_object),
            unseen: shape.unseen,
            with_depth: shape.with_depth,
        });
        self.save()
    }

    /// What is known of the mesh, once it is made.
    pub fn shape(&self) -> Option<&ShapeFacts> {
        self.state.shape.as_ref()
    }

    /// The mesh, once it is made.
    ///
    /// # Errors
    /// [`TeachError`].
    pub fn mesh(&self) -> Result<Mesh, TeachError> {
        if self.state.shape.is_none() {
            return Err(TeachError::Order { missing: "make the mesh" });
        }
        let path = self.folder.join("mesh.ply");
        read_mesh(&path, Unit::Metre).map_err(|e| TeachError::File { path, what: e.to_string() })
    }

    /// A photograph's mask, without lens distortion, once it is found.
    ///
    /// # Errors
    /// [`TeachError`].
    pub fn mask(&self, number: usize) -> Result<Option<Mask>, TeachError> {
        self.check_number(number)?;
        if self.state.photographs[number].mask_by.is_none() {
            return Ok(None);
        }
        Ok(Some(read_mask(&self.path("masks", &format!("{number:06}.png")))?))
    }

    /// Corrects a pose: where the camera was. The mesh is made again.
    ///
    /// # Errors
    /// [`TeachError::NoPhotograph`], [`TeachError::Io`].
    pub fn set_pose(&mut self, number: usize, camera_from_board: &Pose) -> Result<(), TeachError> {
        self.check_number(number)?;
        let photograph = &mut self.state.photographs[number];
        photograph.camera_from_board = Some(rows(camera_from_board));
        (photograph.pose_by, photograph.left_out) = (Some(By::Person), None);
        self.forget_from(Step::Masks);
        self.save()
    }

    /// Corrects a mask, of the photograph's size, without lens distortion. The mesh is made again.
    ///
    /// # Errors
    /// [`TeachError::NoPhotograph`], [`TeachError::MaskSize`], [`TeachError::Io`].
    pub fn set_mask(&mut self, number: usize, mask: &Mask) -> Result<(), TeachError> {
        let size = ImageFile::new(&self.photograph_file(number)?).size()?;
        if mask.size() != size {
            let name = self.state.photographs[number].name.clone();
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
        write_mask(&path, mask)?;
        let photograph = &mut self.state.photographs[number];
        (photograph.mask_by, photograph.left_out) = (Some(By::Person), None);
        self.forget_from(Step::Masks);
        self.save()
    }

    /// Uses a photograph, or does not.
    ///
    /// # Errors
    /// [`TeachError::NoPhotograph`], [`TeachError::Io`].
    pub fn set_left_out(&mut self, number: usize, left_out: bool) -> Result<(), TeachError> {
        self.check_number(number)?;
        if self.state.photographs[number].left_out_by_person != left_out {
            self.state.photographs[number].left_out_by_person = left_out;
            self.forget_from(Step::Masks);
        }
        self.save()
    }

    /// Results that a change makes wrong are forgotten; what a person gave stays.
    fn forget_from(&mut self, step: Step) {
        if step == Step::Poses {
            self.state.located = None;
            for p in self.state.photographs.iter_mut().filter(|p| p.pose_by != Some(By::Person)) {
                (p.camera_from_board, p.pose_by, p.left_out) = (None, None, None);
            }
        }
        for p in self.state.photographs.iter_mut().filter(|p| p.mask_by == Some(By::Program)) {
            p.mask_by = None;
        }
        self.state.volume = None;
        self.state.shape = None;
    }

    /// The photographs that are used, reduced, with mask and the pose of the object in each.
    ///
    /// # Errors
    /// [`TeachError`].
    pub(crate) fn posed(&self) -> Result<Vec<Posed>, TeachError> {
        let Some(shape) = &self.state.shape else {
            return Err(TeachError::Order { missing: "make the mesh" });
        };
        let flat: Vec<f64> = shape.board_from_object.iter().flatten().copied().collect();
        let board_from_object =
            Pose::from_matrix(&Matrix4::from_row_slice(&flat)).map_err(|e| TeachError::File {
                path: self.folder.join("teaching.json"),
                what: format!("field board_from_object: {e}"),
            })?;
        let (capture, numbers) = self.capture()?;
        let mut all = vec![];
        for (number, p) in numbers.iter().zip(&capture.photographs) {
            let entry = &self.state.photographs[*number];
            if entry.left_out.is_some() {
                continue;
            }
            let Some(mask) = self.mask(*number)? else { continue };
            let mask = crate::reduce::reduced_mask(&mask, p);
            let pose = p.camera_from_world;
            let camera_from_object = Pose::new(
                pose.rotation() * board_from_object.rotation(),
                pose.transform_point(&board_from_object.translation()),
            );
            all.push((p.name.clone(), (*p.image).clone(), p.camera, camera_from_object, mask));
        }
        Ok(all)
    }
}

/// From where results are forgotten.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    Poses,
    Masks,
}
