//! The server behind `sixfold serve`: web pages and an HTTP API under `/v1`, built on the same functions as the command line.
//!
//! One process answers on one address. A request is checked when it arrives, stored as a job in its own folder, and processed by
//! one of a few workers, each with one job at a time. The result stays in the folder until it is removed, even when the process
//! ends. Networks and prepared objects stay in memory, so that the next request for the same object needs no preparation.
//!
//! No path of a request reaches the file system: the server names jobs, the names of objects follow the store's rules, and a
//! client's other names appear only in messages.

#![deny(clippy::print_stdout, clippy::print_stderr)]

mod access;
mod app;
mod error;
mod form;
mod health;
mod images;
mod jobs;
mod meshes;
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
