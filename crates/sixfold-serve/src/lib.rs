//! The server behind `sixfold serve`: web pages and an HTTP API under `/v1`, on the same functions as the command line.
//!
//! One process answers on one address. A request is checked as it arrives, laid down as a job in a folder of its own, and worked on
//! by one of a few workers, one job at a time each; what came of it stays there until it is removed, also when the process ends.
//! Networks and prepared objects stay in memory, so that the next request for the same object costs its work alone.
//!
//! No path of a request reaches the file system: jobs are named by the server, objects by the store's rule for names, and what is
//! called something by a client is that in messages only.

#![deny(clippy::print_stdout, clippy::print_stderr)]

mod access;
mod app;
mod error;
mod form;
mod health;
mod images;
mod jobs;
mod methods;
mod objects;
mod openapi;
mod options;
mod pages;
mod server;
mod tasks;
#[cfg(feature = "networks")]
mod teachings;

pub use error::ServeError;
pub use options::{ServerOptions, check_address};
pub use server::Server;
