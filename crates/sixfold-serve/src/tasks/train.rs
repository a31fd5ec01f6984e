//! The training of a network for one stored object on views made from its photographs, as `sixfold teach NAME --train` does.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use axum::body::Bytes;
use axum::extract::{Path, State};
use axum::http::StatusCode;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use sixfold_pix2pose::own_weights::WEIGHTS_FILE;
use sixfold_shell::object_training::{ObjectTraining, STEPS, VIEW_STEP};
use sixfold_shell::progress::Watch;
use sixfold_teach::photographs_of;
use utoipa::ToSchema;

use super::Request;
use crate::app::{App, Shared};
use crate::error::{Answer, ApiError, Problem};
use crate::jobs::{Accepted, JobView, Stopped, Work};

/// Interval at which a running training checks whether it was cancelled.
const POLL: Duration = Duration::from_millis(200);
/// Largest number of steps, as on the command line.
const MAX_STEPS: usize = 1_000_000;

/// The stored request.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct TrainRequest {
    name: String,
    steps: usize,
    view_step: f64,
    replace: bool,
}

/// The body of `POST /v1/objects/{name}/training`, all of it optional.
#[derive(Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct TrainBody {
    /// Training steps (default: 3000).
    steps: Option<usize>,
    /// Step between synthesized views in azimuth and elevation, degrees, 1 to 90 (default: 10).
    view_step: Option<f64>,
    /// Replace weights that the object has (default: false).
    replace: Option<bool>,
}

impl TrainRequest {
    /// Name of the object.
    pub fn object(&self) -> &str {
        &self.name
    }

    fn of_body(name: String, body: &TrainBody) -> Answer<TrainRequest> {
        let steps = body.steps.unwrap_or(STEPS);
        if !(1..=MAX_STEPS).contains(&steps) {
            let expected = format!("a whole number from 1 to {MAX_STEPS}");
            return Err(ApiError::field("steps", steps.to_string(), expected, "correct the value"));
        }
        let view_step = body.view_step.unwrap_or(VIEW_STEP);
        if !(1.0..=90.0).contains(&view_step) {
            let found = view_step.to_string();
            return Err(ApiError::field("view_step", found, "degrees from 1 to 90", "correct the value"));
        }
        Ok(TrainRequest { name, steps, view_step, replace: body.replace.unwrap_or(false) })
    }
}

/// Trains a network for an object that was taught from photographs, and stores it with the object: a job. Trainings run one after the
/// other, beside all other jobs, and resume after a restart of the server and after they were cancelled.
#[utoipa::path(post, path = "/v1/objects/{name}/training", tag = "objects",
    params(("name" = String, Path, description = "Its name")),
    request_body(content = Option<TrainBody>),
    responses(
        (status = 202, description = "The training waits for those before it", body = JobView),
        (status = 400, description = "Not a valid object name", body = Problem),
        (status = 404, description = "There is no such object", body = Problem),
        (status = 409, description = "The object has weights of its own, or a training of it waits or runs", body = Problem),
        (status = 422, description = "An invalid body, or an object without photographs", body = Problem),
        (status = 429, description = "Too many waiting jobs", body = Problem),
    ))]
pub(crate) async fn train_object(
    State(app): Shared,
    Path(name): Path<String>,
    body: Bytes,
) -> Answer<Accepted> {
    let body: TrainBody =
        if body.is_empty() { TrainBody::default() } else { crate::teachings::from_json(&body)? };
    app.blocking(move |app| {
        let (object, _) = app.methods.object(&name).map_err(|e| ApiError::of_store("name", &e))?;
        let request = TrainRequest::of_body(name, &body)?;
        if photographs_of(&object).is_none() {
            return Err(ApiError::field(
                "name",
                format!("{:?}, which is stored without photographs", object.name),
                "an object that was taught from photographs",
                "teach it from photographs of it",
            ));
        }
        if !request.replace && object.file(WEIGHTS_FILE).is_some_and(|file| file.is_file()) {
            return Err(ApiError::plain(
                StatusCode::CONFLICT,
                format!("object {} has weights of its own already", object.name),
                "send replace=true to replace them",
            ));
        }
        if app.jobs.trains(&object.name) {
            return Err(ApiError::plain(
                StatusCode::CONFLICT,
                format!("a training of object {} waits or runs already", object.name),
                "follow that job, or cancel it first",
            ));
        }
        let job = Request::Train(request).store_job(app, &[])?;
        Ok(Accepted(JobView::of(app, &job)))
    })
    .await
}

/// Reports a training to the clients of its job.
struct JobWatch<'a> {
    work: &'a Work<'a>,
    stop: AtomicBool,
    reason: Mutex<Option<Stopped>>,
}

impl JobWatch<'_> {
    /// Stops the training if this is an error.
    fn heed(&self, result: Result<(), Stopped>) {
        if let Err(reason) = result {
            self.reason.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(reason);
            self.stop.store(true, Ordering::SeqCst);
        }
    }
}

impl Watch for JobWatch<'_> {
    fn report(&self, activity: &'static str, done: usize, total: usize, message: String) {
        let activity = match activity {
            "views" => "making views from the photographs",
            "samples" => "preparing images",
            "steps" => "training",
            other => other,
        };
        let step = if activity == "training" { format!("training, {message}") } else { activity.to_owned() };
        self.heed(self.work.step(done, total, step));
    }

    fn note(&self, _: &str) {}

    fn stop(&self) -> &AtomicBool {
        &self.stop
    }
}

/// Sets a flag when it is dropped, after a panic too.
struct SetAtEnd<'a>(&'a AtomicBool);

impl Drop for SetAtEnd<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::SeqCst);
    }
}

/// Trains, or resumes a training of the same object and options.
pub(super) fn run(app: &App, request: &TrainRequest, work: &mut Work<'_>) -> Result<Value, Stopped> {
    let out = app.options.data.join("trainings").join(&request.name);
    let training = ObjectTraining {
        store: &app.store,
        name: &request.name,
        steps: request.steps,
        view_step: request.view_step,
        replace: request.replace,
        out: &out,
    };
    let watch = JobWatch { work, stop: AtomicBool::new(false), reason: Mutex::new(None) };
    let ended = AtomicBool::new(false);
    let trained = std::thread::scope(|scope| {
        let _ended = SetAtEnd(&ended);
        // Steps are reported seldom; a client who cancels should not wait for the next report.
        scope.spawn(|| {
            while !ended.load(Ordering::SeqCst) && !watch.stop.load(Ordering::SeqCst) {
                watch.heed(work.check());
                std::thread::sleep(POLL);
            }
        });
        training.run(&watch)
    });
    let reason = watch.reason.into_inner().unwrap_or_else(PoisonError::into_inner);
    let trained = match (trained, reason) {
        (Ok(trained), _) => trained,
        (Err(_), Some(reason)) => return Err(reason),
        (Err(error), None) => {
            let text = sixfold_shell::describe(&error);
            let expected = "an object with photographs that show it";
            let advice = "teach it again from photographs from all sides";
            return Err(ApiError::about("name", text, expected, advice).into());
        }
    };
    // The weights are stored; views and checkpoints are no longer needed.
    let _ = std::fs::remove_dir_all(&out);
    Ok(json!({
        "name": request.name,
        "object": format!("/v1/objects/{}", request.name),
        "steps": trained.steps,
        "synthesized": trained.on.synthesized,
        "photographs": trained.on.photographs,
        "seconds": trained.seconds,
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_out_of_range_are_named() {
        let of = |steps, view_step| {
            TrainRequest::of_body("mug".to_owned(), &TrainBody { steps, view_step, replace: None })
        };
        let request = of(None, None).unwrap();
        assert_eq!((request.steps, request.view_step, request.replace), (STEPS, VIEW_STEP, false));
        for (result, field) in [(of(Some(0), None), "steps"), (of(None, Some(0.5)), "view_step")] {
            assert_eq!(result.unwrap_err().problem.field.as_deref(), Some(field));
        }
    }
}
