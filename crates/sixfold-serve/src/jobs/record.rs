//! One job: its state on disk and in memory, and notification of changes.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};
use sixfold_io::write_atomically;
use tokio::sync::watch;
use utoipa::ToSchema;

use crate::error::Problem;

/// The only version of `job.json`.
const VERSION: u32 = 1;

/// What a job does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub(crate) enum JobKind {
    /// Finds objects in an image.
    Find,
    /// Proposes grasps.
    Grasps,
    /// Adds an object to the store.
    Object,
    /// Teaches an object from photographs, or stores a taught one.
    Teach,
    /// Trains a network for a stored object.
    Train,
}

/// Progress of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub(crate) enum JobState {
    /// It waits for a worker.
    Queued,
    /// A worker processes it.
    Running,
    /// There is a result.
    Done,
    /// There is an error.
    Failed,
    /// A client cancelled it.
    Cancelled,
}

impl JobState {
    /// Whether it has ended.
    pub fn is_final(self) -> bool {
        !matches!(self, JobState::Queued | JobState::Running)
    }
}

/// The steps of a running job.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub(crate) struct Progress {
    /// Finished steps.
    pub done: usize,
    /// Total number of steps.
    pub total: usize,
    /// The current step.
    pub step: String,
}

/// `job.json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct JobRecord {
    pub version: u32,
    pub id: String,
    /// Jobs are processed in the order of this number.
    pub number: u64,
    pub kind: JobKind,
    /// The object that is trained.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub object: Option<String>,
    pub state: JobState,
    pub progress: Progress,
    /// Times in seconds since 1970.
    pub created: f64,
    pub started: Option<f64>,
    pub finished: Option<f64>,
    /// How many times a worker has started it.
    pub attempts: u32,
    /// Whether there is an image of the result.
    pub overlay: bool,
    pub error: Option<Problem>,
    /// The HTTP status of the error, if it is an error of the request.
    pub error_status: Option<u16>,
}

impl JobRecord {
    pub fn new(id: String, number: u64, kind: JobKind) -> JobRecord {
        JobRecord {
            version: VERSION,
            id,
            number,
            kind,
            object: None,
            state: JobState::Queued,
            progress: Progress::default(),
            created: now(),
            started: None,
            finished: None,
            attempts: 0,
            overlay: false,
            error: None,
            error_status: None,
        }
    }

    /// Reads the record in a job's folder; the error describes what is wrong with it.
    pub fn read(folder: &Path) -> Result<JobRecord, String> {
        let path = folder.join("job.json");
        let text = sixfold_io::read_regular_text(&path, sixfold_io::limits::SMALL_TEXT);
        let text = text.map_err(|e| e.to_string())?;
        let record: JobRecord = serde_json::from_str(&text).map_err(|e| e.to_string())?;
        if record.version != VERSION {
            return Err(format!("field version: found {}, expected {VERSION}", record.version));
        }
        Ok(record)
    }

    /// Replaces the record in a job's folder.
    pub fn write(&self, folder: &Path) -> std::io::Result<()> {
        let text = serde_json::to_vec_pretty(self).map_err(std::io::Error::other)?;
        write_atomically(&folder.join("job.json"), &text)
    }
}

/// Seconds since 1970, to the millisecond.
pub(crate) fn now() -> f64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    since.as_millis() as f64 / 1000.0
}

/// A job in memory.
#[derive(Debug)]
pub(crate) struct Job {
    pub id: String,
    pub number: u64,
    pub folder: PathBuf,
    /// Set once a client has asked to stop.
    pub cancelled: AtomicBool,
    /// The record; watchers are notified of every change.
    pub record: watch::Sender<JobRecord>,
}

impl Job {
    pub fn new(record: JobRecord, folder: PathBuf) -> Job {
        Job {
            id: record.id.clone(),
            number: record.number,
            folder,
            cancelled: AtomicBool::new(false),
            record: watch::Sender::new(record),
        }
    }

    pub fn kind(&self) -> JobKind {
        self.record.borrow().kind
    }

    pub fn state(&self) -> JobState {
        self.record.borrow().state
    }

    /// Changes the record, in memory and on disk. Clients are notified after it was written to disk.
    pub fn change(&self, change: impl FnOnce(&mut JobRecord)) -> std::io::Result<()> {
        let mut record = self.record.borrow().clone();
        change(&mut record);
        let written = record.write(&self.folder);
        self.record.send_replace(record);
        written
    }
}
