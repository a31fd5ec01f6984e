//! The program `sixfold`: a thin shell over the libraries.
//!
//! Exit status: 0 found, 1 nothing found, 2 error.

// All output goes through `sixfold_shell::screen`, whose macros replace the standard ones.
#[macro_use]
extern crate sixfold_shell;

mod arguments;
mod commands;
mod idle;

use std::process::ExitCode;

use clap::CommandFactory;
use sixfold_shell::screen::parse;
use sixfold_shell::{exit_code, progress};

use crate::arguments::{Arguments, Command};

fn main() -> ExitCode {
    let arguments = match parse::<Arguments>(idle::IDLE) {
        Ok(arguments) => arguments,
        Err(code) => return code,
    };
    progress::catch_interrupts();
    arguments.images.set();
    arguments.meshes.apply();
    exit_code(&arguments.processor.prepare().and_then(|()| match &arguments.command {
        Command::Demo(a) => commands::demo::run(a),
        Command::Estimate(a) => commands::estimate::run(a),
        Command::Detect(a) => commands::detect::run(a),
        Command::Eval(a) => commands::eval::run(a),
        Command::Grasp(a) => commands::grasp::run(a),
        Command::Render(a) => commands::render::run(a),
        Command::Synthesize(a) => commands::synthesize::run(a),
        Command::SimulateDepth(a) => commands::simulate::run(a),
        #[cfg(feature = "physics")]
        Command::SimulateScenes(a) => commands::simulate_scenes::run(a),
        Command::Import(a) => commands::import::run(a),
        Command::Train(a) => commands::train::run(a),
        Command::Reproduce(_) => commands::experiments::run(),
        Command::Object(a) => commands::object::run(a),
        Command::Board(a) => commands::board::run(a),
        Command::Calibrate(a) => commands::calibrate::run(a),
        Command::Teach(a) => commands::teach::run(a),
        Command::Serve(a) => commands::serve::run(a),
        Command::Completions(a) => commands::completions::run(a, Arguments::command()),
    }))
}
