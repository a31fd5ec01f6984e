//! Jobs: what was asked for, laid down in a folder each, worked on one after the other, kept with what came of it.
//!
//! `DATA/jobs/ID` holds `job.json` (the state), `request.json` (what was asked), the uploaded files under names of ours, and later
//! `result.json` and `overlay.png`. A folder is written under another name first and moved into place as a whole; `job.json` is
//! replaced as a whole. A job that ran when the process ended waits again when it starts; one that did so three times has failed.

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
