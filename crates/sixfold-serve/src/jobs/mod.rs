//! Jobs: requests that are stored in one folder each, processed in order, and kept with their results.
//!
//! `DATA/jobs/ID` holds `job.json` (the state), `request.json` (the request), the uploaded files under the server's names, and
//! later `result.json` and `overlay.png`. A folder is written under another name first and moved into place as a whole; `job.json`
//! is replaced as a whole. A job that was running when the process ended is queued again at the next start; after three such
//! attempts it has failed.

mod handlers;
mod queue;
mod record;
mod work;

pub(crate) use handlers::*;
pub(crate) use queue::Jobs;
#[cfg(feature = "networks")]
pub(crate) use queue::{is_id, new_id};
#[cfg(feature = "networks")]
pub(crate) use record::now;
pub(crate) use record::{Job, JobKind, JobState};
pub(crate) use work::{Stopped, Work};
