//! Adding an object to the store from an uploaded mesh, as `sixfold object add` does.

use std::path::Path;

use axum::extract::{Request as HttpRequest, State};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use sixfold_estimator::{NewObject, ObjectRecord, PoseEstimator, StoreError};
use sixfold_geometry::Vec3;
use sixfold_io::{limits, read_regular};
use sixfold_mesh::{
    ContinuousSymmetry, FoundSymmetry, Mesh, ModelInfo, SymmetryOptions, Unit, find_symmetries,
    sure_symmetries,
};
use sixfold_ppf::PpfEstimator;

use super::Request;
use crate::app::{App, Shared};
use crate::error::{Answer, ApiError, Problem};
use crate::form::{Form, FormRule, UploadedFile};
use crate::jobs::{Accepted, JobView, Stopped, Work};
use crate::meshes::{MeshFormat, mesh_resources, mesh_unit};
use crate::objects::SymmetryView;

const RULE: FormRule = FormRule {
    files: &["mesh"],
    many_files: &["resource"],
    texts: &["name", "unit", "symmetric_about", "find_symmetries", "noise", "replace"],
};

/// The request without the files.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct ObjectRequest {
    name: String,
    /// The client's name of the mesh file; for messages and the record.
    file_name: String,
    format: MeshFormat,
    unit: Unit,
    #[serde(alias = "turns_about")]
    symmetric_about: Option<Axis>,
    /// The evidence by which symmetries are found and stored.
    #[serde(default)]
    find_symmetries: Option<Evidence>,
    /// Noise of the surface, standard deviation in metres.
    #[serde(default)]
    noise: f64,
    replace: bool,
    /// The client's names of the additional files; file `i` is `resource-i` in the job's folder.
    resources: Vec<String>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Axis {
    X,
    Y,
    Z,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Evidence {
    Shape,
    Colors,
}

/// The form of `POST /v1/objects`.
#[derive(utoipa::ToSchema)]
#[allow(dead_code)]
pub(crate) struct ObjectForm {
    /// The object's name: up to 100 letters, digits, - and _.
    name: String,
    /// Mesh file: PLY, OBJ, STL, glTF, GLB or XYZ.
    #[schema(value_type = String, format = Binary)]
    mesh: Vec<u8>,
    /// Unit of the mesh file: m, cm, mm or in.
    unit: String,
    /// Files that the mesh names (materials, textures, buffers), under the names that it has for them.
    #[schema(value_type = Option<Vec<String>>, format = Binary)]
    resource: Option<Vec<Vec<u8>>>,
    /// The object looks the same however it is rotated about this axis of its own frame: x, y or z.
    symmetric_about: Option<String>,
    /// Find the mesh's symmetries and store those that are certain, by `shape` or by shape and `colors`. The job's result lists
    /// all.
    find_symmetries: Option<String>,
    /// Noise of the mesh's surface, standard deviation in millimetres, for find_symmetries (default: 0).
    noise: Option<f64>,
    /// Replace an object of the same name (default: false).
    replace: Option<bool>,
}

/// Stores an object from a mesh: a job whose result is its record.
#[utoipa::path(post, path = "/v1/objects", tag = "objects",
    request_body(content = ObjectForm, content_type = "multipart/form-data"),
    responses(
        (status = 202, description = "The job waits for a worker", body = JobView),
        (status = 400, description = "Not a form, an invalid name, or a path in a name", body = Problem),
        (status = 409, description = "There is an object of this name", body = Problem),
        (status = 413, description = "The request is larger than the server accepts", body = Problem),
        (status = 415, description = "Wrong content type", body = Problem),
        (status = 422, description = "An invalid field", body = Problem),
        (status = 429, description = "Too many waiting jobs", body = Problem),
    ))]
pub(crate) async fn add_object(State(app): Shared, request: HttpRequest) -> Answer<Accepted> {
    let form = Form::read(&app, request, &RULE).await?;
    app.blocking(move |app| {
        let mesh = form.needed_file("mesh", "a mesh file")?;
        let request = ObjectRequest::of_form(&form, mesh)?;
        check_new_name(app, &request.name, request.replace)?;
        let resources = form.files("resource");
        request.mesh(&mesh.bytes, &|i| Ok(resources[i].bytes.to_vec()))?;
        let names: Vec<String> = (0..resources.len()).map(|i| format!("resource-{i}")).collect();
        let beside = names.iter().map(String::as_str).zip(resources.iter().map(|r| r.bytes.as_ref()));
        let files: Vec<(&str, &[u8])> = [("mesh", mesh.bytes.as_ref())].into_iter().chain(beside).collect();
        let job = Request::Object(request).store_job(app, &files)?;
        Ok(Accepted(JobView::of(app, &job)))
    })
    .await
}

impl ObjectRequest {
    fn of_form(form: &Form, mesh: &UploadedFile) -> Answer<ObjectRequest> {
        let name = form.text("name")?.ok_or_else(|| {
            ApiError::field("name", "nothing", "up to 100 letters, digits, - and _", "give the object a name")
        })?;
        let unit = mesh_unit(form)?;
        let axes = [("x", Axis::X), ("y", Axis::Y), ("z", Axis::Z)];
        let symmetric_about = one_of(form, "symmetric_about", &axes, "x, y or z")?;
        let kinds = [("shape", Evidence::Shape), ("colors", Evidence::Colors)];
        let find_symmetries = one_of(form, "find_symmetries", &kinds, "shape or colors")?;
        if find_symmetries.is_some() && symmetric_about.is_some() {
            let advice = "leave out one of the two";
            return Err(ApiError::field("find_symmetries", "it and symmetric_about", "one of them", advice));
        }
        let noise = form.number("noise", "millimetres, 0 to 100", |mm| (0.0..=100.0).contains(&mm))?;
        let resources = mesh_resources(form)?;
        Ok(ObjectRequest {
            name: name.to_owned(),
            file_name: mesh.name.clone(),
            format: MeshFormat::of(&mesh.name)?,
            unit,
            symmetric_about,
            find_symmetries,
            noise: noise.unwrap_or(0.0) / 1000.0,
            replace: form.parsed("replace", "true or false")?.unwrap_or(false),
            resources: resources.iter().map(|r| r.name.clone()).collect(),
        })
    }

    /// The mesh in metres. Files that it refers to are searched only among the uploaded files, by `resource`.
    fn mesh(&self, bytes: &[u8], resource: &dyn Fn(usize) -> std::io::Result<Vec<u8>>) -> Answer<Mesh> {
        self.format.parse(bytes, self.unit, &self.resources, resource)
    }

    /// The mesh's data for the store, and all symmetries found in it.
    fn info(&self, mesh: &Mesh) -> Answer<(ModelInfo, Vec<FoundSymmetry>)> {
        let mut info = ModelInfo::of_mesh(mesh);
        let mut found = vec![];
        if let Some(evidence) = self.find_symmetries {
            let options = SymmetryOptions { noise: self.noise, ..SymmetryOptions::default() };
            found = find_symmetries(mesh, &options).map_err(|e| {
                ApiError::about("noise", e, "noise of a few percent of the object's size", "give less noise")
            })?;
            let by_color = evidence == Evidence::Colors;
            (info.symmetries_discrete, info.symmetries_continuous) = sure_symmetries(&found, by_color);
        }
        if let Some(axis) = self.symmetric_about {
            let axis = match axis {
                Axis::X => Vec3::x(),
                Axis::Y => Vec3::y(),
                Axis::Z => Vec3::z(),
            };
            // The axis runs through the centre of the bounding box: a file's origin may be anywhere.
            let offset = info.min + info.size * 0.5;
            info.symmetries_continuous.push(ContinuousSymmetry { axis, offset });
        }
        Ok((info, found))
    }
}

/// One of several fixed values of a text field, if it was sent.
fn one_of<T: Copy>(form: &Form, name: &str, all: &[(&str, T)], expected: &str) -> Answer<Option<T>> {
    let Some(text) = form.text(name)? else { return Ok(None) };
    match all.iter().find(|(word, _)| *word == text) {
        Some((_, value)) => Ok(Some(*value)),
        None => Err(ApiError::field(name, format!("{text:?}"), expected, "correct the value")),
    }
}

/// Checks that an object can be stored under a name now.
pub(crate) fn check_new_name(app: &App, name: &str, replace: bool) -> Answer<()> {
    match app.store.record(name) {
        Err(error @ StoreError::Name(_)) => Err(ApiError::of_store("name", &error)),
        Ok(_) if !replace => {
            let folder = app.options.objects.clone();
            Err(ApiError::of_store("name", &StoreError::Exists { name: name.to_owned(), folder }))
        }
        _ => Ok(()),
    }
}

/// Processes a request.
pub(super) fn run(app: &App, request: &ObjectRequest, work: &mut Work<'_>) -> Result<Value, Stopped> {
    let folder = work.folder().to_owned();
    let read = |name: &str| read_regular(&folder.join(name), limits::MESH);
    let bytes = read("mesh").map_err(|e| ApiError::system("the job's mesh", e))?;
    let mesh = request.mesh(&bytes, &|i| read(&format!("resource-{i}")))?;
    work.step(0, 1, "describing the object")?;
    let source = if request.file_name.is_empty() { "upload" } else { &request.file_name };
    let (info, symmetries) = request.info(&mesh)?;
    let record = ObjectRecord::of_mesh(Path::new(source), request.unit, &mesh, &info);
    let new = NewObject { mesh: Some(&mesh), record: &record, replace: request.replace };
    let stored = app.store.add(&request.name, new, |object| {
        PpfEstimator::default().prepare(object)?;
        Ok(())
    });
    match stored {
        // It was stored by this job before the server ended and the job was started again.
        Err(StoreError::Exists { .. }) if is_stored(app, request, &record) => {}
        other => other.map_err(|e| ApiError::of_store("name", &e))?,
    }
    let by_color = request.find_symmetries != Some(Evidence::Shape);
    let symmetries: Vec<SymmetryView> = symmetries.iter().map(|s| SymmetryView::of(s, by_color)).collect();
    let object = format!("/v1/objects/{}", request.name);
    Ok(json!({ "name": request.name, "object": object, "record": record, "symmetries": symmetries }))
}

fn is_stored(app: &App, request: &ObjectRequest, record: &ObjectRecord) -> bool {
    let text = |record: &ObjectRecord| serde_json::to_string(record).ok();
    app.store.record(&request.name).is_ok_and(|stored| text(&stored) == text(record))
}
