//! Progress on standard error, and a clean stop on interrupt.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use indicatif::{ProgressBar, ProgressStyle};

use crate::screen::{self, Failure, printable};

static INTERRUPTED: AtomicBool = AtomicBool::new(false);
/// Whether the command checks [`INTERRUPTED`], because it has something to finish or to keep.
static INTERRUPT_IS_CHECKED: AtomicBool = AtomicBool::new(false);

/// The first interrupt asks a command that checks for interrupts to stop after its current step. It ends any other command
/// at once, since those write nothing before their end, or only whole files. The second interrupt ends every command.
pub fn catch_interrupts() {
    // Without a handler an interrupt ends the program at once, which loses nothing that is on disk.
    let _ = ctrlc::set_handler(|| {
        let again = INTERRUPTED.swap(true, Ordering::SeqCst);
        if again || !INTERRUPT_IS_CHECKED.load(Ordering::SeqCst) {
            let how = if again { "stopped at once" } else { "nothing was finished" };
            screen::fail(&format!("interrupted; {how}"), Failure::Interrupt);
            std::process::exit(2);
        }
        eprintln!("stopping after this step (interrupt again to stop at once)");
    });
}

/// Set once the user has asked to stop, for jobs that check it themselves.
pub fn interrupted() -> &'static AtomicBool {
    INTERRUPT_IS_CHECKED.store(true, Ordering::SeqCst);
    &INTERRUPTED
}

/// Whether the user has asked to stop, for code that does not stop itself.
pub(crate) fn was_interrupted() -> bool {
    INTERRUPTED.load(Ordering::SeqCst)
}

/// An error once the user has asked to stop; `how` says how to continue.
pub fn check_interrupt(how: &str) -> Result<()> {
    if interrupted().load(Ordering::SeqCst) {
        bail!("interrupted; {how}");
    }
    Ok(())
}

/// A progress bar on a terminal, a line every ten seconds elsewhere.
pub struct Progress {
    bar: ProgressBar,
    plain: Option<(Instant, &'static str)>,
}

impl Progress {
    /// A bar of `total` steps.
    pub fn new(what: &'static str, total: usize) -> Progress {
        let bar = ProgressBar::new(total as u64);
        if let Ok(style) =
            ProgressStyle::with_template("{prefix} {bar:32} {pos}/{len}, {elapsed} of about {duration} {msg}")
        {
            bar.set_style(style);
        }
        bar.set_prefix(what);
        let plain = bar.is_hidden().then(|| (Instant::now(), what));
        Progress { bar, plain }
    }

    /// One step is done.
    pub fn step(&mut self, message: String) {
        self.set(self.bar.position() as usize + 1);
        self.bar.set_message(printable(&message));
    }

    /// Sets the message behind the bar.
    pub fn message(&mut self, message: String) {
        if let Some((last, _)) = &self.plain
            && last.elapsed() < Duration::from_millis(100)
        {
            eprintln!("  {message}");
        }
        self.bar.set_message(printable(&message));
    }

    /// `done` steps are done.
    pub fn set(&mut self, done: usize) {
        self.bar.set_position(done as u64);
        if let Some((last, what)) = &mut self.plain
            && last.elapsed() > Duration::from_secs(10)
        {
            *last = Instant::now();
            eprintln!("{what} {done}/{}", self.bar.length().unwrap_or_default());
        }
    }

    /// Removes the bar.
    pub fn finish(self) {
        self.bar.finish_and_clear();
    }
}

/// A progress bar for a library function, shown from its first report on.
pub struct Bar {
    what: &'static str,
    bar: Mutex<Option<Progress>>,
    stop: Option<&'static AtomicBool>,
}

impl Bar {
    /// For a function that an interrupt need not stop, because it has written nothing yet.
    pub fn new(what: &'static str) -> Bar {
        Bar { what, bar: Mutex::new(None), stop: None }
    }

    /// For a function that an interrupt stops after its current part.
    pub fn stopped_by_interrupts(what: &'static str) -> Bar {
        Bar { stop: Some(interrupted()), ..Bar::new(what) }
    }

    /// Removes the bar.
    pub fn finish(self) {
        if let Ok(Some(bar)) = self.bar.into_inner() {
            bar.finish();
        }
    }
}

impl sixfold_geometry::Progress for Bar {
    fn report(&self, done: usize, total: usize) -> bool {
        if let Ok(mut bar) = self.bar.lock() {
            bar.get_or_insert_with(|| Progress::new(self.what, total)).set(done);
        }
        self.stop.is_none_or(|stop| !stop.load(Ordering::Relaxed))
    }
}

/// Receives the progress of a long run of several activities, and can stop it.
pub trait Watch: Sync {
    /// `done` of `total` parts of an activity are done.
    fn report(&self, activity: &'static str, done: usize, total: usize, message: String);

    /// A note for people.
    fn note(&self, text: &str);

    /// Set once the run is to stop after its current step.
    fn stop(&self) -> &AtomicBool;
}

/// Progress bars on standard error, one after the other; an interrupt stops the run.
#[derive(Default)]
pub struct Terminal {
    bar: Mutex<Option<(&'static str, Progress)>>,
}

impl Terminal {
    /// Removes the bar.
    fn clear(&self) {
        if let Ok(mut shown) = self.bar.lock()
            && let Some((_, bar)) = shown.take()
        {
            bar.finish();
        }
    }
}

impl Watch for Terminal {
    fn report(&self, activity: &'static str, done: usize, total: usize, message: String) {
        let Ok(mut shown) = self.bar.lock() else { return };
        if shown.as_ref().is_none_or(|(before, _)| *before != activity)
            && let Some((_, before)) = shown.replace((activity, Progress::new(activity, total)))
        {
            before.finish();
        }
        if let Some((_, bar)) = &mut *shown {
            bar.set(done);
            if !message.is_empty() {
                bar.message(message);
            }
        }
    }

    fn note(&self, text: &str) {
        self.clear();
        eprintln!("{text}");
    }

    fn stop(&self) -> &AtomicBool {
        interrupted()
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        self.clear();
    }
}
