//! Work without the interpreter lock: panics become `RuntimeError`, Ctrl-C interrupts, file errors become `OSError`.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

use pyo3::exceptions::{PyFileNotFoundError, PyOSError, PyPermissionError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use sixfold::bop::{DatasetError, EvalError, ResultsError};
use sixfold::io::{CameraFileError, ImageFileError};
use sixfold::mesh::MeshFileError;

/// Interval between checks for Ctrl-C.
const LISTEN: Duration = Duration::from_millis(20);

fn internal(payload: &(dyn Any + Send)) -> PyErr {
    let text = payload
        .downcast_ref::<&str>()
        .map(|s| (*s).to_owned())
        .or_else(|| payload.downcast_ref::<String>().cloned())
        .unwrap_or_else(|| "unknown".to_owned());
    PyRuntimeError::new_err(format!("internal error in sixfold, please report it with the input: {text}"))
}

/// Runs short work without the interpreter lock.
pub(crate) fn free<T: Send>(py: Python<'_>, work: impl FnOnce() -> T + Send) -> PyResult<T> {
    py.detach(|| catch_unwind(AssertUnwindSafe(work))).map_err(|payload| internal(payload.as_ref()))
}

/// Payload of the unwinding that ends work from within a callback, when it is asked to stop.
struct Stopped;

/// A request to stop: work calls [`Stop::check`] where it can be left, or reads [`Stop::flag`].
#[derive(Clone)]
pub(crate) struct Stop(Arc<AtomicBool>);

impl Stop {
    /// Ends the work if it was interrupted: unwinds without a message; [`reporting`] catches it.
    pub(crate) fn check(&self) {
        if self.0.load(Ordering::Relaxed) {
            resume_unwind(Box::new(Stopped));
        }
    }

    /// Set when the work is interrupted, for work that then ends by itself.
    pub(crate) fn flag(&self) -> &AtomicBool {
        &self.0
    }
}

/// Runs long work on its own thread, without the interpreter lock, and raises what a signal handler raises meanwhile
/// (`KeyboardInterrupt`). The call then returns at once. Work that checks [`Stop`] ends soon, other work when it is done; its
/// result is discarded.
pub(crate) fn interruptible<T: Send + 'static>(
    py: Python<'_>,
    work: impl FnOnce(&Stop) -> T + Send + 'static,
) -> PyResult<T> {
    reporting(py, Leave::AtOnce, move |stop, _: &Tell<()>| work(stop), |()| Ok(()))
}

/// When an interrupted call returns.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Leave {
    /// At once; work that cannot be stopped halfway ends in the background.
    AtOnce,
    /// When the work has ended, because it writes to disk; at once when interrupted again.
    WhenDone,
}

/// Reports the progress of work.
pub(crate) struct Tell<U>(Box<dyn Fn(U) + Send + Sync>);

impl<U> Tell<U> {
    pub(crate) fn tell(&self, update: U) {
        (self.0)(update);
    }
}

enum Message<T, U> {
    Progress(U),
    Done(std::thread::Result<T>),
}

/// As [`interruptible`], for work that reports its progress: `handle_update` is called with each report while the interpreter lock
/// is held. Its error (an exception in a user's callback) stops the work as Ctrl-C does.
pub(crate) fn reporting<T: Send + 'static, U: Send + 'static>(
    py: Python<'_>,
    leave: Leave,
    work: impl FnOnce(&Stop, &Tell<U>) -> T + Send + 'static,
    mut handle_update: impl FnMut(U) -> PyResult<()>,
) -> PyResult<T> {
    let stop = Stop(Arc::new(AtomicBool::new(false)));
    let (send, mut receive) = channel::<Message<T, U>>();
    let flag = stop.clone();
    std::thread::Builder::new()
        .name("sixfold".to_owned())
        .spawn(move || {
            // If the call has already returned, the receiver is gone: reports and result are discarded.
            let update = send.clone();
            let tell = Tell(Box::new(move |value| drop(update.send(Message::Progress(value)))));
            let result = catch_unwind(AssertUnwindSafe(|| work(&flag, &tell)));
            let _ = send.send(Message::Done(result));
        })
        .map_err(|error| PyOSError::new_err(format!("no thread could be started: {error}")))?;
    // The error that the call raises once the work has ended.
    let mut pending: Option<PyErr> = None;
    loop {
        let answer;
        (answer, receive) = py.detach(move || (receive.recv_timeout(LISTEN), receive));
        let heard = match answer {
            Ok(Message::Done(result)) => {
                return match (pending, result) {
                    (Some(error), _) => Err(error),
                    (None, Ok(value)) => Ok(value),
                    (None, Err(payload)) => Err(internal(payload.as_ref())),
                };
            }
            Ok(Message::Progress(_)) if pending.is_some() => Ok(()),
            Ok(Message::Progress(update)) => handle_update(update),
            Err(RecvTimeoutError::Timeout) => Ok(()),
            Err(RecvTimeoutError::Disconnected) => {
                return Err(PyRuntimeError::new_err(
                    "internal error in sixfold: the work ended without a result",
                ));
            }
        };
        if let Err(error) = heard.and_then(|()| py.check_signals()) {
            stop.0.store(true, Ordering::Relaxed);
            if leave == Leave::AtOnce || pending.is_some() {
                return Err(error);
            }
            pending = Some(error);
        }
    }
}

/// `OSError`, or its matching subclass, with a message that names the file.
pub(crate) fn os_error(kind: std::io::ErrorKind, message: String) -> PyErr {
    match kind {
        std::io::ErrorKind::NotFound => PyFileNotFoundError::new_err(message),
        std::io::ErrorKind::PermissionDenied => PyPermissionError::new_err(message),
        _ => PyOSError::new_err(message),
    }
}

/// The exception for a mesh file that cannot be read or written.
pub(crate) fn mesh_file_error(error: MeshFileError) -> PyErr {
    match &error {
        MeshFileError::Io { source, .. } => os_error(source.kind(), error.to_string()),
        _ => PyValueError::new_err(error.to_string()),
    }
}

/// The exception for a dataset that cannot be read or written.
pub(crate) fn dataset_error(error: DatasetError) -> PyErr {
    match error {
        DatasetError::Read { ref source, .. } | DatasetError::Write { ref source, .. } => {
            os_error(source.kind(), error.to_string())
        }
        DatasetError::Missing { .. } | DatasetError::NoModel { .. } => {
            PyFileNotFoundError::new_err(error.to_string())
        }
        DatasetError::Model(error) => match error.downcast::<MeshFileError>() {
            Ok(error) => mesh_file_error(*error),
            Err(error) => PyValueError::new_err(error.to_string()),
        },
        other => PyValueError::new_err(other.to_string()),
    }
}

/// The exception for an image file that cannot be read or written.
pub(crate) fn image_error(error: ImageFileError) -> PyErr {
    match &error {
        ImageFileError::Read { source, .. } | ImageFileError::Write { source, .. } => {
            os_error(source.kind(), error.to_string())
        }
        _ => PyValueError::new_err(error.to_string()),
    }
}

/// The exception for a camera file that cannot be used.
pub(crate) fn camera_file_error(error: CameraFileError) -> PyErr {
    match &error {
        CameraFileError::Read { source, .. } => os_error(source.kind(), error.to_string()),
        _ => PyValueError::new_err(error.to_string()),
    }
}

/// The exception for a result file that cannot be read or written.
pub(crate) fn results_error(error: ResultsError) -> PyErr {
    match &error {
        ResultsError::Read { source, .. } | ResultsError::Write { source, .. } => {
            os_error(source.kind(), error.to_string())
        }
        _ => PyValueError::new_err(error.to_string()),
    }
}

/// The exception for an evaluation that cannot be done.
pub(crate) fn eval_error(error: EvalError) -> PyErr {
    match error {
        EvalError::Dataset(error) => dataset_error(error),
        other => PyValueError::new_err(other.to_string()),
    }
}
