//! The tasks of jobs. A request is checked when it arrives and is stored; later a worker reads and processes it.

pub(crate) mod find;
pub(crate) mod grasps;
pub(crate) mod object;
#[cfg(feature = "networks")]
pub(crate) mod train;

use std::sync::Arc;

use serde::{Deserialize, Serialize};
use sixfold_io::{limits, read_regular};

use crate::app::App;
use crate::error::{Answer, ApiError};
use crate::jobs::{Job, JobKind, Stopped, Work};

/// `request.json`.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Request {
    Find(find::FindRequest),
    Grasps(grasps::GraspRequest),
    Object(object::ObjectRequest),
    #[cfg(feature = "networks")]
    Teach(crate::teachings::TeachRequest),
    #[cfg(feature = "networks")]
    Train(train::TrainRequest),
}

impl Request {
    /// Stores the request as a job with these files.
    pub fn store_job(&self, app: &App, files: &[(&str, &[u8])]) -> Answer<Arc<Job>> {
        let kind = match self {
            Request::Find(_) => (JobKind::Find, None),
            Request::Grasps(_) => (JobKind::Grasps, None),
            Request::Object(_) => (JobKind::Object, None),
            #[cfg(feature = "networks")]
            Request::Teach(_) => (JobKind::Teach, None),
            #[cfg(feature = "networks")]
            Request::Train(request) => (JobKind::Train, Some(request.object())),
        };
        let bytes = serde_json::to_vec_pretty(self).map_err(|e| ApiError::system("the request", e))?;
        app.jobs.add(kind, &bytes, files)
    }
}

/// Processes a job.
pub(crate) fn run(app: &App, work: &mut Work<'_>) -> Result<serde_json::Value, Stopped> {
    let read = read_regular(&work.folder().join("request.json"), limits::SMALL_TEXT);
    let bytes = read.map_err(|e| ApiError::system("the job's request", e))?;
    let request: Request =
        serde_json::from_slice(&bytes).map_err(|e| ApiError::system("the job's request", e))?;
    work.step(0, 1, "reading the files")?;
    match request {
        Request::Find(request) => find::run(app, &request, work),
        Request::Grasps(request) => grasps::run(&request, work),
        Request::Object(request) => object::run(app, &request, work),
        #[cfg(feature = "networks")]
        Request::Teach(request) => crate::teachings::run(app, &request, work),
        #[cfg(feature = "networks")]
        Request::Train(request) => train::run(app, &request, work),
    }
}
