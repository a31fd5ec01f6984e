//! `sixfold serve`: runs the server of `sixfold-serve` until it is interrupted.

#[cfg(feature = "serve")]
pub(crate) use built_in::{AFTER_HELP, ServeArguments, run};
#[cfg(not(feature = "serve"))]
pub(crate) use left_out::{AFTER_HELP, ServeArguments, run};

/// Whether the command is built in. Otherwise it prints a message, and help does not list it.
pub(crate) const IS_BUILT_IN: bool = cfg!(feature = "serve");

#[cfg(feature = "serve")]
mod built_in {
    use std::net::IpAddr;
    use std::num::NonZeroUsize;
    use std::path::PathBuf;
    use std::time::Duration;

    use anyhow::Result;
    use clap::Args;
    use sixfold_serve::{Server, ServerOptions};
    use sixfold_shell::Outcome;
    use sixfold_shell::progress::interrupted;
    use sixfold_shell::ranges::{count, duration};

    pub(crate) const AFTER_HELP: &str = "Examples:\n  \
        sixfold serve --store objects\n  \
        SIXFOLD_TOKEN=$(openssl rand -hex 16) sixfold serve --host 0.0.0.0 --port 8640\n\n\
        The pages are at the printed address, the API below it under /v1 (docs/serve.md). The connection is not encrypted.";

    #[derive(Debug, Args)]
    pub(crate) struct ServeArguments {
        /// Address to listen on; other addresses than 127.0.0.1 need --token
        #[arg(long, value_name = "IP", default_value = "127.0.0.1")]
        pub host: IpAddr,
        /// Port to listen on; 0 takes any free one
        #[arg(long, value_name = "N", default_value = "8640")]
        pub port: u16,
        /// Token that clients must send, 16 characters or more (better in SIXFOLD_TOKEN: other users see a command's arguments)
        #[arg(long, value_name = "TOKEN", env = "SIXFOLD_TOKEN", hide_env_values = true)]
        pub token: Option<String>,
        /// Folder of stored objects
        #[arg(
            long,
            alias = "objects",
            value_name = "DIR",
            env = "SIXFOLD_STORE",
            default_value = "sixfold-objects"
        )]
        pub store: PathBuf,
        /// Folder of jobs, with their uploaded files and results
        #[arg(long, value_name = "DIR", default_value = "sixfold-data")]
        pub data: PathBuf,
        /// Number of jobs that run at the same time, besides one training; each uses all --threads
        #[arg(long, value_name = "N", default_value = "1", value_parser = count::<64>)]
        pub workers: NonZeroUsize,
        /// Trained model that `sixfold train pix2pose` wrote, for the method pix2pose (default: only the weights that objects have of
        /// their own)
        #[arg(long, value_name = "FILE.safetensors")]
        pub pix2pose: Option<PathBuf>,
        /// Maximum size of a request, megabytes
        #[arg(long, value_name = "MB", default_value = "100", value_parser = count::<4096>)]
        pub max_upload: NonZeroUsize,
        /// Maximum number of waiting jobs
        #[arg(long, value_name = "N", default_value = "100", value_parser = count::<100_000>)]
        pub max_waiting: NonZeroUsize,
        /// Number of finished jobs that are kept
        #[arg(long, value_name = "N", default_value = "500", value_parser = count::<1_000_000>)]
        pub keep: NonZeroUsize,
        /// Stop a job after this time
        #[arg(long, value_name = "TIME", default_value = "1800s", value_parser = duration)]
        pub job_timeout: Duration,
    }

    pub(crate) fn run(a: &ServeArguments) -> Result<Outcome> {
        let options = ServerOptions {
            host: a.host,
            port: a.port,
            token: a.token.clone(),
            workers: a.workers,
            pix2pose: a.pix2pose.clone(),
            max_upload: a.max_upload.get() << 20,
            max_waiting: a.max_waiting.get(),
            keep: a.keep.get(),
            job_timeout: a.job_timeout,
            ..ServerOptions::new(&a.store, &a.data)
        };
        let stop = interrupted();
        let server = Server::start(options)?;
        let with_token = if a.token.is_some() { ", with its token" } else { "" };
        println!("http://{}{with_token}; stop with Ctrl-C", server.address());
        server.run_until(stop);
        Ok(Outcome::Found)
    }
}

#[cfg(not(feature = "serve"))]
mod left_out {
    use std::ffi::OsString;

    use anyhow::{Result, bail};
    use clap::Args;
    use sixfold_shell::Outcome;

    /// Empty, because the command is not built in.
    pub(crate) const AFTER_HELP: &str = "";

    /// Whatever is asked, the answer is the same.
    #[derive(Debug, Args)]
    #[command(disable_help_flag = true)]
    pub(crate) struct ServeArguments {
        #[arg(num_args = 0.., trailing_var_arg = true, allow_hyphen_values = true)]
        _arguments: Vec<OsString>,
    }

    pub(crate) fn run(_: &ServeArguments) -> Result<Outcome> {
        bail!(
            "this program was built without the feature serve: cargo install --locked --path crates/sixfold-cli --features serve"
        )
    }
}
