//! The interface between a running task and the server: the job's folder, progress reports, and requests to
//! stop.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use axum::http::StatusCode;
use sixfold_geometry::RgbImage;

use super::record::{Job, Progress};
use crate::error::ApiError;

/// Why a task ended without a result.
#[derive(Debug)]
pub(crate) enum Stopped {
    /// A client cancelled it.
    Cancelled,
    /// The server ends; the job waits for the next server.
    ServerEnds,
    /// It failed.
    Failed(ApiError),
}

impl From<ApiError> for Stopped {
    fn from(error: ApiError) -> Stopped {
        Stopped::Failed(error)
    }
}

/// A job while it is processed.
pub(crate) struct Work<'a> {
    pub(super) job: &'a Job,
    pub(super) server_ends: &'a AtomicBool,
    pub(super) began: Instant,
    pub(super) timeout: Duration,
    pub(super) has_overlay: bool,
}

impl Work<'_> {
    /// The job's id.
    #[cfg(feature = "networks")]
    pub fn id(&self) -> &str {
        &self.job.id
    }

    /// The job's folder.
    pub fn folder(&self) -> &Path {
        &self.job.folder
    }

    /// Reports progress to clients, and ends the task if it was cancelled or the server ends.
    pub fn step(&self, done: usize, total: usize, step: impl Into<String>) -> Result<(), Stopped> {
        let progress = Progress { done, total, step: step.into() };
        // Only in memory: after a restart the job starts from the beginning.
        self.job.record.send_modify(|record| record.progress = progress);
        self.check()
    }

    /// Ends the task if it was cancelled, the server ends, or it takes too long.
    pub fn check(&self) -> Result<(), Stopped> {
        if self.job.cancelled.load(Ordering::SeqCst) {
            return Err(Stopped::Cancelled);
        }
        if self.server_ends.load(Ordering::SeqCst) {
            return Err(Stopped::ServerEnds);
        }
        if self.began.elapsed() > self.timeout {
            let seconds = self.timeout.as_secs();
            return Err(Stopped::Failed(ApiError::plain(
                StatusCode::UNPROCESSABLE_ENTITY,
                format!("the job took longer than {seconds} s, the limit of this server"),
                "ask for fewer objects at once, or start the server with a larger --job-timeout",
            )));
        }
        Ok(())
    }

    /// Keeps an image of the result.
    pub fn overlay(&mut self, image: &RgbImage) -> Result<(), Stopped> {
        let path = self.job.folder.join("overlay.png");
        sixfold_io::write_rgb(&path, image).map_err(|e| ApiError::system("the overlay", e))?;
        self.has_overlay = true;
        Ok(())
    }
}
