//! The queue of jobs and its workers: the oldest waiting job first, one at a time for each worker. Trainings take an hour, so they have
//! a worker of their own and the other jobs do not wait for them.

use std::collections::{BTreeMap, HashMap};
use std::panic::AssertUnwindSafe;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use axum::http::StatusCode;
use sixfold_io::{WriteLock, sync_folder_of, write_atomically};

use super::record::{Job, JobKind, JobRecord, JobState, now};
use super::work::{Stopped, Work};
use crate::error::{Answer, ApiError, ServeError};
use crate::options::ServerOptions;

/// A job that was running this many times when the process ended is not tried again.
const MAX_ATTEMPTS: u32 = 3;

/// The function that processes a job and returns the result as JSON.
pub(crate) type Run = dyn Fn(&mut Work<'_>) -> Result<serde_json::Value, Stopped> + Send + Sync;

/// All jobs of a data folder.
pub(crate) struct Jobs {
    folder: PathBuf,
    max_waiting: usize,
    keep: usize,
    timeout: Duration,
    state: Mutex<State>,
    changed: Condvar,
    ends: AtomicBool,
    /// Keeps a second server from writing here.
    _lock: WriteLock,
}

/// Which workers process a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Workers {
    Trainings,
    Others,
}

impl Workers {
    fn of(job: &Job) -> Workers {
        if job.kind() == JobKind::Train { Workers::Trainings } else { Workers::Others }
    }
}

#[derive(Default)]
struct State {
    /// The key contains the id besides the number, because unreadable records have no number.
    by_number: BTreeMap<(u64, String), Arc<Job>>,
    by_id: HashMap<String, Arc<Job>>,
    last_number: u64,
}

impl State {
    fn insert(&mut self, job: Arc<Job>) {
        self.last_number = self.last_number.max(job.number);
        self.by_id.insert(job.id.clone(), job.clone());
        self.by_number.insert((job.number, job.id.clone()), job);
    }

    fn remove(&mut self, job: &Job) {
        self.by_id.remove(&job.id);
        self.by_number.remove(&(job.number, job.id.clone()));
    }

    fn waiting(&self) -> impl Iterator<Item = &Arc<Job>> {
        self.by_number.values().filter(|job| job.state() == JobState::Queued)
    }

    /// The jobs that wait for workers of one kind.
    fn waiting_for(&self, workers: Workers) -> impl Iterator<Item = &Arc<Job>> {
        self.waiting().filter(move |job| Workers::of(job) == workers)
    }
}

impl Jobs {
    /// Opens the jobs in `DATA/jobs`; jobs that were running when a server ended are queued again.
    pub fn open(options: &ServerOptions) -> Result<Jobs, ServeError> {
        let folder = options.data.join("jobs");
        let io = |source| ServeError::Io { path: folder.clone(), source };
        std::fs::create_dir_all(&folder).map_err(io)?;
        let lock = WriteLock::take(&folder)?;
        let mut state = State::default();
        for entry in std::fs::read_dir(&folder).map_err(io)? {
            let path = entry.map_err(io)?.path();
            let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default().to_owned();
            if name.starts_with('.') && path.is_dir() {
                // A request that was being stored when the server ended: its client has not received an answer.
                let _ = std::fs::remove_dir_all(&path);
            } else if is_id(&name) {
                state.insert(Arc::new(found(path, name)));
            }
        }
        Ok(Jobs {
            folder,
            max_waiting: options.max_waiting,
            keep: options.keep,
            timeout: options.job_timeout,
            state: Mutex::new(state),
            changed: Condvar::new(),
            ends: AtomicBool::new(false),
            _lock: lock,
        })
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Stores a job: its request and the uploaded files, under the server's names. It is on the disk when this
    /// returns.
    /// `object`: the one that is trained.
    pub fn add(
        &self,
        (kind, object): (JobKind, Option<&str>),
        request: &[u8],
        files: &[(&str, &[u8])],
    ) -> Answer<Arc<Job>> {
        if self.ends.load(Ordering::SeqCst) {
            return Err(ApiError::plain(
                StatusCode::SERVICE_UNAVAILABLE,
                "the server ends",
                "try again later",
            ));
        }
        self.check_room()?;
        let id = new_id().map_err(|e| ApiError::system("no random numbers", e))?;
        let (staged, place) = (self.folder.join(format!(".{id}.new")), self.folder.join(&id));
        let laid_down = (|| -> std::io::Result<Arc<Job>> {
            std::fs::create_dir(&staged)?;
            for (name, bytes) in files.iter().copied().chain([("request.json", request)]) {
                write_atomically(&staged.join(name), bytes)?;
            }
            let mut state = self.state();
            let new = JobRecord::new(id.clone(), state.last_number + 1, kind);
            let record = JobRecord { object: object.map(str::to_owned), ..new };
            record.write(&staged)?;
            std::fs::rename(&staged, &place)?;
            sync_folder_of(&place)?;
            let job = Arc::new(Job::new(record, place.clone()));
            state.insert(job.clone());
            Ok(job)
        })();
        let job = laid_down.map_err(|e| {
            let _ = std::fs::remove_dir_all(&staged);
            ApiError::system("the job cannot be kept", e)
        })?;
        self.changed.notify_all();
        self.forget_old();
        Ok(job)
    }

    fn check_room(&self) -> Answer<()> {
        let waiting = self.state().waiting().count();
        if waiting < self.max_waiting {
            return Ok(());
        }
        Err(ApiError::plain(
            StatusCode::TOO_MANY_REQUESTS,
            format!("{waiting} jobs wait already, the limit of this server"),
            "try again when some are done",
        ))
    }

    /// Removes the oldest finished jobs above the number that is kept.
    fn forget_old(&self) {
        let finished: Vec<Arc<Job>> =
            self.state().by_number.values().filter(|job| job.state().is_final()).cloned().collect();
        for job in finished.iter().take(finished.len().saturating_sub(self.keep)) {
            self.forget(job);
        }
    }

    fn forget(&self, job: &Job) {
        self.state().remove(job);
        // Rename the folder first, so that an interrupted removal does not leave half a job.
        let gone = self.folder.join(format!(".{}.gone", job.id));
        if std::fs::rename(&job.folder, &gone).is_ok() {
            let _ = std::fs::remove_dir_all(&gone);
        }
    }

    /// Removes a finished job with all its files.
    pub fn remove(&self, id: &str) -> Answer<()> {
        let job = self.get(id)?;
        if !job.state().is_final() {
            let message = format!("job {id} is not finished");
            return Err(ApiError::plain(StatusCode::CONFLICT, message, "cancel it first"));
        }
        self.forget(&job);
        Ok(())
    }

    /// A job by its id, which is only compared with the existing ids.
    pub fn get(&self, id: &str) -> Answer<Arc<Job>> {
        self.state().by_id.get(id).cloned().ok_or_else(|| {
            ApiError::field(
                "id",
                format!("{id:?}, which is not a job"),
                "the id of a job of this server",
                "/v1/jobs lists them; finished jobs are removed when there are many newer ones",
            )
            .with_status(StatusCode::NOT_FOUND)
        })
    }

    /// All jobs, the newest first.
    pub fn all(&self) -> Vec<Arc<Job>> {
        self.state().by_number.values().rev().cloned().collect()
    }

    /// Whether a training of an object waits or runs.
    #[cfg(feature = "networks")]
    pub fn trains(&self, object: &str) -> bool {
        let of_object = |job: &Arc<Job>| {
            let record = job.record.borrow();
            record.object.as_deref() == Some(object) && !record.state.is_final()
        };
        self.state().by_number.values().any(of_object)
    }

    /// Number of jobs ahead of this one, if it waits.
    pub fn ahead(&self, job: &Job) -> Option<usize> {
        let state = self.state();
        (job.state() == JobState::Queued)
            .then(|| state.waiting_for(Workers::of(job)).take_while(|j| j.number < job.number).count())
    }

    /// Cancels a job: immediately if it waits, at its next step if it runs; a finished job does not change.
    pub fn cancel(&self, id: &str) -> Answer<Arc<Job>> {
        let job = self.get(id)?;
        // Holding the lock, so that no worker takes it meanwhile.
        let state = self.state();
        job.cancelled.store(true, Ordering::SeqCst);
        if job.state() == JobState::Queued {
            let changed = job.change(|record| {
                record.state = JobState::Cancelled;
                record.finished = Some(now());
            });
            changed.map_err(|e| ApiError::system("the job's record", e))?;
        }
        drop(state);
        Ok(job)
    }

    /// Starts workers, and one for trainings, which run until [`Jobs::end`].
    pub fn start(self: &Arc<Jobs>, workers: usize, run: Arc<Run>) -> Vec<JoinHandle<()>> {
        let worker = |of: Workers| {
            let (jobs, run) = (self.clone(), run.clone());
            std::thread::spawn(move || {
                while let Some(job) = jobs.next(of) {
                    jobs.work_on(&job, run.as_ref());
                }
            })
        };
        let others = std::iter::repeat_n(Workers::Others, workers);
        others.chain([Workers::Trainings]).map(worker).collect()
    }

    /// Asks the workers to end after their current step.
    pub fn end(&self) {
        self.ends.store(true, Ordering::SeqCst);
        // Holding the lock, so that no worker is between checking and waiting.
        drop(self.state());
        self.changed.notify_all();
    }

    /// Whether [`Jobs::end`] was called.
    pub fn is_ending(&self) -> bool {
        self.ends.load(Ordering::SeqCst)
    }

    /// The next job for workers of this kind, marked as running; `None` when the server ends.
    fn next(&self, workers: Workers) -> Option<Arc<Job>> {
        let mut state = self.state();
        loop {
            if self.ends.load(Ordering::SeqCst) {
                return None;
            }
            let first = state.waiting_for(workers).next().cloned();
            if let Some(job) = first {
                // If the disk is full the job runs nevertheless, and the error is reported with the result.
                let _ = job.change(|record| {
                    record.state = JobState::Running;
                    record.started = Some(now());
                    record.attempts += 1;
                });
                return Some(job);
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn work_on(&self, job: &Job, run: &Run) {
        let mut work = Work {
            job,
            server_ends: &self.ends,
            began: Instant::now(),
            timeout: if Workers::of(job) == Workers::Trainings { Duration::MAX } else { self.timeout },
            has_overlay: false,
        };
        let ended = std::panic::catch_unwind(AssertUnwindSafe(|| run(&mut work)));
        let overlay = work.has_overlay;
        let result = ended.unwrap_or_else(|_| {
            let error = "the job met a fault of the program";
            let advice = "please report it with the files of this job";
            Err(ApiError::plain(StatusCode::INTERNAL_SERVER_ERROR, error, advice).into())
        });
        let result = result.and_then(|value| Ok(keep_result(&job.folder, &value)?));
        let changed = job.change(|record| {
            record.overlay = overlay && result.is_ok();
            record.finished = Some(now());
            match result {
                Ok(()) => record.state = JobState::Done,
                Err(Stopped::Cancelled) => record.state = JobState::Cancelled,
                Err(Stopped::ServerEnds) => {
                    record.state = JobState::Queued;
                    record.attempts = record.attempts.saturating_sub(1);
                    (record.started, record.finished) = (None, None);
                }
                Err(Stopped::Failed(error)) => {
                    record.state = JobState::Failed;
                    record.error_status = Some(error.status.as_u16());
                    record.error = Some(*error.problem);
                }
            }
        });
        // If the record cannot be written, clients get it from memory, and the job runs again after a restart.
        drop(changed);
    }
}

fn keep_result(folder: &Path, value: &serde_json::Value) -> Answer<()> {
    let text = serde_json::to_vec_pretty(value).map_err(|e| ApiError::system("the result", e))?;
    write_atomically(&folder.join("result.json"), &text).map_err(|e| ApiError::system("the result", e))
}

/// A job left by an earlier server.
fn found(folder: PathBuf, id: String) -> Job {
    let record = JobRecord::read(&folder).map_err(|what| format!("job.json: {what}"));
    let record =
        record.and_then(|r| if r.id == id { Ok(r) } else { Err(format!("job.json is of job {}", r.id)) });
    let mut record = match record {
        Ok(record) => record,
        Err(what) => {
            let mut record = JobRecord::new(id, 0, JobKind::Find);
            fail(&mut record, format!("the job's record cannot be read: {what}"), "remove the job");
            return Job::new(record, folder);
        }
    };
    if record.state == JobState::Running {
        record.progress = Default::default();
        if record.attempts >= MAX_ATTEMPTS {
            fail(
                &mut record,
                format!("the server ended {MAX_ATTEMPTS} times while it worked on this job"),
                "read the server's messages; ask for less at once",
            );
        } else {
            (record.state, record.started) = (JobState::Queued, None);
        }
        // If it cannot be written, this is decided again at the next start.
        let _ = record.write(&folder);
    }
    Job::new(record, folder)
}

fn fail(record: &mut JobRecord, error: String, advice: &str) {
    record.state = JobState::Failed;
    record.finished = Some(now());
    let error = ApiError::plain(StatusCode::INTERNAL_SERVER_ERROR, error, advice);
    record.error_status = Some(error.status.as_u16());
    record.error = Some(*error.problem);
}

/// 16 random bytes in hexadecimal.
pub(crate) fn new_id() -> Result<String, getrandom::Error> {
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes)?;
    Ok(bytes.iter().map(|b| format!("{b:02x}")).collect())
}

/// Whether a folder's name is one that [`new_id`] makes.
pub(crate) fn is_id(name: &str) -> bool {
    name.len() == 32 && name.bytes().all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn options(folder: &Path) -> ServerOptions {
        ServerOptions { keep: 3, max_waiting: 4, ..ServerOptions::new(folder.join("o"), folder.join("d")) }
    }

    fn open(folder: &Path) -> Arc<Jobs> {
        Arc::new(Jobs::open(&options(folder)).unwrap())
    }

    fn add(jobs: &Jobs) -> Arc<Job> {
        jobs.add((JobKind::Find, None), b"{}", &[("depth", b"x")]).unwrap()
    }

    fn wait(job: &Job) -> JobRecord {
        let began = Instant::now();
        while !job.state().is_final() {
            assert!(began.elapsed().as_secs() < 10, "{:?}", job.state());
            std::thread::sleep(Duration::from_millis(2));
        }
        job.record.borrow().clone()
    }

    fn end(jobs: Arc<Jobs>, workers: Vec<JoinHandle<()>>) {
        jobs.end();
        workers.into_iter().for_each(|w| w.join().unwrap());
    }

    #[test]
    fn jobs_run_in_order_and_faults_of_one_cost_no_other() {
        let dir = tempfile::tempdir().unwrap();
        let jobs = open(dir.path());
        let all: Vec<_> = (0..3).map(|_| add(&jobs)).collect();
        assert_eq!(jobs.ahead(&all[2]), Some(2));
        let second = all[1].id.clone();
        let run = move |work: &mut Work<'_>| {
            assert!(work.job.id != second, "a fault");
            work.step(1, 2, "half")?;
            Ok(json!({ "number": work.job.number }))
        };
        let workers = jobs.start(1, Arc::new(run));
        let ended: Vec<JobRecord> = all.iter().map(|job| wait(job)).collect();
        assert_eq!(
            ended.iter().map(|r| r.state).collect::<Vec<_>>(),
            [JobState::Done, JobState::Failed, JobState::Done]
        );
        assert_eq!(ended[1].error_status, Some(500));
        assert!(ended[0].started <= ended[1].started && ended[1].started <= ended[2].started);
        let result = std::fs::read_to_string(all[2].folder.join("result.json")).unwrap();
        assert!(result.contains("\"number\": 3"), "{result}");
        end(jobs, workers);
    }

    #[test]
    fn interrupted_jobs_are_queued_again_three_times() {
        let dir = tempfile::tempdir().unwrap();
        let (first, second) = {
            let jobs = open(dir.path());
            let (first, second) = (add(&jobs), add(&jobs));
            // As after a killed process.
            assert_eq!(jobs.next(Workers::Others).unwrap().id, first.id);
            std::fs::create_dir(jobs.folder.join(".0123.new")).unwrap();
            (first.id.clone(), second.id.clone())
        };
        for attempt in 1..=2 {
            let jobs = open(dir.path());
            let job = jobs.get(&first).unwrap();
            assert_eq!((job.state(), job.record.borrow().attempts), (JobState::Queued, attempt));
            assert_eq!(jobs.next(Workers::Others).unwrap().id, first);
            assert!(!jobs.folder.join(".0123.new").exists());
        }
        let jobs = open(dir.path());
        let record = jobs.get(&first).unwrap().record.borrow().clone();
        assert_eq!(record.state, JobState::Failed);
        assert!(record.error.unwrap().error.contains("3 times"));
        let workers = jobs.start(1, Arc::new(|_: &mut Work<'_>| Ok(json!({}))));
        assert_eq!(wait(&jobs.get(&second).unwrap()).state, JobState::Done);
        // Numbers continue after the old ones.
        assert_eq!(add(&jobs).number, 3);
        end(jobs, workers);
    }

    #[test]
    fn a_stopping_server_gives_the_job_back() {
        let dir = tempfile::tempdir().unwrap();
        let jobs = open(dir.path());
        let job = add(&jobs);
        let run = |work: &mut Work<'_>| loop {
            std::thread::sleep(Duration::from_millis(1));
            work.check()?;
        };
        let workers = jobs.start(1, Arc::new(run));
        while job.state() == JobState::Queued {
            std::thread::sleep(Duration::from_millis(1));
        }
        end(jobs, workers);
        let record = JobRecord::read(&job.folder).unwrap();
        assert_eq!((record.state, record.attempts), (JobState::Queued, 0));
    }

    #[test]
    fn cancelled_jobs_end_and_full_queues_refuse() {
        let dir = tempfile::tempdir().unwrap();
        let jobs = open(dir.path());
        let all: Vec<_> = (0..4).map(|_| add(&jobs)).collect();
        let error = jobs.add((JobKind::Find, None), b"{}", &[]).unwrap_err();
        assert_eq!(error.status, StatusCode::TOO_MANY_REQUESTS);
        assert_eq!(jobs.cancel(&all[3].id).unwrap().state(), JobState::Cancelled);
        assert_eq!(jobs.remove(&all[0].id).unwrap_err().status, StatusCode::CONFLICT);
        let run = |work: &mut Work<'_>| loop {
            std::thread::sleep(Duration::from_millis(1));
            work.check()?;
        };
        let workers = jobs.start(1, Arc::new(run));
        for job in &all[..3] {
            jobs.cancel(&job.id).unwrap();
            assert_eq!(wait(job).state, JobState::Cancelled);
        }
        // Three finished jobs are kept: the oldest is removed when another one finishes.
        let last = add(&jobs);
        assert_eq!(jobs.get(&all[0].id).unwrap_err().status, StatusCode::NOT_FOUND);
        assert!(!all[0].folder.exists() && all[1].folder.exists());
        jobs.cancel(&last.id).unwrap();
        wait(&last);
        jobs.remove(&last.id).unwrap();
        assert!(!last.folder.exists());
        end(jobs, workers);
    }

    #[test]
    fn damaged_records_fail_and_foreign_folders_are_left_alone() {
        let dir = tempfile::tempdir().unwrap();
        let id = {
            let jobs = open(dir.path());
            add(&jobs).id.clone()
        };
        let folder = options(dir.path()).data.join("jobs");
        std::fs::write(folder.join(&id).join("job.json"), "{").unwrap();
        std::fs::create_dir(folder.join("mine")).unwrap();
        let jobs = open(dir.path());
        assert_eq!(jobs.all().len(), 1);
        assert_eq!(jobs.get(&id).unwrap().state(), JobState::Failed);
        assert!(folder.join("mine").exists());
        assert!(Jobs::open(&options(dir.path())).is_err());
        for id in ["../jobs", "mine", ""] {
            assert_eq!(jobs.get(id).unwrap_err().status, StatusCode::NOT_FOUND);
        }
    }
}
