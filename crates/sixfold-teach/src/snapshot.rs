//! A read-only view of a teaching's folder, also while another process or thread works there.
//!
//! `teaching.json` is replaced as a whole after each step, so a reader gets the state after one of the steps.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use sixfold_board::{Board, Paper};
use sixfold_geometry::{Camera, Mask, Plane, Pose, RgbImage, Vec3};
use sixfold_io::{limits, read_depth, read_mask_and_hidden, read_regular_text, read_rgb};
use sixfold_mesh::{Mesh, Unit, read_mesh};

use crate::error::TeachError;
use crate::record::Posed;
use crate::reduce::reduced_photograph;
use crate::shape::Capture;
use crate::teaching::{By, Photograph, ShapeFacts, TeachOptions, World};
use crate::unboarded::KnownLength;
use crate::view::PosedPhotograph;

/// The only version of `teaching.json`.
pub(crate) const VERSION: u32 = 1;
/// Longer side of photographs during processing, pixels.
const SIDE: usize = 2048;

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct State {
    pub version: u32,
    /// Measured length of the ruler on the printed board, metres.
    pub ruler: Option<f64>,
    /// What the poses are relative to.
    #[serde(default)]
    pub world: World,
    /// A camera that was given.
    pub given_camera: Option<Camera>,
    /// A given length, for photographs without a board.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub length: Option<KnownLength>,
    pub photographs: Vec<Photograph>,
    /// Number of changes.
    #[serde(default)]
    pub revision: u64,
    /// Results: the paper, if there is a board; the camera; the error in pixels.
    pub located: Option<(Option<Paper>, Camera, f64)>,
    /// The plane on which the object stands, without a board: its normal, and its distance from the origin along the normal,
    /// metres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub floor: Option<[f64; 4]>,
    /// The up direction, if given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub up: Option<[f64; 3]>,
    /// The volume that contains the object: smallest and largest coordinates.
    pub volume: Option<[[f64; 3]; 2]>,
    pub shape: Option<ShapeFacts>,
    /// The shape of the mesh in the folder if it was made before a correction; it helps with further corrections.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub outdated: Option<ShapeFacts>,
    /// Hash of a mesh that was given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub given_mesh: Option<u64>,
}

/// The state of a teaching at one moment.
#[derive(Debug, Clone)]
pub struct Snapshot {
    pub(crate) folder: PathBuf,
    pub(crate) state: State,
}

type Outlines = (RgbImage, Option<Mask>, Option<Mask>);

pub(crate) fn composed(a: &Pose, b: &Pose) -> Pose {
    Pose::new(a.rotation() * b.rotation(), a.transform_point(&b.translation()))
}

impl Snapshot {
    /// Reads the state of a folder; nothing is locked and nothing written.
    ///
    /// # Errors
    /// [`TeachError::File`].
    pub fn read(folder: impl Into<PathBuf>) -> Result<Snapshot, TeachError> {
        let folder = folder.into();
        let path = folder.join("teaching.json");
        let wrong = |what: String| TeachError::File { path: path.clone(), what };
        let text = read_regular_text(&path, limits::SMALL_TEXT).map_err(|e| wrong(e.to_string()))?;
        let state: State = serde_json::from_str(&text).map_err(|e| wrong(e.to_string()))?;
        if state.version != VERSION {
            return Err(wrong(format!("field version: found {}, expected {VERSION}", state.version)));
        }
        Ok(Snapshot { folder, state })
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    pub(crate) fn path(&self, kind: &str, file: &str) -> PathBuf {
        self.folder.join(kind).join(file)
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

    pub(crate) fn check_number(&self, index: usize) -> Result<(), TeachError> {
        let photographs = self.state.photographs.len();
        if index < photographs { Ok(()) } else { Err(TeachError::NoPhotograph { index, photographs }) }
    }

    /// The camera, once it is found.
    pub fn camera(&self) -> Option<&Camera> {
        self.state.located.as_ref().map(|(_, camera, _)| camera)
    }

    /// The board, once it is found, if there is one.
    pub fn board(&self) -> Option<Board> {
        let paper = self.state.located.as_ref()?.0?;
        let board = Board::new(paper);
        Some(self.state.ruler.and_then(|ruler| board.with_ruler(ruler)).unwrap_or(board))
    }

    /// The plane on which the object stands, without a board and if known.
    pub fn floor(&self) -> Option<Plane> {
        self.state.floor.map(|[x, y, z, offset]| Plane { normal: Vec3::new(x, y, z), offset })
    }

    /// A photograph's pose, if it has one.
    pub fn camera_from_board(&self, number: usize) -> Option<Pose> {
        self.state.photographs.get(number)?.pose()
    }

    /// The photographs that can be used, with their numbers.
    ///
    /// # Errors
    /// [`TeachError`].
    pub(crate) fn capture(&self) -> Result<(Capture, Vec<usize>), TeachError> {
        let Some((_, camera, _)) = &self.state.located else {
            return Err(TeachError::Order { missing: "find the poses of the photographs" });
        };
        let (mut photographs, mut numbers) = (vec![], vec![]);
        for (number, p) in self.state.photographs.iter().enumerate() {
            let Some(pose) = p.pose().filter(|_| !p.left_out_by_person) else { continue };
            let image = read_rgb(&self.path("photographs", &p.file))?;
            if image.size() != (camera.width, camera.height) {
                continue;
            }
            let depth = match &p.depth {
                Some((file, unit)) => Some(read_depth(&self.path("depth", file), *unit)?),
                None => None,
            };
            let (mask, hidden) = match p.mask_by {
                Some(By::Person) => {
                    let (mask, hidden) =
                        read_mask_and_hidden(&self.path("masks", &format!("{number:06}.png")))?;
                    (Some(Arc::new(mask)), hidden.map(Arc::new))
                }
                _ => (None, None),
            };
            let posed = PosedPhotograph {
                name: p.name.clone(),
                image: Arc::new(image),
                depth: depth.map(Arc::new),
                mask,
                hidden,
                camera: *camera,
                camera_from_world: pose,
            };
            photographs.push(reduced_photograph(posed, SIDE));
            numbers.push(number);
        }
        let capture = match self.board() {
            Some(board) => Capture::on_board(photographs, board),
            None => Capture {
                up: self.state.up.map(Vec3::from),
                ..Capture::without_board(photographs, self.floor())
            },
        };
        Ok((capture, numbers))
    }

    /// Data of the mesh, once it is made.
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
        self.mesh_file()
    }

    fn mesh_file(&self) -> Result<Mesh, TeachError> {
        let path = self.folder.join("mesh.ply");
        read_mesh(&path, Unit::Metre).map_err(|e| TeachError::File { path, what: e.to_string() })
    }

    /// The pixels of a photograph that certainly show the object, without lens distortion, once they are found.
    ///
    /// # Errors
    /// [`TeachError`].
    pub fn mask(&self, number: usize) -> Result<Option<Mask>, TeachError> {
        self.check_number(number)?;
        if self.state.photographs[number].mask_by.is_none() {
            return Ok(None);
        }
        let (mask, hidden) = read_mask_and_hidden(&self.path("masks", &format!("{number:06}.png")))?;
        Ok(Some(match hidden {
            Some(hidden) => {
                Mask::from_fn(mask.width(), mask.height(), |x, y| mask[(x, y)] && !hidden[(x, y)])
            }
            None => mask,
        }))
    }

    /// The photographs that are used, reduced, with mask and the pose of the object in each.
    ///
    /// # Errors
    /// [`TeachError`].
    pub(crate) fn posed(&self) -> Result<Vec<Posed>, TeachError> {
        let Some(shape) = &self.state.shape else {
            return Err(TeachError::Order { missing: "make the mesh" });
        };
        let board_from_object = self.pose_of(shape)?;
        let (capture, numbers) = self.capture()?;
        let mut all = vec![];
        for (number, p) in numbers.iter().zip(&capture.photographs) {
            let entry = &self.state.photographs[*number];
            if entry.left_out.is_some() {
                continue;
            }
            let Some(mask) = self.mask(*number)? else { continue };
            let mask = crate::reduce::reduced_mask(&mask, p);
            let camera_from_object = composed(&p.camera_from_world, &board_from_object);
            all.push((p.name.clone(), (*p.image).clone(), p.camera, camera_from_object, mask));
        }
        Ok(all)
    }

    fn pose_of(&self, shape: &ShapeFacts) -> Result<Pose, TeachError> {
        Pose::from_rows(&shape.board_from_object).map_err(|e| TeachError::File {
            path: self.folder.join("teaching.json"),
            what: format!("field board_from_object: {e}"),
        })
    }

    /// Data of the mesh that was made last, even if corrections have outdated it.
    pub fn last_shape(&self) -> Option<&ShapeFacts> {
        self.state.shape.as_ref().or(self.state.outdated.as_ref())
    }

    /// The mesh that was made last and its pose on the board, even if corrections have outdated it.
    ///
    /// # Errors
    /// [`TeachError`].
    pub fn last_mesh(&self) -> Result<Option<(Mesh, Pose)>, TeachError> {
        let Some(shape) = self.last_shape() else { return Ok(None) };
        Ok(Some((self.mesh_file()?, self.pose_of(shape)?)))
    }

    /// The options with which the teaching was started.
    pub fn options(&self) -> TeachOptions {
        TeachOptions { ruler: self.state.ruler, camera: self.state.given_camera, world: self.state.world }
    }

    /// The given length between two marked points, for photographs without a board.
    pub fn length(&self) -> Option<&KnownLength> {
        self.state.length.as_ref()
    }

    /// Whether a mesh was given, to be aligned with the photographs.
    pub fn has_given_mesh(&self) -> bool {
        self.state.given_mesh.is_some()
    }

    /// A number that differs after each change.
    pub fn revision(&self) -> u64 {
        self.state.revision
    }

    /// Root mean square distance of the detected tag corners, without a board of the features, to their projections, pixels; once poses
    /// are found.
    pub fn rms(&self) -> Option<f64> {
        self.state.located.as_ref().map(|(_, _, rms)| *rms)
    }

    /// A photograph without lens distortion, at most `side` pixels wide and high, with its camera; unchanged and without a camera
    /// if the camera is unknown or for another image size.
    ///
    /// # Errors
    /// [`TeachError::NoPhotograph`], [`TeachError::Image`].
    pub fn image(&self, number: usize, side: usize) -> Result<(RgbImage, Option<Camera>), TeachError> {
        let image = read_rgb(&self.photograph_file(number)?)?;
        let lens = self.camera().filter(|c| (c.width, c.height) == image.size());
        Ok(crate::reduce::undistorted(&image, lens, side))
    }

    /// A photograph with its lens distortion, at most `side` pixels wide and high: a point has the pixel of
    /// [`KnownLength::ends`] in it, scaled.
    ///
    /// # Errors
    /// [`TeachError::NoPhotograph`], [`TeachError::Image`].
    pub fn image_as_taken(&self, number: usize, side: usize) -> Result<RgbImage, TeachError> {
        let image = read_rgb(&self.photograph_file(number)?)?;
        Ok(crate::reduce::undistorted(&image, None, side).0)
    }

    /// The image of [`Snapshot::image`], with the border of the mask and the outline of the mesh that was made last.
    ///
    /// # Errors
    /// [`TeachError`].
    pub fn overlay(&self, number: usize, side: usize) -> Result<RgbImage, TeachError> {
        let (image, mask, outline) = self.outlines(number, side)?;
        Ok(crate::pictures::outlined(&image, mask.as_ref(), outline.as_ref()))
    }

    /// The same for a crop of the object and its surroundings, `side` pixels wide and high.
    ///
    /// # Errors
    /// [`TeachError`].
    pub fn close_up(&self, number: usize, side: usize) -> Result<RgbImage, TeachError> {
        let (image, mask, outline) = self.outlines(number, SIDE)?;
        Ok(crate::pictures::close_up(&image, mask.as_ref(), outline.as_ref(), side))
    }

    /// A photograph as in [`Snapshot::image`], its mask, and the pixels that the mesh covers.
    fn outlines(&self, number: usize, side: usize) -> Result<Outlines, TeachError> {
        let (image, camera) = self.image(number, side)?;
        let mask = self.mask(number)?.map(|mask| crate::reduce::of_size(&mask, image.size()));
        let outline = match (camera, self.camera_from_board(number), self.last_mesh()?) {
            (Some(camera), Some(pose), Some((mesh, board_from_object))) => {
                let pose = composed(&pose, &board_from_object);
                Some(sixfold_render::render_depth(&mesh, &pose, &camera).map(|d| *d > 0.0))
            }
            _ => None,
        };
        Ok((image, mask, outline))
    }
}
