//! The program `sixfold`: a thin shell over the libraries.
//!
//! Exit status: 0 found, 1 nothing found, 2 error.

mod arguments;
mod commands;
mod objects;
mod output;
mod overlay;
mod progress;

use std::process::ExitCode;

use clap::Parser;

use crate::arguments::{Arguments, Command, Method};

/// What a command that went through tells the shell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Outcome {
    /// Exit status 0.
    Found,
    /// Exit status 1: everything worked, but there was nothing.
    NothingFound,
    /// Exit status 2, after the reasons were already printed: part of a batch was skipped.
    Incomplete,
}

/// Ends the program when nobody reads its output any more (`sixfold ... | head`), as the signal would end one in C, rather
/// than with a message of a panic. What a command has to keep it writes to files.
fn end_with_the_reader() {
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

fn main() -> ExitCode {
    end_with_the_reader();
    let arguments = Arguments::parse();
    progress::catch_interrupts();
    if let Some(threads) = arguments.threads {
        // Fails only when a pool exists already, and none does.
        let _ = rayon::ThreadPoolBuilder::new().num_threads(threads.get()).build_global();
    }
    let result = match &arguments.command {
        Command::Demo(a) => commands::demo::run(a),
        Command::Estimate(a) if a.dataset.is_some() => commands::estimate_dataset::run(a),
        Command::Estimate(a) if a.method == Method::Pix2pose => commands::estimate_rgb::run(a),
        Command::Estimate(a) if a.method == Method::Mttm => commands::mttm::run(a),
        Command::Estimate(a) => commands::estimate::run(a),
        Command::Detect(a) => commands::detect::run(a),
        Command::Eval(a) => commands::eval::run(a),
        Command::Grasp(a) => commands::grasp::run(a),
        Command::Render(a) => commands::render::run(a),
        Command::Synthesize(a) => commands::synthesize::run(a),
        Command::SimulateDepth(a) => commands::simulate::run(a),
        #[cfg(feature = "physics")]
        Command::SimulateScenes(a) => commands::simulate_scenes::run(a),
        Command::Train(a) => commands::train::run(a),
        Command::Reproduce(a) => commands::reproduce::run(a),
        Command::Object(a) => commands::object::run(a),
        Command::Completions(a) => commands::completions::run(a),
    };
    match result {
        Ok(Outcome::Found) => ExitCode::SUCCESS,
        Ok(Outcome::NothingFound) => ExitCode::from(1),
        Ok(Outcome::Incomplete) => ExitCode::from(2),
        Err(error) => {
            eprintln!("error: {}", describe(&error));
            ExitCode::from(2)
        }
    }
}

/// The whole chain of causes in one line, without repeating a cause that its parent already prints.
pub(crate) fn describe(error: &anyhow::Error) -> String {
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
