//! A person's corrections of a photograph: its pose, its mask, whether to use it. Only results that depend on them are computed
//! again.

use axum::Json;
use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{Path, State};
use axum::http::StatusCode;
use serde::{Deserialize, de::DeserializeOwned};
use sixfold_geometry::{Image, Mask, Pose, Vec2, Vec3};
use sixfold_io::ImageFile;
use sixfold_teach::{Teaching, pose_of_points};
use utoipa::ToSchema;

use super::of_teach;
use super::photographs::number;
use super::views::TeachingView;
use crate::app::{App, Shared};
use crate::error::{Answer, ApiError, Problem};

/// Maximum number of marked points.
const MAX_PAIRS: usize = 100;
/// The camera is within this distance of the board's centre, metres.
const REACH: f64 = 10.0;

/// A pose: a matrix, or marked points.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct PoseBody {
    /// Pose of the board in the camera's frame, 4x4 row by row, metres.
    camera_from_board: Option<[[f64; 4]; 4]>,
    /// Instead of a matrix: three or more points with their pixels.
    pairs: Option<Vec<Pair>>,
}

/// A point of the board's frame and where the photograph shows it.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Pair {
    /// Metres: the board's plane is z = 0, the mesh stands on it.
    point: [f64; 3],
    /// In the photograph without lens distortion (image.jpg), in pixels of its full size; the centre of the top left one is (0, 0).
    pixel: [f64; 2],
}

/// Whether to use a photograph.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct LeftOutBody {
    left_out: bool,
}

/// A body of JSON.
pub(crate) fn from_json<T: DeserializeOwned>(bytes: &[u8]) -> Answer<T> {
    serde_json::from_slice(bytes)
        .map_err(|e| ApiError::about("body", e, "JSON as /v1/openapi.json describes it", "correct the body"))
}

type Body = Result<Bytes, BytesRejection>;

fn bytes(app: &App, body: Body) -> Answer<Bytes> {
    body.map_err(|e| {
        let most = app.options.max_upload >> 20;
        ApiError::field("body", e.body_text(), format!("at most {most} MB"), "send a smaller body")
            .with_status(e.status())
    })
}

/// Changes one photograph and answers with the teaching.
fn changed(
    app: &App,
    (id, text): &(String, String),
    change: impl FnOnce(&mut Teaching, usize) -> Answer<()>,
) -> Answer<Json<TeachingView>> {
    let (entry, number) = (app.teachings.get(id)?, number(text)?);
    // Check that the photograph exists before anything is locked.
    entry.snapshot()?.photograph_file(number).map_err(|e| of_teach(&e))?;
    entry.change(app, |teaching| change(teaching, number))?;
    Ok(Json(TeachingView::of(app, &entry)?))
}

/// Corrects a pose: by a matrix, or by marked points. The next run computes masks and mesh again.
#[utoipa::path(put, path = "/v1/teachings/{id}/photographs/{number}/pose", tag = "teachings",
    params(("id" = String, Path, description = "The teaching's id"), ("number" = usize, Path, description = "From 0")),
    request_body(content = PoseBody),
    responses(
        (status = 200, description = "The teaching", body = TeachingView),
        (status = 404, description = "There is no such teaching or photograph", body = Problem),
        (status = 409, description = "A job for it is running or waiting, or the camera has not been found \
             yet", body = Problem),
        (status = 422, description = "Not a pose", body = Problem),
    ))]
pub(crate) async fn set_pose(
    State(app): Shared,
    Path(path): Path<(String, String)>,
    body: Body,
) -> Answer<Json<TeachingView>> {
    let body: PoseBody = from_json(&bytes(&app, body)?)?;
    app.blocking(move |app| {
        changed(app, &path, |teaching, number| {
            let pose = pose_of(&body, teaching, number)?;
            teaching.set_pose(number, &pose).map_err(|e| of_teach(&e))
        })
    })
    .await
}

fn pose_of(body: &PoseBody, teaching: &Teaching, number: usize) -> Answer<Pose> {
    let camera = teaching.camera().ok_or_else(|| {
        let advice = "run the teaching, with a camera file where it cannot be found";
        ApiError::plain(StatusCode::CONFLICT, "the camera of these photographs is not known yet", advice)
    })?;
    let expected = "a rigid transform by rows, metres, that puts the board before the camera";
    let pose = match (&body.camera_from_board, &body.pairs) {
        (Some(rows), None) => {
            let wrong = |e: &dyn std::fmt::Display| {
                ApiError::about("camera_from_board", e, expected, "correct the matrix")
            };
            Pose::from_rows(rows).map_err(|e| wrong(&e))?
        }
        (None, Some(pairs)) => {
            let most = &pairs[..pairs.len().min(MAX_PAIRS)];
            let points: Vec<Vec3> = most.iter().map(|p| Vec3::from(p.point)).collect();
            let pixels: Vec<Vec2> = most.iter().map(|p| Vec2::from(p.pixel)).collect();
            let near = teaching.camera_from_board(number);
            pose_of_points(&points, &pixels, &camera.without_distortion(), near.as_ref())
                .map_err(|e| of_teach(&e))?
        }
        _ => {
            return Err(ApiError::field(
                "camera_from_board",
                "neither it nor pairs, or both",
                "one of camera_from_board and pairs",
                "send a matrix or marked points",
            ));
        }
    };
    let centre = pose.translation();
    if !(centre.norm() < REACH && centre.z > 0.0) {
        let [x, y, z]: [f64; 3] = centre.into();
        return Err(ApiError::field(
            "camera_from_board",
            format!("the board's centre at ({x:.3}, {y:.3}, {z:.3}) of the camera's frame"),
            expected,
            "metres, z forward: 0.5 is half a metre before the camera",
        ));
    }
    Ok(pose)
}

/// Corrects a mask: a PNG that is above zero on the object. The next run computes the mesh again.
#[utoipa::path(put, path = "/v1/teachings/{id}/photographs/{number}/mask", tag = "teachings",
    params(("id" = String, Path, description = "The teaching's id"), ("number" = usize, Path, description = "From 0")),
    request_body(content = Vec<u8>, content_type = "image/png",
        description = "Without lens distortion, of the photograph's size or that of its image.jpg"),
    responses(
        (status = 200, description = "The teaching", body = TeachingView),
        (status = 404, description = "There is no such teaching or photograph", body = Problem),
        (status = 409, description = "A job for it is running or waiting", body = Problem),
        (status = 413, description = "The request is larger than the server accepts", body = Problem),
        (status = 422, description = "Not a mask of this photograph", body = Problem),
    ))]
pub(crate) async fn set_mask(
    State(app): Shared,
    Path(path): Path<(String, String)>,
    body: Body,
) -> Answer<Json<TeachingView>> {
    let body = bytes(&app, body)?;
    app.blocking(move |app| {
        let mask = ImageFile::of_bytes(std::path::Path::new("mask"), &body).mask_and_hidden();
        let (mask, hidden) = mask.map_err(|e| ApiError::of_image("mask", &e))?;
        if !mask.as_slice().contains(&true) {
            return Err(ApiError::field(
                "mask",
                "no pixel above zero",
                "the object's pixels above zero",
                "mark the object, or leave the photograph out",
            ));
        }
        changed(app, &path, |teaching, number| {
            let size = teaching.photographs()[number].size;
            let enlarged = |mask: Mask| size.and_then(|size| enlarged(&mask, size)).unwrap_or(mask);
            let (mask, hidden) = (enlarged(mask), hidden.map(enlarged));
            teaching.set_mask(number, &mask, hidden.as_ref()).map_err(|e| of_teach(&e))
        })
    })
    .await
}

/// A mask of a smaller image with the same aspect ratio, enlarged to the photograph's size.
fn enlarged(mask: &Mask, (width, height): (usize, usize)) -> Option<Mask> {
    let (w, h) = mask.size();
    // Sides are whole pixels, so the shorter one may be rounded by half a pixel.
    let same =
        |a: usize, b: usize, c: usize, d: usize| (a as f64 * d as f64 / c as f64 - b as f64).abs() <= 0.51;
    let good = w <= width && h <= height && (same(w, h, width, height) || same(h, w, height, width));
    good.then(|| Image::from_fn(width, height, |x, y| mask[(x * w / width, y * h / height)]))
}

/// Leaves a photograph out, or uses it again. The next run computes the mesh again.
#[utoipa::path(put, path = "/v1/teachings/{id}/photographs/{number}/left_out", tag = "teachings",
    params(("id" = String, Path, description = "The teaching's id"), ("number" = usize, Path, description = "From 0")),
    request_body(content = LeftOutBody),
    responses(
        (status = 200, description = "The teaching", body = TeachingView),
        (status = 404, description = "There is no such teaching or photograph", body = Problem),
        (status = 409, description = "A job for it is running or waiting, or the program rejected the \
             photograph", body = Problem),
        (status = 422, description = "An invalid body", body = Problem),
    ))]
pub(crate) async fn set_left_out(
    State(app): Shared,
    Path(path): Path<(String, String)>,
    body: Body,
) -> Answer<Json<TeachingView>> {
    let LeftOutBody { left_out } = from_json(&bytes(&app, body)?)?;
    app.blocking(move |app| {
        changed(app, &path, |teaching, number| {
            let photograph = &teaching.photographs()[number];
            if let (Some(reason), false, false) =
                (&photograph.left_out, photograph.left_out_by_person, left_out)
            {
                let message = format!("{} is left out: {reason}", photograph.name);
                let advice = "correct its pose or its mask, and it is used";
                return Err(ApiError::plain(StatusCode::CONFLICT, message, advice));
            }
            teaching.set_left_out(number, left_out).map_err(|e| of_teach(&e))
        })
    })
    .await
}

/// Removes the corrections of a photograph: the program finds pose and mask again.
#[utoipa::path(delete, path = "/v1/teachings/{id}/photographs/{number}/corrections", tag = "teachings",
    params(("id" = String, Path, description = "The teaching's id"), ("number" = usize, Path, description = "From 0")),
    responses(
        (status = 200, description = "The teaching", body = TeachingView),
        (status = 404, description = "There is no such teaching or photograph", body = Problem),
        (status = 409, description = "A job for it is running or waiting", body = Problem),
    ))]
pub(crate) async fn forget_corrections(
    State(app): Shared,
    Path(path): Path<(String, String)>,
) -> Answer<Json<TeachingView>> {
    app.blocking(move |app| {
        changed(app, &path, |teaching, number| teaching.forget_corrections(number).map_err(|e| of_teach(&e)))
    })
    .await
}
