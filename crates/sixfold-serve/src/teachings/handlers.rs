//! `/v1/teachings`: create, list, show, run, accept and remove teachings.

use axum::Json;
use axum::body::Bytes;
use axum::extract::{Path, Request as HttpRequest, State};
use axum::http::StatusCode;
use serde::{Deserialize, Serialize};
use sixfold_teach::{Snapshot, TeachOptions, Teaching, World};
use utoipa::ToSchema;

use super::form::{Before, Given, MORE, MoreForm, NEW, TeachingForm};
use super::scale::no_scale;
use super::task::TeachRequest;
use super::views::{TeachingItem, TeachingView};
use super::{Entry, Record, VERSION, of_teach};
use crate::app::{App, Shared};
use crate::error::{Answer, ApiError, Problem};
use crate::form::Form;
use crate::jobs::{Accepted, JobView, now};
use crate::tasks::object::check_new_name;

/// Teachings, the newest first.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct TeachingList {
    teachings: Vec<TeachingItem>,
}

/// Lists the teachings, the newest first.
#[utoipa::path(get, path = "/v1/teachings", tag = "teachings", responses(
    (status = 200, description = "The teachings", body = TeachingList),
))]
pub(crate) async fn list_teachings(State(app): Shared) -> Answer<Json<TeachingList>> {
    app.blocking(|app| {
        let all = app.teachings.all();
        let teachings = all.iter().filter_map(|entry| TeachingItem::of(app, entry)).collect();
        Ok(Json(TeachingList { teachings }))
    })
    .await
}

/// Starts to teach an object from photographs of it, on the printed board or without one, and runs it unless `start` is false.
#[utoipa::path(post, path = "/v1/teachings", tag = "teachings",
    request_body(content = TeachingForm, content_type = "multipart/form-data"),
    responses(
        (status = 201, description = "The teaching, with its job", body = TeachingView),
        (status = 400, description = "Not a form, an invalid name, or a path in a name", body = Problem),
        (status = 409, description = "There is an object of this name", body = Problem),
        (status = 413, description = "The request is larger than the server accepts", body = Problem),
        (status = 415, description = "Wrong content type", body = Problem),
        (status = 422, description = "An invalid field", body = Problem),
        (status = 429, description = "Too many teachings, or too many waiting jobs", body = Problem),
    ))]
pub(crate) async fn add_teaching(
    State(app): Shared,
    request: HttpRequest,
) -> Answer<(StatusCode, Json<TeachingView>)> {
    let form = Form::read(&app, request, &NEW).await?;
    app.blocking(move |app| {
        let starts = form.parsed("start", "true or false")?.unwrap_or(true);
        let entry = laid_down(app, &form, starts)?;
        if starts {
            // If too many jobs wait, it can be run later: the photographs are kept.
            if let Err(error) = entry.start(app, TeachRequest::run(&entry.id)) {
                entry.note(|record| record.problem = Some(*error.problem))?;
            }
        }
        Ok((StatusCode::CREATED, Json(TeachingView::of(app, &entry)?)))
    })
    .await
}

fn laid_down(app: &App, form: &Form, starts: bool) -> Answer<std::sync::Arc<Entry>> {
    let flag = |name: &str| Ok::<bool, ApiError>(form.parsed(name, "true or false")?.unwrap_or(false));
    let name = form.text("name")?.ok_or_else(|| {
        ApiError::field("name", "nothing", "up to 100 letters, digits, - and _", "give the object a name")
    })?;
    let replace = flag("replace")?;
    check_new_name(app, name, replace)?;
    form.needed_file("photographs", "photographs of the object")?;
    let given = Given::of_form(form, &Before::default())?;
    if starts && !given.has_scale() {
        return Err(no_scale());
    }
    let record = Record {
        version: VERSION,
        name: name.to_owned(),
        hull_only: given.hull_only().unwrap_or(false),
        replace,
        created: now(),
        job: None,
        problem: None,
        mesh: None,
        symmetries: vec![],
        object: None,
        accepted: false,
    };
    app.teachings.add(record, |folder| {
        let mut teaching = Teaching::open(folder, &TeachOptions::default()).map_err(|e| of_teach(&e))?;
        given.into(&mut teaching)
    })
}

/// One teaching: photographs with state, pose and mask, the mesh, symmetries. Also while its job runs.
#[utoipa::path(get, path = "/v1/teachings/{id}", tag = "teachings", params(("id" = String, Path, description = "Its id")), responses(
    (status = 200, description = "The teaching", body = TeachingView),
    (status = 404, description = "There is no such teaching", body = Problem),
))]
pub(crate) async fn get_teaching(State(app): Shared, Path(id): Path<String>) -> Answer<Json<TeachingView>> {
    app.blocking(move |app| Ok(Json(TeachingView::of(app, app.teachings.get(&id)?.as_ref())?))).await
}

/// Removes a teaching with its photographs; an object that was stored from it remains.
#[utoipa::path(delete, path = "/v1/teachings/{id}", tag = "teachings", params(("id" = String, Path, description = "Its id")), responses(
    (status = 204, description = "Removed"),
    (status = 404, description = "There is no such teaching", body = Problem),
    (status = 409, description = "A job for it is running or waiting", body = Problem),
))]
pub(crate) async fn delete_teaching(State(app): Shared, Path(id): Path<String>) -> Answer<StatusCode> {
    app.blocking(move |app| app.teachings.remove(app, &id)).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Adds photographs, depth or the camera file, or changes settings: ruler, with or without a board, length and ends, mesh, hull_only.
/// What depends on them is computed again by the next run: poses, or the mesh alone.
#[utoipa::path(post, path = "/v1/teachings/{id}/photographs", tag = "teachings",
    params(("id" = String, Path, description = "Its id")),
    request_body(content = MoreForm, content_type = "multipart/form-data"),
    responses(
        (status = 200, description = "The teaching", body = TeachingView),
        (status = 400, description = "Not a form, or a path in a name", body = Problem),
        (status = 404, description = "There is no such teaching", body = Problem),
        (status = 409, description = "A job for it is running or waiting", body = Problem),
        (status = 413, description = "The request is larger than the server accepts", body = Problem),
        (status = 415, description = "Wrong content type", body = Problem),
        (status = 422, description = "An invalid field", body = Problem),
    ))]
pub(crate) async fn add_photographs(
    State(app): Shared,
    Path(id): Path<String>,
    request: HttpRequest,
) -> Answer<Json<TeachingView>> {
    app.teachings.get(&id)?;
    let form = Form::read(&app, request, &MORE).await?;
    app.blocking(move |app| {
        let entry = app.teachings.get(&id)?;
        let known = entry.snapshot()?;
        let given = Given::of_form(&form, &Before::of(&known, entry.record().hull_only))?;
        if given.is_empty() {
            return Err(ApiError::field(
                "photographs",
                "nothing",
                "photographs, a camera file, or settings",
                "send what is to be added",
            ));
        }
        let most = sixfold_teach::MAX_PHOTOGRAPHS;
        if known.photographs().len() + given.photographs() > most {
            let found = format!("{} and {} more", known.photographs().len(), given.photographs());
            return Err(ApiError::field(
                "photographs",
                found,
                format!("at most {most}"),
                "leave out those that show nothing new",
            ));
        }
        let hull_only = given.hull_only().filter(|new| *new != entry.record().hull_only);
        entry.change(app, |teaching| {
            given.into(teaching)?;
            if let Some(hull_only) = hull_only {
                teaching.forget_mesh().map_err(|e| of_teach(&e))?;
                entry.note(|record| record.hull_only = hull_only)?;
            }
            Ok(())
        })?;
        Ok(Json(TeachingView::of(app, &entry)?))
    })
    .await
}

/// Computes what is missing, after corrections only what depends on them: a job.
#[utoipa::path(post, path = "/v1/teachings/{id}/run", tag = "teachings", params(("id" = String, Path, description = "Its id")), responses(
    (status = 202, description = "The job waits for a worker", body = JobView),
    (status = 404, description = "There is no such teaching", body = Problem),
    (status = 409, description = "A job for it is running or waiting, or the scale of photographs without a board is not known \
         yet", body = Problem),
    (status = 429, description = "Too many waiting jobs", body = Problem),
))]
pub(crate) async fn run_teaching(State(app): Shared, Path(id): Path<String>) -> Answer<Accepted> {
    app.blocking(move |app| {
        let entry = app.teachings.get(&id)?;
        if !has_scale(&entry.snapshot()?) {
            return Err(no_scale().with_status(StatusCode::CONFLICT));
        }
        let job = entry.start(app, TeachRequest::run(&id))?;
        Ok(Accepted(JobView::of(app, &job)))
    })
    .await
}

/// Whether the scale of a teaching follows from what was given.
fn has_scale(known: &Snapshot) -> bool {
    let depth = || known.photographs().iter().any(|p| p.depth.is_some() && !p.left_out_by_person);
    known.options().world != World::Features || known.length().is_some() || depth()
}

/// What to store an object as.
#[derive(Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct AcceptBody {
    /// Another name than the teaching's.
    name: Option<String>,
    /// Replace an object of this name (default: as in the teaching).
    replace: Option<bool>,
}

/// Stores the object with its symmetries, photographs and what methods derive from it: a job.
#[utoipa::path(post, path = "/v1/teachings/{id}/accept", tag = "teachings",
    params(("id" = String, Path, description = "Its id")),
    request_body(content = Option<AcceptBody>),
    responses(
        (status = 202, description = "The job waits for a worker", body = JobView),
        (status = 400, description = "Not a valid object name", body = Problem),
        (status = 404, description = "There is no such teaching", body = Problem),
        (status = 409, description = "There is no mesh yet, the name is taken, or a job for it is running \
             or waiting", body = Problem),
        (status = 422, description = "An invalid body", body = Problem),
        (status = 429, description = "Too many waiting jobs", body = Problem),
    ))]
pub(crate) async fn accept_teaching(
    State(app): Shared,
    Path(id): Path<String>,
    body: Bytes,
) -> Answer<Accepted> {
    let body: AcceptBody = if body.is_empty() { AcceptBody::default() } else { super::from_json(&body)? };
    app.blocking(move |app| {
        let entry = app.teachings.get(&id)?;
        if entry.snapshot()?.shape().is_none() {
            let advice = "run the teaching, and inspect its overlays";
            return Err(ApiError::plain(
                StatusCode::CONFLICT,
                "there is no mesh of these photographs yet",
                advice,
            ));
        }
        let record = entry.record();
        let name = body.name.unwrap_or(record.name);
        // An object that this teaching stored earlier may be replaced.
        let own = record.object.as_ref() == Some(&name);
        let replace = own || body.replace.unwrap_or(record.replace);
        check_new_name(app, &name, replace)?;
        let job = entry.start(app, TeachRequest::accept(&id, name, replace))?;
        Ok(Accepted(JobView::of(app, &job)))
    })
    .await
}
