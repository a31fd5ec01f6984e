//! The API of jobs: list, watch, cancel and remove them, and get results and images.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::Json;
use axum::extract::{Path, Query, State};
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE, LOCATION};
use axum::http::{HeaderName, StatusCode};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::stream::{self, Stream};
use serde::{Deserialize, Serialize};
use sixfold_io::{limits, read_regular};
use tokio::sync::watch;
use utoipa::{IntoParams, ToSchema};

use super::record::{Job, JobKind, JobRecord, JobState, Progress};
use crate::app::{App, Shared};
use crate::error::{Answer, ApiError, Problem};

/// Longest time that a client may wait for a result in one request, seconds: below the limit of requests.
const MAX_WAIT: f64 = 60.0;
/// Interval of keep-alive messages in an idle stream.
const KEEP_ALIVE: Duration = Duration::from_secs(10);

/// A job.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct JobView {
    /// Its id.
    id: String,
    kind: JobKind,
    /// The object that is trained, for trainings.
    object: Option<String>,
    state: JobState,
    progress: Progress,
    /// Number of jobs ahead of this one, while it waits.
    ahead: Option<usize>,
    /// When it was received, seconds since 1970.
    created: f64,
    /// When a worker started it.
    started: Option<f64>,
    /// When it ended.
    finished: Option<f64>,
    /// Why it failed.
    error: Option<Problem>,
    links: JobLinks,
}

/// Links of a job.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct JobLinks {
    /// The job itself.
    job: String,
    /// Server-sent events: one `job` for each change.
    events: String,
    /// The result, once it is done.
    result: String,
    /// An image of the result, where there is one.
    overlay: Option<String>,
}

impl JobView {
    pub fn of(app: &App, job: &Job) -> JobView {
        let record = job.record.borrow().clone();
        JobView::new(record, app.jobs.ahead(job))
    }

    fn new(record: JobRecord, ahead: Option<usize>) -> JobView {
        let path = format!("/v1/jobs/{}", record.id);
        JobView {
            kind: record.kind,
            object: record.object,
            state: record.state,
            progress: record.progress,
            ahead,
            created: record.created,
            started: record.started,
            finished: record.finished,
            error: record.error,
            links: JobLinks {
                events: format!("{path}/events"),
                result: format!("{path}/result"),
                overlay: record.overlay.then(|| format!("{path}/overlay.png")),
                job: path,
            },
            id: record.id,
        }
    }
}

/// The answer to a request that was accepted as a job.
pub(crate) struct Accepted(pub JobView);

impl IntoResponse for Accepted {
    fn into_response(self) -> Response {
        let location = [(LOCATION, self.0.links.job.clone())];
        (StatusCode::ACCEPTED, location, Json(self.0)).into_response()
    }
}

/// Jobs, the newest first.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct JobList {
    jobs: Vec<JobView>,
}

/// Lists all jobs that are kept, the newest first.
#[utoipa::path(get, path = "/v1/jobs", tag = "jobs", responses(
    (status = 200, description = "The jobs", body = JobList),
))]
pub(crate) async fn list_jobs(State(app): Shared) -> Json<JobList> {
    Json(JobList { jobs: app.jobs.all().iter().map(|job| JobView::of(&app, job)).collect() })
}

/// One job.
#[utoipa::path(get, path = "/v1/jobs/{id}", tag = "jobs", params(("id" = String, Path, description = "Its id")), responses(
    (status = 200, description = "The job", body = JobView),
    (status = 404, description = "There is no such job", body = Problem),
))]
pub(crate) async fn get_job(State(app): Shared, Path(id): Path<String>) -> Answer<Json<JobView>> {
    Ok(Json(JobView::of(&app, app.jobs.get(&id)?.as_ref())))
}

/// Removes a finished job with its files and result.
#[utoipa::path(delete, path = "/v1/jobs/{id}", tag = "jobs", params(("id" = String, Path, description = "Its id")), responses(
    (status = 204, description = "Removed"),
    (status = 404, description = "There is no such job", body = Problem),
    (status = 409, description = "The job has not finished", body = Problem),
))]
pub(crate) async fn delete_job(State(app): Shared, Path(id): Path<String>) -> Answer<StatusCode> {
    app.blocking(move |app| app.jobs.remove(&id)).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Cancels a job: at once while it waits, at its next step while it runs; nothing happens to a finished one.
#[utoipa::path(post, path = "/v1/jobs/{id}/cancel", tag = "jobs", params(("id" = String, Path, description = "Its id")), responses(
    (status = 200, description = "The job", body = JobView),
    (status = 404, description = "There is no such job", body = Problem),
))]
pub(crate) async fn cancel_job(State(app): Shared, Path(id): Path<String>) -> Answer<Json<JobView>> {
    app.blocking(move |app| {
        let job = app.jobs.cancel(&id)?;
        Ok(Json(JobView::of(app, &job)))
    })
    .await
}

/// How long to wait for a result.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub(crate) struct Waiting {
    /// Wait at most this many seconds for the job to end, 0 to 60.
    wait: Option<f64>,
}

/// The result of a job. Its form depends on the kind: poses, grasps, or an object's record.
#[utoipa::path(get, path = "/v1/jobs/{id}/result", tag = "jobs", params(("id" = String, Path, description = "Its id"), Waiting), responses(
    (status = 200, description = "The result", body = serde_json::Value),
    (status = 202, description = "The job is not finished: ask again", body = JobView),
    (status = 404, description = "There is no such job", body = Problem),
    (status = 409, description = "The job was cancelled", body = Problem),
    (status = 422, description = "The job failed: the images do not contain what the method needs", body = Problem),
))]
pub(crate) async fn job_result(
    State(app): Shared,
    Path(id): Path<String>,
    waiting: Result<Query<Waiting>, axum::extract::rejection::QueryRejection>,
) -> Answer<Response> {
    let expected = format!("a number of seconds, 0 to {MAX_WAIT}");
    let wrong = |found: String| ApiError::field("wait", found, &*expected, "correct the value");
    let wait = waiting.map_err(|e| wrong(e.body_text()))?.0.wait.unwrap_or(0.0);
    if !(0.0..=MAX_WAIT).contains(&wait) {
        return Err(wrong(wait.to_string()));
    }
    let job = app.jobs.get(&id)?;
    let record = ended(&job, Duration::from_secs_f64(wait)).await;
    match record.state {
        JobState::Queued | JobState::Running => Ok(Accepted(JobView::of(&app, &job)).into_response()),
        JobState::Done => file(&app, job, "result.json", "application/json").await,
        JobState::Cancelled => Err(ApiError::plain(
            StatusCode::CONFLICT,
            format!("job {id} was cancelled"),
            "send the request again",
        )),
        JobState::Failed => {
            let status = record.error_status.and_then(|s| StatusCode::from_u16(s).ok());
            let unknown = ApiError::plain(
                StatusCode::INTERNAL_SERVER_ERROR,
                "the job failed",
                "send the request again",
            );
            let problem = record.error.map_or(unknown.problem, Box::new);
            Err(ApiError { status: status.unwrap_or(unknown.status), problem })
        }
    }
}

/// The record when the job has ended, or when the waiting time is over.
async fn ended(job: &Job, wait: Duration) -> JobRecord {
    let mut watched = job.record.subscribe();
    let _ = tokio::time::timeout(wait, watched.wait_for(|record| record.state.is_final())).await;
    job.record.borrow().clone()
}

/// An image of the result: poses or grasps drawn over the image.
#[utoipa::path(get, path = "/v1/jobs/{id}/overlay.png", tag = "jobs", params(("id" = String, Path, description = "Its id")), responses(
    (status = 200, description = "The image", body = Vec<u8>, content_type = "image/png"),
    (status = 404, description = "There is no such job, or no image of it", body = Problem),
))]
pub(crate) async fn job_overlay(State(app): Shared, Path(id): Path<String>) -> Answer<Response> {
    let job = app.jobs.get(&id)?;
    if !job.record.borrow().overlay {
        let message = format!("job {id} has no image");
        let advice = "wait until it is done; jobs that add objects have none";
        return Err(ApiError::plain(StatusCode::NOT_FOUND, message, advice));
    }
    file(&app, job, "overlay.png", "image/png").await
}

/// A file of a job under one of the server's file names.
async fn file(
    app: &Arc<App>,
    job: Arc<Job>,
    name: &'static str,
    content_type: &'static str,
) -> Answer<Response> {
    let read = move |_: &App| {
        let path = job.folder.join(name);
        read_regular(&path, limits::IMAGE).map_err(|e| ApiError::system(&format!("the job's {name}"), e))
    };
    let bytes = app.blocking(read).await?;
    let headers: [(HeaderName, &str); 2] = [(CONTENT_TYPE, content_type), (CACHE_CONTROL, "no-store")];
    Ok((headers, bytes).into_response())
}

/// Server-sent events of a job: one named `job` with the job as JSON now and at every change, the last when it has ended.
#[utoipa::path(get, path = "/v1/jobs/{id}/events", tag = "jobs", params(("id" = String, Path, description = "Its id")), responses(
    (status = 200, description = "The events", body = String, content_type = "text/event-stream"),
    (status = 404, description = "There is no such job", body = Problem),
))]
pub(crate) async fn job_events(
    State(app): Shared,
    Path(id): Path<String>,
) -> Answer<Sse<impl Stream<Item = Result<Event, Infallible>>>> {
    let job = app.jobs.get(&id)?;
    let mut watched = job.record.subscribe();
    // The current state is the first event.
    watched.mark_changed();
    let state = Watched { app, job, watched, is_over: false };
    let events = stream::unfold(state, |mut state| async move {
        let event = state.next().await?;
        Some((Ok(event), state))
    });
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(KEEP_ALIVE)))
}

struct Watched {
    app: Arc<App>,
    job: Arc<Job>,
    watched: watch::Receiver<JobRecord>,
    is_over: bool,
}

impl Watched {
    /// The next change; `None` after the last one, and when the server ends.
    async fn next(&mut self) -> Option<Event> {
        if self.is_over {
            return None;
        }
        loop {
            // The number of jobs before this one can change without a change of this job.
            let changed = tokio::time::timeout(Duration::from_secs(1), self.watched.changed()).await;
            if self.app.jobs.is_ending() {
                return None;
            }
            match changed {
                Ok(Err(_)) => return None,
                Err(_) if self.job.state() != JobState::Queued => continue,
                _ => break,
            }
        }
        let record = self.watched.borrow_and_update().clone();
        self.is_over = record.state.is_final();
        let view = JobView::new(record, self.app.jobs.ahead(&self.job));
        Event::default().event("job").json_data(&view).ok()
    }
}
