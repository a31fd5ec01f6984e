//! Finding objects in an image, as `sixfold estimate` does on one image.

use std::sync::Arc;
use std::time::Instant;

use axum::extract::{Request as HttpRequest, State};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use sixfold_align::PreparedDepth;
use sixfold_estimator::{Need, PoseEstimator, Query, Region, check_min_confidence};
use sixfold_geometry::{Camera, Mask, Rect, Vec2};
use sixfold_runner::{FoundObject, ImageRun, depth_notes, without_overruled};
use sixfold_shell::found::SearchedImage;
use sixfold_shell::overlay;

use super::Request;
use crate::app::{App, Shared};
use crate::error::{Answer, ApiError, Problem};
use crate::form::{Form, FormRule};
use crate::images::{ImageBytes, Images};
use crate::jobs::{Accepted, JobView, Stopped, Work};
use crate::methods::{SharedObject, of_estimator};

/// Maximum number of objects of one request.
const MAX_OBJECTS: usize = 100;
const MAX_INSTANCES: usize = 1000;

const RULE: FormRule = FormRule {
    files: &["rgb", "depth", "camera", "mask"],
    many_files: &[],
    texts: &[
        "fx",
        "fy",
        "cx",
        "cy",
        "depth_scale",
        "objects",
        "method",
        "instances",
        "min_confidence",
        "box",
        "object_id",
    ],
};

/// The request without the images.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct FindRequest {
    method: String,
    objects: Vec<String>,
    depth_scale: Option<f64>,
    instances: usize,
    min_confidence: Option<f64>,
    region: Option<[f64; 4]>,
    object_id: Option<u32>,
}

/// The form of `POST /v1/find`.
#[derive(utoipa::ToSchema)]
#[allow(dead_code)]
pub(crate) struct FindForm {
    /// Colour image, PNG or JPEG.
    #[schema(value_type = Option<String>, format = Binary)]
    rgb: Option<Vec<u8>>,
    /// Depth image, PNG with one channel of 16 bits.
    #[schema(value_type = Option<String>, format = Binary)]
    depth: Option<Vec<u8>>,
    /// Camera file of BOP, OpenCV or ROS; or fx, fy, cx, cy.
    #[schema(value_type = Option<String>, format = Binary)]
    camera: Option<Vec<u8>>,
    /// Focal length in pixels.
    fx: Option<f64>,
    /// Focal length in pixels.
    fy: Option<f64>,
    /// Principal point in pixels; the centre of the top left pixel is (0, 0).
    cx: Option<f64>,
    /// Principal point in pixels.
    cy: Option<f64>,
    /// Millimetres per unit of the depth image, in place of the camera file's.
    depth_scale: Option<f64>,
    /// Names of stored objects, separated by commas or sent several times.
    objects: Vec<String>,
    /// auto, ppf, mttm, views or pix2pose (default: auto; ppf in a program without networks).
    method: Option<String>,
    /// Maximum number of instances of each object (default: 1).
    instances: Option<u32>,
    /// Poses of a lower confidence are left out (default: the method's, as for `sixfold estimate`).
    min_confidence: Option<f64>,
    /// x, y, width, height in pixels of the image: a box that contains the object.
    #[schema(rename = "box")]
    r#box: Option<String>,
    /// The object lies in this mask: PNG, above zero inside.
    #[schema(value_type = Option<String>, format = Binary)]
    mask: Option<Vec<u8>>,
    /// Its id in a trained model, for pix2pose.
    object_id: Option<u32>,
}

/// Finds stored objects in an image: a job whose result are poses.
#[utoipa::path(post, path = "/v1/find", tag = "find",
    request_body(content = FindForm, content_type = "multipart/form-data"),
    responses(
        (status = 202, description = "The job waits for a worker", body = JobView),
        (status = 400, description = "Not a form, or a path in a name", body = Problem),
        (status = 404, description = "An object that is not stored", body = Problem),
        (status = 413, description = "The request is larger than the server accepts", body = Problem),
        (status = 415, description = "Wrong content type", body = Problem),
        (status = 422, description = "An invalid field", body = Problem),
        (status = 429, description = "Too many waiting jobs", body = Problem),
    ))]
pub(crate) async fn find(State(app): Shared, request: HttpRequest) -> Answer<Accepted> {
    let form = Form::read(&app, request, &RULE).await?;
    app.blocking(move |app| {
        let images = ImageBytes::of_form(&form)?;
        let request = FindRequest::of_form(app, &form)?;
        request.check(app, &images)?;
        let job = Request::Find(request).store_job(app, &images.files())?;
        Ok(Accepted(JobView::of(app, &job)))
    })
    .await
}

impl FindRequest {
    fn of_form(app: &App, form: &Form) -> Answer<FindRequest> {
        let mut objects = vec![];
        for name in form.list("objects") {
            if !objects.contains(&name) {
                objects.push(name);
            }
        }
        let instances = form.parsed::<usize>("instances", "a whole number, 1 to 1000")?.unwrap_or(1);
        if !(1..=MAX_INSTANCES).contains(&instances) {
            return Err(ApiError::field(
                "instances",
                instances.to_string(),
                "1 to 1000",
                "correct the value",
            ));
        }
        let expected = "a number, 0 to 1";
        let min_confidence =
            form.number("min_confidence", expected, |v| check_min_confidence(v).is_ok() && v <= 1.0)?;
        Ok(FindRequest {
            method: form.text("method")?.unwrap_or(app.methods.names()[0]).to_owned(),
            objects,
            depth_scale: form.number("depth_scale", "a number above 0", |v| v > 0.0 && v.is_finite())?,
            instances,
            min_confidence,
            region: given_box(form)?,
            object_id: form.parsed("object_id", "a whole number")?,
        })
    }

    /// Checks that a worker can process the request.
    fn check(&self, app: &App, bytes: &ImageBytes) -> Answer<()> {
        let estimator = app.methods.estimator(&self.method)?;
        if self.objects.is_empty() || self.objects.len() > MAX_OBJECTS {
            return Err(ApiError::field(
                "objects",
                format!("{} names", self.objects.len()),
                format!("1 to {MAX_OBJECTS} names of stored objects"),
                "say what is to be found; /v1/objects lists what there is",
            ));
        }
        for name in &self.objects {
            let record = app.store.record(name).map_err(|e| ApiError::of_store("objects", &e))?;
            if record.without_mesh && !["auto", "mttm"].contains(&self.method.as_str()) {
                return Err(ApiError::field(
                    "objects",
                    format!("{name:?}, which was added from depth images and has no mesh"),
                    "an object with a mesh",
                    "choose the method auto or mttm",
                ));
            }
        }
        self.check_needs(estimator.as_ref(), bytes)?;
        let images = Images::decode(bytes, self.depth_scale)?;
        self.region(&images).map(|_| ())
    }

    fn check_needs(&self, estimator: &dyn PoseEstimator, bytes: &ImageBytes) -> Answer<()> {
        let (needs, method) = (estimator.needs(), &self.method);
        let lacks = |field: &str, what: &str| {
            ApiError::field(
                field,
                "nothing",
                format!("{what}, which the method {method} needs"),
                "send one or choose another method",
            )
        };
        if needs.depth == Need::Required && !bytes.has_depth() {
            return Err(lacks("depth", "a depth image"));
        }
        if needs.rgb == Need::Required && !bytes.has_rgb() {
            return Err(lacks("rgb", "a colour image"));
        }
        if needs.region == Need::Required {
            if self.region.is_none() && !bytes.has_mask() {
                return Err(lacks("box", "a box or a mask"));
            }
            if self.objects.len() > 1 {
                return Err(ApiError::field(
                    "objects",
                    format!("{} names", self.objects.len()),
                    format!("one: the method {method} takes one object and its box at a time"),
                    "send a request for each",
                ));
            }
        }
        Ok(())
    }

    /// The region of the search, in the image without distortion.
    fn region(&self, images: &Images) -> Answer<Option<Region>> {
        let lens = &images.lens;
        let boxed = self.region.map(|[x, y, width, height]| Rect { x, y, width, height });
        let whole = Rect { x: 0.0, y: 0.0, width: lens.width as f64, height: lens.height as f64 };
        if boxed.as_ref().is_some_and(|b| b.intersect(&whole).is_none()) {
            return Err(ApiError::field(
                "box",
                format!("{:?}", self.region.unwrap_or_default()),
                format!("a box within the image of {}x{}", lens.width, lens.height),
                "give x, y, width, height in pixels of this image",
            ));
        }
        let Some(mask) = &images.mask else {
            return Ok(boxed.map(|b| Region::of_box(undistorted(&b, lens))));
        };
        let mask = match boxed {
            None => mask.clone(),
            Some(bbox) => {
                let inside = Region::of_box(bbox).pixels(lens);
                Mask::from_fn(mask.width(), mask.height(), |x, y| mask[(x, y)] && inside[(x, y)])
            }
        };
        let region = Region::of_mask(mask).ok_or_else(|| {
            ApiError::field(
                "mask",
                "no pixel above zero",
                "some in which the object could be",
                "mark the object's pixels; together with a box they have to meet it",
            )
        })?;
        // A mask of a distorted image does not match the pixels of the pinhole image: use its box.
        let exact = lens.distortion.is_none();
        Ok(Some(if exact { region } else { Region::of_box(undistorted(&region.bbox, lens)) }))
    }
}

fn given_box(form: &Form) -> Answer<Option<[f64; 4]>> {
    let Some(text) = form.text("box")? else { return Ok(None) };
    let wrong = || {
        let expected = "x,y,width,height in pixels, with a size above 0";
        ApiError::field("box", format!("{text:?}"), expected, "correct the value")
    };
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|n| n.trim().parse::<f64>()).collect();
    let numbers: [f64; 4] = numbers.ok().and_then(|n| n.try_into().ok()).ok_or_else(wrong)?;
    let good = numbers.iter().all(|n| n.is_finite()) && numbers[2] > 0.0 && numbers[3] > 0.0;
    if good { Ok(Some(numbers)) } else { Err(wrong()) }
}

/// The box in the pinhole image that contains the content of a box in the raw image.
fn undistorted(bbox: &Rect, lens: &Camera) -> Rect {
    if lens.distortion.is_none() {
        return *bbox;
    }
    const STEPS: i32 = 4;
    let at = |i: i32, start: f64, size: f64| start + f64::from(i) * size / f64::from(STEPS);
    let grid = (0..=STEPS).flat_map(|u| (0..=STEPS).map(move |v| (u, v)));
    let points = grid.filter_map(|(u, v)| {
        lens.undistort_point(&Vec2::new(at(u, bbox.x, bbox.width), at(v, bbox.y, bbox.height)))
    });
    let infinite = Vec2::repeat(f64::INFINITY);
    let (low, high) = points.fold((infinite, -infinite), |(low, high), p| (low.inf(&p), high.sup(&p)));
    if low.x > high.x {
        return *bbox;
    }
    Rect { x: low.x, y: low.y, width: high.x - low.x, height: high.y - low.y }
}

/// Processes a request.
pub(super) fn run(app: &App, request: &FindRequest, work: &mut Work<'_>) -> Result<Value, Stopped> {
    let began = Instant::now();
    let images = Images::decode(&ImageBytes::of_folder(work.folder())?, request.depth_scale)?;
    let estimator = app.methods.estimator(&request.method)?;
    let needs = estimator.needs();
    let mut notes = vec![];
    let depth = match &images.depth {
        Some(depth) if needs.depth != Need::Unused => {
            let prepared = PreparedDepth::new(depth, &images.camera, &estimator.depth_options());
            let prepared: Arc<PreparedDepth> = prepared.map_err(|e| {
                ApiError::about("depth", e, "a depth image of a scene", "inspect the depth image")
            })?;
            notes.extend(depth_notes(&prepared, estimator.as_ref()));
            Some(prepared)
        }
        _ => None,
    };
    let region = request.region(&images)?;
    let query = Query {
        rgb: images.rgb.as_ref(),
        depth: depth.as_ref(),
        region: region.as_ref(),
        max_instances: request.instances,
        min_confidence: request.min_confidence.unwrap_or(estimator.min_confidence().image),
        ..Query::new(&images.camera)
    };
    query.check().map_err(|e| ApiError::about("form", e, "limits within their range", "correct them"))?;
    let image = ImageRun { estimator: estimator.as_ref(), query };
    let mut found = vec![];
    for (i, name) in request.objects.iter().enumerate() {
        work.step(i, request.objects.len(), name)?;
        found.push(search(app, &image, name, request.object_id, &mut notes)?);
    }
    let overruled = without_overruled(&mut found);
    if overruled > 0 {
        notes.push(format!(
            "{overruled} poses are left out: most of their pixels belong to more confident ones"
        ));
    }
    work.step(request.objects.len(), request.objects.len(), "drawing")?;
    let searched = SearchedImage {
        camera: &images.camera,
        rgb: images.rgb.as_ref(),
        depth: images.depth.as_ref(),
        found: &found,
    };
    work.overlay(&searched.overlay())?;
    let mut result = report(&image, &found, &images.camera)?;
    result["method"] = json!(request.method);
    result["notes"] = json!(notes);
    result["seconds"] = json!(began.elapsed().as_secs_f64());
    Ok(result)
}

/// Searches one object, which is prepared now or was prepared before.
fn search(
    app: &App,
    image: &ImageRun<'_>,
    name: &str,
    id: Option<u32>,
    notes: &mut Vec<String>,
) -> Answer<FoundObject> {
    let began = Instant::now();
    let prepared = app.methods.prepared(image.estimator, name, id)?;
    let estimates = image.estimator.estimate(prepared.as_ref(), &image.query);
    let estimates = estimates.map_err(|e| of_estimator("image", e))?;
    notes.extend(prepared.notes().iter().chain(estimates.iter().flat_map(|e| &e.notes)).cloned());
    let object = Box::new(SharedObject(prepared));
    Ok(FoundObject { object, estimates, seconds: began.elapsed().as_secs_f64() })
}

/// The poses in the form of `sixfold estimate --json`, with the colour of each in the overlay and the camera.
fn report(image: &ImageRun<'_>, found: &[FoundObject], camera: &Camera) -> Answer<Value> {
    let report = image.report(found);
    let fault = |e: serde_json::Error| ApiError::system("the result", e);
    let numbers = found.iter().enumerate().flat_map(|(i, f)| f.estimates.iter().map(move |_| i));
    let mut poses = vec![];
    for (pose, number) in report.poses.iter().zip(numbers) {
        let mut value = serde_json::to_value(pose).map_err(fault)?;
        let [r, g, b] = overlay::color(number);
        value["color"] = json!(format!("#{r:02x}{g:02x}{b:02x}"));
        value["visibility"] = json!(pose.visibility());
        // `seconds` is the method's own: a number, or one for each of its steps.
        value["search_seconds"] = json!(pose.elapsed);
        poses.push(value);
    }
    Ok(json!({
        "poses": poses,
        "not_found": report.not_found,
        "camera": camera_numbers(camera),
    }))
}

/// A pinhole camera as JSON.
pub(super) fn camera_numbers(camera: &Camera) -> Value {
    json!({
        "width": camera.width, "height": camera.height,
        "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
    })
}
