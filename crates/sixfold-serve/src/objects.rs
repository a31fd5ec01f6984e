//! The API of stored objects: list, render and remove them, and get their meshes. They are added by a job
//! (`tasks/object.rs`).

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use axum::Json;
use axum::extract::{Path, Query, State};
use axum::http::StatusCode;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use sixfold_estimator::{ObjectRecord, StoreError};
use sixfold_geometry::nalgebra::{Rotation3, UnitQuaternion, Vector3};
use sixfold_geometry::{Camera, Pose, RgbImage, Vec3};
use sixfold_mesh::{FoundSymmetry, Mesh, PlyFormat, Unit, Verdict, ply_bytes, simplify};
use sixfold_render::{Light, Material, RenderOptions, SceneObject, VisibilityBuffer, shade};
use utoipa::{IntoParams, ToSchema};

use crate::app::{App, Shared};
use crate::error::{Answer, ApiError, Problem};
use crate::images::png;
use crate::methods::Stamp;

/// Side of a thumbnail, pixels.
const SIDE: usize = 320;
/// Its background colour, that of the pages.
const GROUND: [u8; 3] = [244, 245, 247];
/// The fraction of a thumbnail's side that the object fills.
const FILLED: f64 = 0.86;
/// Maximum number of thumbnails kept, some 30 kB each.
const MAX_THUMBNAILS: usize = 500;
/// The file that lists an object's photographs, and that of its own network's weights, in its folder. They are the constants of crates
/// that a program without networks does not have.
const PHOTOGRAPHS: &str = "photographs/photographs.json";
pub(crate) const WEIGHTS: &str = "pix2pose.safetensors";
/// Minimum number of faces that a mesh is reduced to.
const MIN_FACES: usize = 100;

/// A stored object.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct ObjectView {
    /// Its name.
    name: String,
    /// Metres.
    diameter: Option<f64>,
    /// Of the mesh; 0 without one.
    vertices: usize,
    faces: usize,
    /// Whether it was added from depth images and has only templates.
    without_mesh: bool,
    /// Number of discrete symmetries, without the identity.
    symmetries_discrete: usize,
    /// Number of its continuous symmetries.
    symmetries_continuous: usize,
    /// The file that it was added from, and its unit.
    source: String,
    source_unit: Option<String>,
    /// Whether its photographs are stored, on which a network can be trained for it.
    has_photographs: bool,
    /// Whether a network was trained for it: the method pix2pose finds it without a trained model of the server.
    has_weights: bool,
    /// What its folder holds: files and their bytes.
    files: Vec<ObjectFile>,
    /// Why its record cannot be read; the other fields are then invalid.
    error: Option<String>,
    links: ObjectLinks,
}

/// A file of a stored object.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct ObjectFile {
    name: String,
    bytes: u64,
}

/// Links of an object.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct ObjectLinks {
    /// The object itself.
    object: String,
    /// An image of it, where there is a mesh.
    thumbnail: Option<String>,
    /// Its mesh as PLY, metres, where there is one.
    mesh: Option<String>,
}

/// All stored objects.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct ObjectList {
    objects: Vec<ObjectView>,
}

impl ObjectView {
    fn of(app: &App, name: &str, record: Result<ObjectRecord, StoreError>) -> ObjectView {
        let path = format!("/v1/objects/{name}");
        let record = record.map_err(|error| ApiError::of_store("name", &error).problem.error);
        let has_mesh = record.as_ref().is_ok_and(|r| !r.without_mesh);
        let (record, error) = match record {
            Ok(record) => (Some(record), None),
            Err(error) => (None, Some(error)),
        };
        let record = record.as_ref();
        ObjectView {
            name: name.to_owned(),
            diameter: record.map(|r| r.diameter),
            vertices: record.map_or(0, |r| r.vertices),
            faces: record.map_or(0, |r| r.faces),
            without_mesh: record.is_some_and(|r| r.without_mesh),
            symmetries_discrete: record.map_or(0, |r| r.symmetries_discrete.len()),
            symmetries_continuous: record.map_or(0, |r| r.symmetries_continuous.len()),
            source: record.map_or_else(String::new, |r| file_name(&r.source)),
            source_unit: record.map(|r| r.source_unit.to_string()),
            has_photographs: app.options.objects.join(name).join(PHOTOGRAPHS).is_file(),
            has_weights: app.options.objects.join(name).join(WEIGHTS).is_file(),
            files: files(app, name),
            error,
            links: ObjectLinks {
                thumbnail: has_mesh.then(|| format!("{path}/thumbnail.png")),
                mesh: has_mesh.then(|| format!("{path}/mesh.ply")),
                object: path,
            },
        }
    }
}

/// The last component of each path in a record, so that clients do not learn the folders of this machine.
fn file_name(source: &str) -> String {
    let last = |path: &str| path.rsplit(['/', '\\']).next().unwrap_or_default().to_owned();
    source.split(", ").map(last).collect::<Vec<_>>().join(", ")
}

/// The files of an object, whose name the store has accepted before.
fn files(app: &App, name: &str) -> Vec<ObjectFile> {
    let entries = std::fs::read_dir(app.options.objects.join(name)).into_iter().flatten().flatten();
    let file = |entry: std::fs::DirEntry| {
        let metadata = entry.metadata().ok().filter(std::fs::Metadata::is_file)?;
        Some(ObjectFile { name: entry.file_name().to_string_lossy().into_owned(), bytes: metadata.len() })
    };
    let mut files: Vec<ObjectFile> = entries.filter_map(file).collect();
    files.sort_by(|a, b| a.name.cmp(&b.name));
    files
}

/// Lists the stored objects by name.
#[utoipa::path(get, path = "/v1/objects", tag = "objects", responses(
    (status = 200, description = "The objects", body = ObjectList),
))]
pub(crate) async fn list_objects(State(app): Shared) -> Answer<Json<ObjectList>> {
    app.blocking(|app| {
        let names = app.store.names().map_err(|e| ApiError::of_store("name", &e))?;
        let view = |name: &String| match app.store.record(name) {
            // It was removed meanwhile.
            Err(StoreError::Unknown { .. }) => None,
            record => Some(ObjectView::of(app, name, record)),
        };
        Ok(Json(ObjectList { objects: names.iter().filter_map(view).collect() }))
    })
    .await
}

/// One stored object.
#[utoipa::path(get, path = "/v1/objects/{name}", tag = "objects", params(("name" = String, Path, description = "Its name")), responses(
    (status = 200, description = "The object", body = ObjectView),
    (status = 400, description = "Not a valid object name", body = Problem),
    (status = 404, description = "There is no such object", body = Problem),
))]
pub(crate) async fn get_object(State(app): Shared, Path(name): Path<String>) -> Answer<Json<ObjectView>> {
    app.blocking(move |app| match app.store.record(&name) {
        Err(error @ (StoreError::Unknown { .. } | StoreError::Name(_))) => {
            Err(ApiError::of_store("name", &error))
        }
        record => Ok(Json(ObjectView::of(app, &name, record))),
    })
    .await
}

/// Removes a stored object.
#[utoipa::path(delete, path = "/v1/objects/{name}", tag = "objects", params(("name" = String, Path, description = "Its name")), responses(
    (status = 204, description = "Removed"),
    (status = 400, description = "Not a valid object name", body = Problem),
    (status = 404, description = "There is no such object", body = Problem),
    (status = 409, description = "Another process is changing it", body = Problem),
))]
pub(crate) async fn delete_object(State(app): Shared, Path(name): Path<String>) -> Answer<StatusCode> {
    app.blocking(move |app| app.store.remove(&name).map_err(|e| ApiError::of_store("name", &e))).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// The bytes of a thumbnail, of one state of its object.
type Thumbnail = (Stamp, Arc<Vec<u8>>);

/// Thumbnails by the names of their objects.
#[derive(Default)]
pub(crate) struct Thumbnails(Mutex<HashMap<String, Thumbnail>>);

impl Thumbnails {
    fn get(&self, name: &str, stamp: &Stamp) -> Option<Arc<Vec<u8>>> {
        let kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        kept.get(name).filter(|(of, _)| of == stamp).map(|(_, png)| png.clone())
    }

    fn put(&self, name: String, stamp: Stamp, png: Arc<Vec<u8>>) {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if kept.len() >= MAX_THUMBNAILS {
            kept.clear();
        }
        kept.insert(name, (stamp, png));
    }
}

/// An image of a stored object, rendered from above and in front.
#[utoipa::path(get, path = "/v1/objects/{name}/thumbnail.png", tag = "objects", params(("name" = String, Path, description = "Its name")), responses(
    (status = 200, description = "The image, 320 x 320", body = Vec<u8>, content_type = "image/png"),
    (status = 400, description = "Not a valid object name", body = Problem),
    (status = 404, description = "There is no such object, or it has no mesh", body = Problem),
))]
pub(crate) async fn object_thumbnail(State(app): Shared, Path(name): Path<String>) -> Answer<Response> {
    let png = app
        .blocking(move |app| {
            let (object, stamp) = app.methods.object(&name).map_err(|e| ApiError::of_store("name", &e))?;
            if let Some(png) = app.thumbnails.get(&name, &stamp) {
                return Ok(png);
            }
            let mesh = object.mesh.as_ref().ok_or_else(|| no_mesh(&name))?;
            let png = Arc::new(png(&portrait(mesh))?);
            app.thumbnails.put(name, stamp, png.clone());
            Ok(png)
        })
        .await?;
    Ok(([(CONTENT_TYPE, "image/png"), (CACHE_CONTROL, "no-cache")], png.to_vec()).into_response())
}

fn no_mesh(name: &str) -> ApiError {
    ApiError::field(
        "name",
        format!("{name:?}, which was added from depth images"),
        "an object with a mesh",
        "choose another object",
    )
    .with_status(StatusCode::NOT_FOUND)
}

/// An image of the object on its own, as `sixfold object show --picture` renders it.
fn portrait(mesh: &Mesh) -> RgbImage {
    let focal = SIDE as f64 / 2.0 / 30f64.to_radians().tan();
    let centre = (SIDE as f64 - 1.0) / 2.0;
    let camera =
        Camera { fx: focal, fy: focal, cx: centre, cy: centre, width: SIDE, height: SIDE, distortion: None };
    let (low, high) = mesh.bounding_box();
    let tilt = Rotation3::from_axis_angle(&Vector3::x_axis(), 120f64.to_radians());
    let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), 30f64.to_radians());
    let rotation = UnitQuaternion::from_rotation_matrix(&(tilt * turn));
    let box_centre = rotation * ((low + high) * 0.5);
    // As near as possible: the vertices determine the smallest distance at which the object fits.
    let half = FILLED * 0.5 * SIDE as f64;
    let far_enough = mesh.vertices().iter().map(|v| {
        let v = rotation * v - box_centre;
        focal / half * v.x.abs().max(v.y.abs()) - v.z
    });
    let pose = Pose::new(rotation, Vec3::new(0.0, 0.0, far_enough.fold(0.0, f64::max)) - box_centre);
    let objects = [SceneObject { mesh, camera_from_object: pose }];
    let mut frame = VisibilityBuffer::new(&camera);
    frame.render(&objects, &RenderOptions::default());
    let ground = RgbImage::filled(SIDE, SIDE, GROUND);
    shade(&frame, &objects, &Light::default_set(), &Material::default(), Some(&ground))
}

/// A rotation that maps the mesh onto itself, exactly or nearly.
#[derive(Debug, Clone, Serialize, Deserialize, ToSchema)]
pub(crate) struct SymmetryView {
    /// Direction in the object's frame.
    axis: [f64; 3],
    /// Order: rotations by multiples of 360 degrees over this number; null: all rotations.
    order: Option<u32>,
    /// After the rotation, 95 % of the points are within this distance of the surface, metres.
    deviation: f64,
    /// It is stored with the object; other symmetries need inspection.
    sure: bool,
}

impl SymmetryView {
    pub fn of(found: &FoundSymmetry, by_color: bool) -> SymmetryView {
        SymmetryView {
            axis: found.axis.into(),
            order: found.order,
            deviation: found.deviation.p95,
            sure: found.verdict(by_color) == Verdict::Sure,
        }
    }
}

/// Resolution of a mesh.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub(crate) struct MeshDetail {
    /// At most about this many faces (default: all).
    faces: Option<usize>,
    /// The state that is asked for, as links of teachings name it.
    revision: Option<u64>,
}

/// The maximum number of faces and the state that a request asks for.
pub(crate) fn faces_of(
    detail: Result<Query<MeshDetail>, axum::extract::rejection::QueryRejection>,
) -> Answer<(usize, Option<u64>)> {
    let expected = format!("a whole number, {MIN_FACES} or more");
    let wrong = |found: String| ApiError::field("faces", found, &*expected, "correct the value");
    let MeshDetail { faces, revision } = detail.map_err(|e| wrong(e.body_text()))?.0;
    let faces = faces.unwrap_or(usize::MAX);
    if faces < MIN_FACES { Err(wrong(faces.to_string())) } else { Ok((faces, revision)) }
}

/// A mesh of at most about `faces` faces as the bytes of a PLY file in metres, with the colours of its texture.
pub(crate) fn mesh_ply(mesh: &Mesh, faces: usize) -> Answer<Vec<u8>> {
    let mesh = coloured(&simplify(mesh, faces))?;
    Ok(ply_bytes(&mesh, Unit::Metre, PlyFormat::BinaryLittleEndian, None))
}

/// The mesh of a stored object: binary PLY in metres with colours, a texture's too.
#[utoipa::path(get, path = "/v1/objects/{name}/mesh.ply", tag = "objects", params(("name" = String, Path, description = "Its name"), MeshDetail), responses(
    (status = 200, description = "The mesh", body = Vec<u8>, content_type = "model/ply"),
    (status = 400, description = "Not a valid object name", body = Problem),
    (status = 404, description = "There is no such object, or it has no mesh", body = Problem),
    (status = 422, description = "Fewer faces than the minimum", body = Problem),
))]
pub(crate) async fn object_mesh(
    State(app): Shared,
    Path(name): Path<String>,
    detail: Result<Query<MeshDetail>, axum::extract::rejection::QueryRejection>,
) -> Answer<Response> {
    let (faces, _) = faces_of(detail)?;
    let bytes = app
        .blocking(move |app| {
            let (object, _) = app.methods.object(&name).map_err(|e| ApiError::of_store("name", &e))?;
            let mesh = object.mesh.as_ref().ok_or_else(|| no_mesh(&name))?;
            mesh_ply(mesh, faces)
        })
        .await?;
    Ok(([(CONTENT_TYPE, "model/ply"), (CACHE_CONTROL, "no-cache")], bytes).into_response())
}

/// A mesh with its texture converted to vertex colours.
fn coloured(mesh: &Mesh) -> Answer<Mesh> {
    let (Some(texcoords), Some(texture)) = (mesh.texcoords(), mesh.texture()) else {
        return Ok(mesh.clone());
    };
    let (width, height) = (texture.width(), texture.height());
    let at = |t: f32, size: usize| ((t.rem_euclid(1.0) * size as f32) as usize).min(size.saturating_sub(1));
    let colors = texcoords.iter().map(|[u, v]| texture[(at(*u, width), at(1.0 - *v, height))]).collect();
    let fault = |e: sixfold_mesh::MeshError| ApiError::system("the mesh", e);
    let plain = Mesh::new(mesh.vertices().to_vec(), mesh.faces().to_vec()).map_err(fault)?;
    plain.with_colors(colors).map_err(fault)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_of_this_machine_stay_here() {
        assert_eq!(file_name("/home/me/mug.ply"), "mug.ply");
        assert_eq!(file_name("a/one.png, C:\\two.png"), "one.png, two.png");
        assert_eq!(file_name("mug.ply"), "mug.ply");
    }
}
