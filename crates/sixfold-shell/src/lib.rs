//! What the programs `sixfold` and `sixfold-experiments` share: exit status and errors, output and progress, images, and the
//! arguments, stores and scenes that both take.

#[cfg(feature = "networks")]
pub mod detector;
pub mod folder;
pub mod frames;
pub mod grasp;
pub mod meshes;
pub mod objects;
pub mod output;
pub mod overlay;
pub mod progress;
pub mod ranges;
#[cfg(feature = "physics")]
pub mod scenes;
#[cfg(feature = "networks")]
pub mod training;

use std::num::NonZeroUsize;
use std::process::ExitCode;

/// What a command that went through tells the shell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// Exit status 0.
    Found,
    /// Exit status 1: everything worked, but there was nothing.
    NothingFound,
    /// Exit status 2, after the reasons were already printed: part of a batch was skipped.
    Incomplete,
}

/// The exit status of a command; the reason of an error goes to standard error.
pub fn exit_code(result: &anyhow::Result<Outcome>) -> ExitCode {
    match result {
        Ok(Outcome::Found) => ExitCode::SUCCESS,
        Ok(Outcome::NothingFound) => ExitCode::from(1),
        Ok(Outcome::Incomplete) => ExitCode::from(2),
        Err(error) => {
            eprintln!("error: {}", describe(error));
            ExitCode::from(2)
        }
    }
}

/// The whole chain of causes in one line, without repeating a cause that its parent already prints.
pub fn describe(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain() {
        let part = cause.to_string();
        if !text.contains(&part) {
            if !text.is_empty() {
                text.push_str(": ");
            }
            text.push_str(&part);
        }
    }
    text
}

/// Ends the program when nobody reads its output any more (`sixfold ... | head`), as the signal would end one in C, rather
/// than with a message of a panic. What a command has to keep it writes to files.
pub fn end_with_the_reader() {
    let usual = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        let message = panic.payload().downcast_ref::<String>();
        if message.is_some_and(|m| m.starts_with("failed printing to") && m.contains("Broken pipe")) {
            // 128 and the number of SIGPIPE.
            std::process::exit(141);
        }
        usual(panic);
    }));
}

/// The largest image that either program reads.
#[derive(Debug, clap::Args)]
pub struct PixelLimit {
    /// Read images of at most this many pixels (default: 100000000)
    #[arg(long, global = true, value_name = "N")]
    pub max_pixels: Option<std::num::NonZeroU64>,
}

impl PixelLimit {
    /// Sets it for this process.
    pub fn set(&self) {
        if let Some(pixels) = self.max_pixels {
            sixfold_io::set_max_pixels(pixels.get());
        }
    }
}

/// Uses so many threads for everything, or all cores.
pub fn use_threads(threads: Option<NonZeroUsize>) {
    if let Some(threads) = threads {
        // Fails only when a pool exists already, and none does.
        let _ = rayon::ThreadPoolBuilder::new().num_threads(threads.get()).build_global();
    }
}
