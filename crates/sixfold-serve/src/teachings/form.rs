//! The forms of teachings: photographs with their data, checked when they arrive.

use std::collections::BTreeMap;
use std::path::Path;

use sixfold_board::{Board, Paper};
use sixfold_geometry::Camera;
use sixfold_io::{CameraFile, ImageFile};
use sixfold_mesh::Mesh;
use sixfold_teach::{KnownLength, Photograph, Snapshot, TeachOptions, Teaching, World, photograph_name};

use super::of_teach;
use super::scale::{NamedSize, Scale};
use crate::error::{Answer, ApiError};
use crate::form::{Form, FormRule, UploadedFile};
use crate::meshes::mesh_of_form;

pub(super) const NEW: FormRule = FormRule {
    files: &["camera", "mesh"],
    many_files: &["photographs", "depth", "resource"],
    texts: &[
        "name",
        "depth_scale",
        "ruler",
        "without_board",
        "length",
        "ends",
        "unit",
        "hull_only",
        "replace",
        "start",
    ],
};

pub(super) const MORE: FormRule = FormRule {
    files: &["camera", "mesh"],
    many_files: &["photographs", "depth", "resource"],
    texts: &["depth_scale", "ruler", "without_board", "length", "ends", "unit", "remove_mesh", "hull_only"],
};

/// The form of `POST /v1/teachings`.
#[derive(utoipa::ToSchema)]
#[allow(dead_code)]
pub(crate) struct TeachingForm {
    /// The name that the object will have: up to 100 letters, digits, - and _.
    name: String,
    /// Photographs of the object, on the printed board unless `without_board`, PNG or JPEG, from all sides: 8 to 40 in all, more by
    /// further requests.
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
    /// The photographs show no board: camera poses come from the object's surroundings, which need texture and must not move
    /// (default: false). The scale comes from `length` and `ends`, or from depth; with `start` false they can be sent later.
    without_board: Option<bool>,
    /// Measured length between the two points of `ends`, metres, 0.005 to 5.
    length: Option<f64>,
    /// The pixels at which two or more photographs, from different sides, show the two ends of `length`: a list in JSON, as `ends`
    /// of a teaching.
    #[schema(value_type = Option<String>, content_media_type = "application/json",
        example = json!("[{\"photograph\": \"a.jpg\", \"points\": [[812, 640], [1010, 655]]}, {\"photograph\": \"b.jpg\", \"points\": [[700, 655], [934, 628]]}]"))]
    ends: Option<String>,
    /// Mesh of the object, to align with the photographs instead of making one; without colours it gets theirs. PLY, OBJ, STL, glTF,
    /// GLB or XYZ.
    #[schema(value_type = Option<String>, format = Binary)]
    mesh: Option<Vec<u8>>,
    /// Unit of the mesh file: m, cm, mm or in; needed with it.
    unit: Option<String>,
    /// Files that the mesh names (materials, textures, buffers), under the names that it has for them.
    #[schema(value_type = Option<Vec<String>>, format = Binary)]
    resource: Option<Vec<Vec<u8>>>,
    /// Do not search for hollows by comparing photographs (default: false); not with a mesh.
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
    /// Whether the photographs show no board.
    without_board: Option<bool>,
    /// Measured length between the two points of `ends`, metres, 0.005 to 5, for photographs without the board.
    length: Option<f64>,
    /// The pixels of its two ends, all of them: a list in JSON as for a new teaching. `[]` removes the length.
    #[schema(value_type = Option<String>, content_media_type = "application/json")]
    ends: Option<String>,
    /// Mesh of the object, to align with the photographs; it replaces one that was given before.
    #[schema(value_type = Option<String>, format = Binary)]
    mesh: Option<Vec<u8>>,
    /// Unit of the mesh file: m, cm, mm or in; needed with it.
    unit: Option<String>,
    /// Files that the mesh names (materials, textures, buffers), under the names that it has for them.
    #[schema(value_type = Option<Vec<String>>, format = Binary)]
    resource: Option<Vec<Vec<u8>>>,
    /// Forget the given mesh: one is made from the photographs.
    remove_mesh: Option<bool>,
    /// Do not search for hollows by comparing photographs; not with a mesh.
    hull_only: Option<bool>,
}

/// What a teaching has before a form changes it.
#[derive(Debug, Default)]
pub(super) struct Before {
    options: TeachOptions,
    photographs: Vec<NamedSize>,
    with_depth: bool,
    length: Option<KnownLength>,
    has_mesh: bool,
    hull_only: bool,
}

impl Before {
    pub fn of(known: &Snapshot, hull_only: bool) -> Before {
        let all = known.photographs();
        let size_of = |i: usize| ImageFile::new(&known.photograph_file(i).ok()?).size().ok();
        let sized = |(i, p): (usize, &Photograph)| {
            (p.name.clone(), p.size.or_else(|| size_of(i)).unwrap_or_default())
        };
        Before {
            options: known.options(),
            photographs: all.iter().enumerate().map(sized).collect(),
            with_depth: all.iter().any(|p| p.depth.is_some()),
            length: known.length().cloned(),
            has_mesh: known.has_given_mesh(),
            hull_only,
        }
    }
}

/// The content of a form: photographs by name, some with depth, and settings.
pub(super) struct Given<'f> {
    photographs: Vec<(&'f UploadedFile, Option<&'f UploadedFile>)>,
    /// Metres per unit of depth.
    depth_unit: f64,
    /// As they are after the change.
    options: TeachOptions,
    /// Whether the form has something that changes the options.
    sets_options: bool,
    scale: Scale,
    has_scale: bool,
    /// A new mesh, or `Some(None)` to forget the one that there is.
    mesh: Option<Option<Mesh>>,
    hull_only: Option<bool>,
}

impl<'f> Given<'f> {
    /// Decodes and checks everything once before anything is stored.
    pub fn of_form(form: &'f Form, before: &Before) -> Answer<Given<'f>> {
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
        let mut all = before.photographs.clone();
        for photograph in &photographs {
            let name = Path::new(&photograph.name);
            let image = ImageFile::of_bytes(name, &photograph.bytes).rgb();
            let size = image.map_err(|e| ApiError::of_image("photographs", &e))?.size();
            *sizes.entry(size).or_default() += 1;
            let name = photograph_name(&photograph.name);
            match all.iter_mut().find(|(there, _)| *there == name) {
                Some(replaced) => replaced.1 = size,
                None => all.push((name, size)),
            }
        }
        let depth_unit = depth_unit(form, &depth)?;
        let without_board = form.parsed("without_board", "true or false")?;
        let ruler = ruler(form)?;
        let there = before.photographs.iter().map(|p| p.1).find(|(width, _)| *width > 0);
        let camera = camera(form, there.or(sizes.iter().max_by_key(|(_, n)| **n).map(|(size, _)| *size)))?;
        let sets_options = ruler.is_some() || camera.is_some() || without_board.is_some();
        let world = match without_board {
            Some(true) => World::Features,
            Some(false) => World::Board,
            None => before.options.world,
        };
        if ruler.is_some() && world == World::Features {
            return Err(ApiError::field(
                "ruler",
                "the ruler of the printed board for photographs without a board",
                "ruler for photographs on the board, or length and ends without one",
                "leave out ruler, or send without_board=false",
            ));
        }
        let scale = Scale::of_form(form, world == World::Features, &all, before.length.as_ref())?;
        let options = TeachOptions {
            ruler: ruler.or(before.options.ruler),
            camera: camera.or(before.options.camera),
            world,
        };
        let (mesh, hull_only) = (mesh(form)?, form.parsed("hull_only", "true or false")?);
        let has_mesh = mesh.as_ref().map_or(before.has_mesh, Option::is_some);
        if has_mesh && hull_only.unwrap_or(before.hull_only) {
            return Err(ApiError::field(
                "hull_only",
                "true, with a mesh that was given",
                "a mesh, or hull_only for one that is made from the photographs",
                "send hull_only=false, or no mesh",
            ));
        }
        let has_scale = !depth.is_empty() || before.with_depth;
        let pairs = photographs.iter().enumerate().map(|(i, p)| (*p, depth.get(i).copied()));
        Ok(Given {
            photographs: pairs.collect(),
            depth_unit,
            options,
            sets_options,
            has_scale: has_scale || scale.is_sent() || world != World::Features,
            scale,
            mesh,
            hull_only,
        })
    }

    pub fn is_empty(&self) -> bool {
        let settings = self.sets_options || self.scale.is_sent() || self.mesh.is_some();
        self.photographs.is_empty() && !settings && self.hull_only.is_none()
    }

    pub fn photographs(&self) -> usize {
        self.photographs.len()
    }

    /// Whether the scale of a new teaching is known.
    pub fn has_scale(&self) -> bool {
        self.has_scale
    }

    pub fn hull_only(&self) -> Option<bool> {
        self.hull_only
    }

    /// Adds photographs to a teaching, and changes its settings.
    pub fn into(self, teaching: &mut Teaching) -> Answer<()> {
        let fault = |e| of_teach(&e);
        if self.sets_options {
            teaching.set_options(&self.options).map_err(fault)?;
        }
        for (photograph, depth) in self.photographs {
            let number = teaching.add_photograph(&photograph.name, &photograph.bytes).map_err(fault)?;
            if let Some(depth) = depth {
                teaching.add_depth(number, &depth.bytes, self.depth_unit).map_err(fault)?;
            }
        }
        if self.scale.is_sent() {
            let length = self.scale.applied(teaching.length());
            teaching.set_length(length).map_err(fault)?;
        }
        if let Some(mesh) = self.mesh {
            teaching.set_mesh(mesh.as_ref()).map_err(fault)?;
        }
        Ok(())
    }
}

/// Metres per unit of the depth images.
fn depth_unit(form: &Form, depth: &[&UploadedFile]) -> Answer<f64> {
    let expected = "millimetres per unit of the depth images, above 0: 1 for most cameras";
    let scale = form.number("depth_scale", expected, |v| v > 0.0 && v.is_finite())?;
    if !depth.is_empty() && scale.is_none() {
        return Err(ApiError::field("depth_scale", "nothing", expected, "give it"));
    }
    let unit = scale.unwrap_or(1.0) / 1000.0;
    for image in depth {
        let image = ImageFile::of_bytes(Path::new(&image.name), &image.bytes).depth(unit);
        image.map_err(|e| ApiError::of_image("depth", &e))?;
    }
    Ok(unit)
}

/// A mesh to be set, or `Some(None)` for one to be removed.
fn mesh(form: &Form) -> Answer<Option<Option<Mesh>>> {
    let removed = form.parsed("remove_mesh", "true or false")?.unwrap_or(false);
    match (mesh_of_form(form)?, removed) {
        (Some(_), true) => {
            let advice = "send the mesh alone: it replaces the one that was given before";
            Err(ApiError::field("remove_mesh", "true, and a mesh", "one of the two", advice))
        }
        (mesh, removed) => Ok(mesh.map(Some).or(removed.then_some(None))),
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
