//! Teachings: objects that are taught from photographs, on the board or without one, one folder each, with the functions of `sixfold teach`.
//!
//! `DATA/teachings/ID` holds `record.json` (the server's part) and the files of [`sixfold_teach::Teaching`]. Readers take a
//! [`Snapshot`]; one job or one correction at a time changes the folder. A job that was stopped resumes at its last step.

mod corrections;
mod form;
mod handlers;
mod photographs;
mod scale;
mod task;
mod views;

pub(crate) use corrections::*;
pub(crate) use handlers::*;
pub(crate) use photographs::*;
pub(crate) use task::{TeachRequest, run};

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, TryLockError};

use axum::http::StatusCode;
use serde::{Deserialize, Serialize};
use sixfold_io::{sync_folder_of, write_atomically};
use sixfold_teach::{SalientSegmenter, Snapshot, TeachError, TeachOptions, Teaching};

use crate::app::App;
use crate::error::{Answer, ApiError, Problem, ServeError};
use crate::jobs::{Job, is_id, new_id};
use crate::objects::SymmetryView;
use crate::options::ServerOptions;
use views::MeshFacts;

/// The only version of `record.json`.
const VERSION: u32 = 1;
/// Maximum number of teachings that are kept.
const MAX_TEACHINGS: usize = 1000;

/// `record.json`: the server's data of a teaching besides its folder.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Record {
    version: u32,
    name: String,
    hull_only: bool,
    replace: bool,
    /// Seconds since 1970.
    created: f64,
    /// The last job of this teaching.
    job: Option<String>,
    /// Why the last job failed.
    problem: Option<Problem>,
    mesh: Option<MeshFacts>,
    symmetries: Vec<SymmetryView>,
    /// The object that was last stored from it.
    object: Option<String>,
    /// Whether the stored object corresponds to the current mesh.
    accepted: bool,
}

/// A teaching.
pub(crate) struct Entry {
    pub id: String,
    pub folder: PathBuf,
    record: Mutex<Record>,
    /// Locked while the folder is changed.
    changing: Mutex<()>,
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Entry {
    fn record(&self) -> Record {
        locked(&self.record).clone()
    }

    /// Changes the record, in memory and on disk.
    fn note(&self, change: impl FnOnce(&mut Record)) -> Answer<()> {
        let mut record = locked(&self.record);
        change(&mut record);
        write_record(&self.folder, &record)
    }

    /// The state after the last step, also while a job works on it.
    pub fn snapshot(&self) -> Answer<Snapshot> {
        Snapshot::read(&self.folder).map_err(|e| of_teach(&e))
    }

    /// The waiting or running job of this teaching.
    fn active(&self, app: &App) -> Option<Arc<Job>> {
        self.last_job(app).filter(|job| !job.state().is_final())
    }

    fn last_job(&self, app: &App) -> Option<Arc<Job>> {
        locked(&self.record).job.as_deref().and_then(|id| app.jobs.get(id).ok())
    }

    /// The lock for changes, unless a job waits or runs.
    fn free(&self, app: &App) -> Answer<MutexGuard<'_, ()>> {
        let busy = || {
            let advice = "wait for its job, or cancel that first";
            ApiError::plain(StatusCode::CONFLICT, "a job works on this teaching", advice)
        };
        let held = match self.changing.try_lock() {
            Ok(held) => held,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return Err(busy()),
        };
        if self.active(app).is_some() { Err(busy()) } else { Ok(held) }
    }

    /// Changes the folder, unless a job waits or runs. The accepted object then no longer corresponds to the folder.
    fn change<T>(&self, app: &App, change: impl FnOnce(&mut Teaching) -> Answer<T>) -> Answer<T> {
        let _held = self.free(app)?;
        let mut teaching =
            Teaching::open(&self.folder, &TeachOptions::default()).map_err(|e| of_teach(&e))?;
        let changed = change(&mut teaching)?;
        self.note(|record| (record.accepted, record.problem) = (false, None))?;
        Ok(changed)
    }

    /// Adds a job for it.
    fn start(&self, app: &App, request: TeachRequest) -> Answer<Arc<Job>> {
        let _held = self.free(app)?;
        let job = crate::tasks::Request::Teach(request).store_job(app, &[])?;
        self.note(|record| (record.job, record.problem) = (Some(job.id.clone()), None))?;
        Ok(job)
    }
}

fn write_record(folder: &Path, record: &Record) -> Answer<()> {
    let text = serde_json::to_vec_pretty(record).map_err(|e| ApiError::system("the teaching's record", e))?;
    write_atomically(&folder.join("record.json"), &text)
        .map_err(|e| ApiError::system("the teaching's record", e))
}

/// All teachings of a data folder.
pub(crate) struct Teachings {
    folder: PathBuf,
    all: Mutex<BTreeMap<String, Arc<Entry>>>,
    /// Built when the first teaching needs it.
    segmenter: Mutex<Option<Arc<SalientSegmenter>>>,
}

impl Teachings {
    /// Opens the teachings in `DATA/teachings`. Folders without a readable record are ignored.
    pub fn open(options: &ServerOptions) -> Result<Teachings, ServeError> {
        let folder = options.data.join("teachings");
        let io = |source| ServeError::Io { path: folder.clone(), source };
        std::fs::create_dir_all(&folder).map_err(io)?;
        let mut all = BTreeMap::new();
        for entry in std::fs::read_dir(&folder).map_err(io)? {
            let path = entry.map_err(io)?.path();
            let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default().to_owned();
            let hidden = name.strip_prefix('.').and_then(|n| n.split_once('.')).map(|(id, _)| id);
            if hidden.is_some_and(is_id) && path.is_dir() {
                // One that was being stored or removed when the server ended.
                let _ = std::fs::remove_dir_all(&path);
            } else if is_id(&name)
                && let Some(record) = read_record(&path)
            {
                all.insert(name.clone(), Arc::new(Entry::new(name, path, record)));
            }
        }
        Ok(Teachings { folder, all: Mutex::new(all), segmenter: Mutex::new(None) })
    }

    /// A teaching by its id, which is only compared with the existing ids.
    pub fn get(&self, id: &str) -> Answer<Arc<Entry>> {
        locked(&self.all).get(id).cloned().ok_or_else(|| {
            ApiError::field(
                "id",
                format!("{id:?}, which is not a teaching"),
                "the id of a teaching of this server",
                "/v1/teachings lists them",
            )
            .with_status(StatusCode::NOT_FOUND)
        })
    }

    /// All, the newest first.
    pub fn all(&self) -> Vec<Arc<Entry>> {
        let mut all: Vec<Arc<Entry>> = locked(&self.all).values().cloned().collect();
        all.sort_by(|a, b| locked(&b.record).created.total_cmp(&locked(&a.record).created));
        all
    }

    /// Stores a new teaching: `fill` puts the photographs into its folder. It is stored as a whole or not at all.
    fn add(&self, record: Record, fill: impl FnOnce(&Path) -> Answer<()>) -> Answer<Arc<Entry>> {
        if locked(&self.all).len() >= MAX_TEACHINGS {
            let message = format!("there are {MAX_TEACHINGS} teachings, the limit");
            return Err(ApiError::plain(
                StatusCode::TOO_MANY_REQUESTS,
                message,
                "remove those that are done",
            ));
        }
        let id = new_id().map_err(|e| ApiError::system("no random numbers", e))?;
        let (staged, place) = (self.folder.join(format!(".{id}.new")), self.folder.join(&id));
        let laid_down = (|| {
            let io = |e: std::io::Error| ApiError::system("the teaching cannot be kept", e);
            std::fs::create_dir(&staged).map_err(io)?;
            fill(&staged)?;
            write_record(&staged, &record)?;
            std::fs::rename(&staged, &place).map_err(io)?;
            sync_folder_of(&place).map_err(io)
        })();
        if let Err(error) = laid_down {
            let _ = std::fs::remove_dir_all(&staged);
            return Err(error);
        }
        let entry = Arc::new(Entry::new(id.clone(), place, record));
        locked(&self.all).insert(id, entry.clone());
        Ok(entry)
    }

    /// Removes one with all its photographs.
    fn remove(&self, app: &App, id: &str) -> Answer<()> {
        let entry = self.get(id)?;
        let _held = entry.free(app)?;
        locked(&self.all).remove(id);
        // Rename the folder first, so that an interrupted removal does not leave half a teaching.
        let gone = self.folder.join(format!(".{id}.gone"));
        std::fs::rename(&entry.folder, &gone).map_err(|e| ApiError::system("the teaching", e))?;
        let _ = std::fs::remove_dir_all(&gone);
        Ok(())
    }

    fn segmenter(&self) -> Answer<Arc<SalientSegmenter>> {
        let mut kept = locked(&self.segmenter);
        if let Some(segmenter) = &*kept {
            return Ok(segmenter.clone());
        }
        let built = SalientSegmenter::shipped().map_err(|e| ApiError::system("the network for masks", e))?;
        Ok(kept.insert(Arc::new(built)).clone())
    }
}

impl Entry {
    fn new(id: String, folder: PathBuf, record: Record) -> Entry {
        Entry { id, folder, record: Mutex::new(record), changing: Mutex::new(()) }
    }
}

fn read_record(folder: &Path) -> Option<Record> {
    let text = sixfold_io::read_regular_text(&folder.join("record.json"), sixfold_io::limits::SMALL_TEXT);
    let record: Record = serde_json::from_str(&text.ok()?).ok()?;
    (record.version == VERSION).then_some(record)
}

/// The library's messages name the options of `sixfold teach`: here the fields of a request.
fn in_fields(field: &str, error: &TeachError, expected: &str, advice: &str) -> ApiError {
    const OPTIONS: [(&str, &str); 6] = [
        ("--no-board", "without_board"),
        ("--depth-scale", "depth_scale"),
        ("--length", "length"),
        ("--ends", "ends"),
        ("--camera", "camera"),
        ("--mesh", "mesh"),
    ];
    let text = OPTIONS.iter().fold(error.to_string(), |text, (option, field)| text.replace(option, field));
    ApiError::about(field, text, expected, advice)
}

/// An error of the library as an answer to the client, without paths of this machine.
pub(crate) fn of_teach(error: &TeachError) -> ApiError {
    let photographs = |expected: &str, advice: &str| in_fields("photographs", error, expected, advice);
    let sides = "photographs of one object from all sides, on the printed board or with without_board=true";
    let marks = "each end of the length marked in two or more photographs, from different sides";
    let last = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    match error {
        TeachError::Image(error) => ApiError::of_image("photographs", error),
        TeachError::Store(error) => ApiError::of_store("name", error),
        TeachError::NoPhotograph { index, photographs } => ApiError::field(
            "number",
            index.to_string(),
            format!("the number of one of {photographs} photographs, from 0"),
            "inspect the teaching",
        )
        .with_status(StatusCode::NOT_FOUND),
        TeachError::MaskSize { .. } => ApiError::about(
            "mask",
            error,
            "a PNG of the photograph's size, or of that of its image",
            "draw it on the photograph's image.jpg",
        ),
        TeachError::Pairs { .. } => ApiError::about(
            "pairs",
            error,
            "three points or more, in metres on the board, each with its pixel",
            "mark other points",
        ),
        TeachError::TooFewPhotographs { .. } => photographs(
            "8 to 40 photographs",
            "add photographs, or take in those that are left out by correcting pose or mask",
        ),
        TeachError::Camera { .. } | TeachError::CameraSize { .. } => photographs(
            "photographs of one camera",
            "add sharp photographs from all sides that show the board, or send the file field camera",
        ),
        TeachError::NoBoard { .. } => photographs(
            sides,
            "print `sixfold board`, lay the object on it and photograph both; the tags have to be sharp. Or send without_board=true, \
             where the surroundings have texture",
        ),
        TeachError::NoPhotographs => photographs(sides, "add photographs"),
        TeachError::NotTogether { .. } | TeachError::Sfm(_) => photographs(
            "photographs of one object on a ground with texture that stays in place, in steps of at most 20 degrees around it",
            "add photographs between the others, or take them again on a newspaper or a patterned cloth",
        ),
        TeachError::NoScale => scale::no_scale(),
        TeachError::FewDepths { .. } => in_fields(
            "depth",
            error,
            "depth images from the viewpoints of the photographs",
            "check depth_scale, or send length and ends",
        ),
        TeachError::OneDepth(_) | TeachError::NoTable { .. } => in_fields(
            "depth",
            error,
            "the depth image of one object that stands alone on a table",
            "mark the object with a mask, or add photographs from other sides",
        ),
        TeachError::NoCamera { .. } => in_fields(
            "camera",
            error,
            "the camera of a single photograph with depth",
            "send the file field camera, or add photographs from other sides",
        ),
        TeachError::Ends { .. } => {
            in_fields("ends", error, marks, "correct the marks, or mark the ends in more photographs")
        }
        TeachError::MeshSize { .. } | TeachError::MeshDoesNotFit { .. } => in_fields(
            "mesh",
            error,
            "a mesh of the photographed object, with its unit",
            "send another mesh or unit, or remove_mesh=true to make one from the photographs",
        ),
        TeachError::OneSide { .. } => photographs(sides, "add photographs from the other sides"),
        TeachError::NoObject { .. }
        | TeachError::SeveralObjects { .. }
        | TeachError::Contradicting { .. } => {
            photographs(sides, "correct masks, leave photographs out, or take others")
        }
        TeachError::Order { .. } => {
            ApiError::plain(StatusCode::CONFLICT, error.to_string(), "run the teaching")
        }
        TeachError::File { path, what } => {
            let text = format!("{}: {what}", last(path));
            ApiError::about("photographs", text, "photographs of one camera", "leave it out or replace it")
        }
        TeachError::Io { path, source } => {
            ApiError::system(&format!("the teaching's file {}", last(path)), source)
        }
        other => ApiError::system("teaching", other),
    }
}
