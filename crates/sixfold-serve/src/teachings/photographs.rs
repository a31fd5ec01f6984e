//! Images of a teaching: photographs without lens distortion, overlays, masks, the mesh.

use std::io::Cursor;

use axum::extract::rejection::QueryRejection;
use axum::extract::{Path, Query, State};
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use image::codecs::jpeg::JpegEncoder;
use serde::Deserialize;
use sixfold_geometry::{Image, RgbImage};
use sixfold_teach::Snapshot;
use utoipa::IntoParams;

use super::of_teach;
use crate::app::{App, Shared};
use crate::error::{Answer, ApiError, Problem};
use crate::images::png;
use crate::objects::{MeshDetail, faces_of, mesh_ply};

/// Sides of images, pixels: the default, and the range that may be requested.
const SIDE: usize = 1280;
const SIDES: std::ops::RangeInclusive<usize> = 64..=2048;
const QUALITY: u8 = 88;

/// Size of an image.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub(crate) struct Detail {
    /// At most this many pixels wide and high, 64 to 2048 (default: 1280).
    side: Option<usize>,
    /// For overlays: only the object and its surroundings, a square.
    close_up: Option<bool>,
    /// For images: with lens distortion, as the photograph was taken; the points of `ends` are pixels of it.
    as_taken: Option<bool>,
    /// The revision that links contain: browsers may cache such an image.
    revision: Option<u64>,
}

type Asked = Result<Query<Detail>, QueryRejection>;

/// A photograph's number in a path.
pub(super) fn number(text: &str) -> Answer<usize> {
    text.parse().map_err(|_| {
        ApiError::field(
            "number",
            format!("{text:?}"),
            "the number of a photograph, from 0",
            "inspect the teaching",
        )
        .with_status(axum::http::StatusCode::NOT_FOUND)
    })
}

async fn sent(
    app: std::sync::Arc<App>,
    (id, text): (String, String),
    asked: Asked,
    content_type: &'static str,
    make: impl FnOnce(&Snapshot, usize, usize, &Detail) -> Answer<Vec<u8>> + Send + 'static,
) -> Answer<Response> {
    app.blocking(move |app| {
        let known = app.teachings.get(&id)?.snapshot()?;
        let number = number(&text)?;
        let expected = format!("a whole number, {} to {}", SIDES.start(), SIDES.end());
        let wrong = |found: String| ApiError::field("side", found, &*expected, "correct the value");
        let detail = asked.map_err(|e| wrong(e.body_text()))?.0;
        let side = detail.side.unwrap_or(SIDE);
        if !SIDES.contains(&side) {
            return Err(wrong(side.to_string()));
        }
        let bytes = make(&known, number, side, &detail)?;
        Ok(kept_while(detail.revision == Some(known.revision()), content_type, bytes))
    })
    .await
}

/// An answer that a browser may cache if the address contains the current revision.
fn kept_while(same: bool, content_type: &'static str, bytes: Vec<u8>) -> Response {
    let cache = if same { "private, max-age=86400" } else { "no-store" };
    ([(CONTENT_TYPE, content_type), (CACHE_CONTROL, cache)], bytes).into_response()
}

/// An image as the bytes of a JPEG.
fn jpeg(image: &RgbImage) -> Answer<Vec<u8>> {
    let data: Vec<u8> = image.as_slice().iter().flatten().copied().collect();
    let mut bytes = Cursor::new(vec![]);
    let encoder = JpegEncoder::new_with_quality(&mut bytes, QUALITY);
    let (width, height) = (image.width() as u32, image.height() as u32);
    let written =
        image::ImageEncoder::write_image(encoder, &data, width, height, image::ExtendedColorType::Rgb8);
    written.map_err(|e| ApiError::system("an image", e))?;
    Ok(bytes.into_inner())
}

/// A photograph without lens distortion; with it as long as the camera is not known, or if `as_taken`.
#[utoipa::path(get, path = "/v1/teachings/{id}/photographs/{number}/image.jpg", tag = "teachings",
    params(("id" = String, Path, description = "The teaching's id"), ("number" = usize, Path, description = "From 0"), Detail),
    responses(
        (status = 200, description = "The image", body = Vec<u8>, content_type = "image/jpeg"),
        (status = 404, description = "There is no such teaching or photograph", body = Problem),
        (status = 422, description = "Not a valid image size", body = Problem),
    ))]
pub(crate) async fn photograph_image(
    State(app): Shared,
    Path(path): Path<(String, String)>,
    asked: Asked,
) -> Answer<Response> {
    sent(app, path, asked, "image/jpeg", |known, number, side, detail| {
        let image = match detail.as_taken {
            Some(true) => known.image_as_taken(number, side),
            _ => known.image(number, side).map(|(image, _)| image),
        };
        jpeg(&image.map_err(|e| of_teach(&e))?)
    })
    .await
}

/// The same with the border of the mask in yellow and the outline of the mesh in blue, as far as they are known.
#[utoipa::path(get, path = "/v1/teachings/{id}/photographs/{number}/overlay.jpg", tag = "teachings",
    params(("id" = String, Path, description = "The teaching's id"), ("number" = usize, Path, description = "From 0"), Detail),
    responses(
        (status = 200, description = "The image", body = Vec<u8>, content_type = "image/jpeg"),
        (status = 404, description = "There is no such teaching or photograph", body = Problem),
        (status = 422, description = "Not a valid image size", body = Problem),
    ))]
pub(crate) async fn photograph_overlay(
    State(app): Shared,
    Path(path): Path<(String, String)>,
    asked: Asked,
) -> Answer<Response> {
    sent(app, path, asked, "image/jpeg", |known, number, side, detail| {
        let close_up = detail.close_up.unwrap_or(false);
        let image = if close_up { known.close_up(number, side) } else { known.overlay(number, side) };
        jpeg(&image.map_err(|e| of_teach(&e))?)
    })
    .await
}

/// A photograph's mask, without lens distortion and of the photograph's size: white on the object.
#[utoipa::path(get, path = "/v1/teachings/{id}/photographs/{number}/mask.png", tag = "teachings",
    params(("id" = String, Path, description = "The teaching's id"), ("number" = usize, Path, description = "From 0"), Detail),
    responses(
        (status = 200, description = "The mask", body = Vec<u8>, content_type = "image/png"),
        (status = 404, description = "There is no such teaching or photograph, or it has no mask", body = Problem),
        (status = 422, description = "Not a valid image size", body = Problem),
    ))]
pub(crate) async fn photograph_mask(
    State(app): Shared,
    Path(path): Path<(String, String)>,
    asked: Asked,
) -> Answer<Response> {
    sent(app, path, asked, "image/png", |known, number, _, _| {
        let mask = known.mask(number).map_err(|e| of_teach(&e))?.ok_or_else(|| {
            ApiError::field(
                "number",
                number.to_string(),
                "a photograph with a mask",
                "run the teaching, or send a mask",
            )
            .with_status(axum::http::StatusCode::NOT_FOUND)
        })?;
        let (width, height) = mask.size();
        png(&Image::from_fn(width, height, |x, y| if mask[(x, y)] { [255; 3] } else { [0; 3] }))
    })
    .await
}

/// The latest mesh: binary PLY in metres with colours, in the object's frame.
#[utoipa::path(get, path = "/v1/teachings/{id}/mesh.ply", tag = "teachings",
    params(("id" = String, Path, description = "The teaching's id"), MeshDetail),
    responses(
        (status = 200, description = "The mesh", body = Vec<u8>, content_type = "model/ply"),
        (status = 404, description = "There is no such teaching, or no mesh of it yet", body = Problem),
        (status = 422, description = "Fewer faces than the minimum", body = Problem),
    ))]
pub(crate) async fn teaching_mesh(
    State(app): Shared,
    Path(id): Path<String>,
    detail: Result<Query<MeshDetail>, QueryRejection>,
) -> Answer<Response> {
    app.blocking(move |app| {
        let known = app.teachings.get(&id)?.snapshot()?;
        let (faces, revision) = faces_of(detail)?;
        let (mesh, _) = known.last_mesh().map_err(|e| of_teach(&e))?.ok_or_else(|| {
            ApiError::field("id", "a teaching without a mesh", "one that was run", "run the teaching")
                .with_status(axum::http::StatusCode::NOT_FOUND)
        })?;
        Ok(kept_while(revision == Some(known.revision()), "model/ply", mesh_ply(&mesh, faces)?))
    })
    .await
}
