//! The real server on a free port of this machine, driven over HTTP.

mod access;
mod bad_input;
mod clients;
mod find;
mod objects;
mod restart;
mod support;
#[cfg(feature = "networks")]
mod teach;
#[cfg(feature = "networks")]
mod teach_without_board;
#[cfg(feature = "networks")]
mod train;
