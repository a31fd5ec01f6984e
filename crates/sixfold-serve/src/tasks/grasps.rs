//! Proposing grasps on a depth image, as `sixfold grasp propose` does by geometry.

use std::time::Instant;

use axum::extract::{Request as HttpRequest, State};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use sixfold_grasp::{AntipodalOptions, GraspView, Gripper, ViewOptions, find_objects, parse_gripper};
use sixfold_shell::grasp::planner::Planner;
use sixfold_shell::grasp::proposals::{Table, of_planner, picture};

use super::Request;
use super::find::camera_numbers;
use crate::app::Shared;
use crate::error::{Answer, ApiError, Problem};
use crate::form::{Form, FormRule};
use crate::images::{ImageBytes, Images};
use crate::jobs::{Accepted, JobView, Stopped, Work};

const MAX_GRASPS: usize = 1000;
/// Largest gripper file, bytes.
const MAX_GRIPPER: usize = 64 << 10;

const RULE: FormRule = FormRule {
    files: &["rgb", "depth", "camera", "mask", "gripper_file"],
    many_files: &[],
    texts: &["fx", "fy", "cx", "cy", "depth_scale", "gripper", "number", "seen_only"],
};

/// The request without the images.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct GraspRequest {
    depth_scale: Option<f64>,
    /// The text of a gripper file, or the name of one that is built in.
    gripper: GripperChoice,
    number: usize,
    seen_only: bool,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum GripperChoice {
    Name(String),
    File(String),
}

/// The form of `POST /v1/grasps`.
#[derive(utoipa::ToSchema)]
#[allow(dead_code)]
pub(crate) struct GraspForm {
    /// Depth image, PNG with one channel of 16 bits.
    #[schema(value_type = String, format = Binary)]
    depth: Vec<u8>,
    /// Colour image for the overlay.
    #[schema(value_type = Option<String>, format = Binary)]
    rgb: Option<Vec<u8>>,
    /// Camera file of BOP, OpenCV or ROS; or fx, fy, cx, cy.
    #[schema(value_type = Option<String>, format = Binary)]
    camera: Option<Vec<u8>>,
    /// Focal length in pixels.
    fx: Option<f64>,
    /// Focal length in pixels.
    fy: Option<f64>,
    /// Principal point in pixels.
    cx: Option<f64>,
    /// Principal point in pixels.
    cy: Option<f64>,
    /// Millimetres per unit of the depth image, in place of the camera file's.
    depth_scale: Option<f64>,
    /// The object's mask (default: the largest object on the table).
    #[schema(value_type = Option<String>, format = Binary)]
    mask: Option<Vec<u8>>,
    /// jaws-140 (default) or jaws-85.
    gripper: Option<String>,
    /// Another gripper: a JSON file.
    #[schema(value_type = Option<String>, format = Binary)]
    gripper_file: Option<Vec<u8>>,
    /// Maximum number of grasps (default: 5).
    number: Option<u32>,
    /// Use only the visible surface, without assumptions about the object's far side (default: false).
    seen_only: Option<bool>,
}

/// Proposes grasps on a depth image: a job whose result are poses of a gripper.
#[utoipa::path(post, path = "/v1/grasps", tag = "grasps",
    request_body(content = GraspForm, content_type = "multipart/form-data"),
    responses(
        (status = 202, description = "The job waits for a worker", body = JobView),
        (status = 400, description = "Not a form, or a path in a name", body = Problem),
        (status = 413, description = "The request is larger than the server accepts", body = Problem),
        (status = 415, description = "Wrong content type", body = Problem),
        (status = 422, description = "An invalid field", body = Problem),
        (status = 429, description = "Too many waiting jobs", body = Problem),
    ))]
pub(crate) async fn grasps(State(app): Shared, request: HttpRequest) -> Answer<Accepted> {
    let form = Form::read(&app, request, &RULE).await?;
    app.blocking(move |app| {
        form.needed_file("depth", "a depth image")?;
        let images = ImageBytes::of_form(&form)?;
        let request = GraspRequest::of_form(&form)?;
        request.gripper()?;
        Images::decode(&images, request.depth_scale)?;
        let job = Request::Grasps(request).store_job(app, &images.files())?;
        Ok(Accepted(JobView::of(app, &job)))
    })
    .await
}

impl GraspRequest {
    fn of_form(form: &Form) -> Answer<GraspRequest> {
        let name = form.text("gripper")?;
        let gripper = match (form.file("gripper_file"), name) {
            (Some(_), Some(_)) => {
                return Err(ApiError::field("gripper", "a name and a file", "one of them", "leave out one"));
            }
            (Some(file), None) if file.bytes.len() > MAX_GRIPPER => {
                let found = format!("{} bytes", file.bytes.len());
                return Err(ApiError::field("gripper_file", found, "a gripper file", "send that file"));
            }
            (Some(file), None) => GripperChoice::File(String::from_utf8_lossy(&file.bytes).into_owned()),
            (None, name) => GripperChoice::Name(name.unwrap_or(Gripper::BUILT_IN[0]).to_owned()),
        };
        let expected = "a whole number, 1 to 1000";
        let number = form.parsed::<usize>("number", expected)?.unwrap_or(5);
        if !(1..=MAX_GRASPS).contains(&number) {
            return Err(ApiError::field("number", number.to_string(), expected, "correct the value"));
        }
        Ok(GraspRequest {
            depth_scale: form.number("depth_scale", "a number above 0", |v| v > 0.0 && v.is_finite())?,
            gripper,
            number,
            seen_only: form.parsed("seen_only", "true or false")?.unwrap_or(false),
        })
    }

    fn gripper(&self) -> Answer<Gripper> {
        match &self.gripper {
            GripperChoice::Name(name) => Gripper::built_in(name).ok_or_else(|| {
                ApiError::field(
                    "gripper",
                    format!("{name:?}"),
                    format!("one of {}", Gripper::BUILT_IN.join(", ")),
                    "choose one, or send a gripper_file",
                )
            }),
            GripperChoice::File(text) => parse_gripper(text, "gripper_file").map_err(|e| {
                ApiError::about("gripper_file", e, "the JSON file of a gripper", "correct the file")
            }),
        }
    }
}

/// Processes a request.
pub(super) fn run(request: &GraspRequest, work: &mut Work<'_>) -> Result<Value, Stopped> {
    let began = Instant::now();
    let gripper = request.gripper()?;
    let images = Images::decode(&ImageBytes::of_folder(work.folder())?, request.depth_scale)?;
    let depth = images.depth.as_ref().ok_or_else(|| {
        ApiError::field("depth", "nothing", "a depth image", "send it as the file field depth")
    })?;
    let wrong = |field: &str, e: &dyn std::fmt::Display| {
        ApiError::about(
            field,
            e,
            "a depth image of an object on a table",
            "give a mask of the object, or another image",
        )
    };
    let options = ViewOptions::default();
    work.step(0, 2, "looking for the object")?;
    let mask = match &images.mask {
        Some(mask) => Some(mask.clone()),
        None => {
            let found = find_objects(depth, &images.camera, &options).map_err(|e| wrong("depth", &e))?;
            found.into_iter().next()
        }
    };
    let view = mask.map(|mask| GraspView::new(depth, &images.camera, &mask, &options)).transpose();
    let view = view.map_err(|e| wrong(if images.mask.is_some() { "mask" } else { "depth" }, &e))?;
    work.step(1, 2, "planning")?;
    let mut proposed = vec![];
    if let Some(view) = &view {
        let default = AntipodalOptions::default();
        let completion = default.completion.filter(|_| !request.seen_only);
        let planner = AntipodalOptions { completion, ..default };
        let grasps = Planner::Antipodal.grasps(view, &gripper, &planner).map_err(|e| wrong("depth", &e))?;
        proposed = of_planner(&Planner::Antipodal, &grasps);
        proposed.truncate(request.number);
    }
    let overlay = picture(images.rgb.clone(), depth, &images.camera, &gripper, &proposed);
    work.overlay(&overlay.map_err(|e| ApiError::system("the overlay", e))?)?;
    let mut notes = vec![];
    if view.is_none() {
        notes.push("no object found on the table".to_owned());
    }
    if view.as_ref().is_some_and(|v| v.cut_by_edge) {
        notes.push("the image cuts the object off: the part outside was not seen".to_owned());
    }
    let object_pixels = view.as_ref().map_or(0, |v| v.mask.as_slice().iter().filter(|m| **m).count());
    Ok(json!({
        "method": "antipodal",
        "gripper": gripper.name,
        "object_pixels": object_pixels,
        "table": view.as_ref().and_then(|v| v.table).map(Table::from),
        "grasps": proposed,
        "camera": camera_numbers(&images.camera),
        "notes": notes,
        "seconds": began.elapsed().as_secs_f64(),
    }))
}
