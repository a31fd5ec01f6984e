//! Whether the server is running, what it can do, and how many jobs it has.

use axum::Json;
use axum::extract::State;
use serde::Serialize;
use sixfold_grasp::Gripper;
use utoipa::ToSchema;

use crate::app::Shared;
use crate::jobs::JobState;
use crate::methods::MethodInfo;

/// A living server.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct Health {
    /// Always `ok`.
    status: &'static str,
    /// Of the program.
    version: &'static str,
    /// Whether requests need a token.
    token_needed: bool,
    /// Number of jobs that are processed at the same time.
    workers: usize,
    /// Number of waiting jobs.
    queued: usize,
    /// Number of running jobs.
    running: usize,
    /// Maximum pixels of an image.
    max_pixels: u64,
    /// Maximum bytes of a request.
    max_upload: usize,
}

/// Whether the server is running, and its limits. Needs no token.
#[utoipa::path(get, path = "/v1/health", tag = "server", security(()), responses(
    (status = 200, description = "The server is running", body = Health),
))]
pub(crate) async fn health(State(app): Shared) -> Json<Health> {
    let jobs = app.jobs.all();
    let count = |state: JobState| jobs.iter().filter(|job| job.state() == state).count();
    Json(Health {
        status: "ok",
        version: env!("CARGO_PKG_VERSION"),
        token_needed: app.options.token.is_some(),
        workers: app.options.workers.get(),
        queued: count(JobState::Queued),
        running: count(JobState::Running),
        max_pixels: sixfold_io::max_pixels(),
        max_upload: app.options.max_upload,
    })
}

/// The available methods and grippers.
#[derive(Debug, Serialize, ToSchema)]
pub(crate) struct Choices {
    /// Methods for `/v1/find`; the first is the default.
    methods: Vec<MethodInfo>,
    /// Grippers for `/v1/grasps`; the first is the default.
    grippers: Vec<&'static str>,
}

/// The available methods and grippers.
#[utoipa::path(get, path = "/v1/methods", tag = "server", responses(
    (status = 200, description = "The methods and grippers", body = Choices),
))]
pub(crate) async fn methods(State(app): Shared) -> crate::error::Answer<Json<Choices>> {
    app.blocking(|app| {
        Ok(Json(Choices { methods: app.methods.describe(), grippers: Gripper::BUILT_IN.to_vec() }))
    })
    .await
}
