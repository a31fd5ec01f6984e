//! The options for the processor of a command: threads, and a GPU for networks.

use std::num::NonZeroUsize;

use crate::ranges::threads;

/// The processor of a command.
#[derive(Debug, clap::Args)]
pub struct ProcessorArguments {
    /// Use this many threads (default: all cores); the results are the same for any number
    #[arg(long, global = true, value_name = "N", value_parser = threads)]
    pub threads: Option<NonZeroUsize>,
    /// Processor of networks: cpu, or gpu in a build with the feature gpu, where results differ by rounding
    #[cfg(feature = "networks")]
    #[arg(long, global = true, value_name = "PROCESSOR", default_value = "cpu")]
    pub device: sixfold_nn::device::Processor,
}

impl ProcessorArguments {
    /// Uses it for everything in this process.
    ///
    /// # Errors
    /// If there is no such processor.
    pub fn prepare(&self) -> anyhow::Result<()> {
        #[cfg(feature = "gpu")]
        burn_starts_on_the_cpu();
        if let Some(threads) = self.threads {
            // Fails only when a pool exists already, and none does.
            let _ = rayon::ThreadPoolBuilder::new().num_threads(threads.get()).build_global();
        }
        #[cfg(feature = "networks")]
        sixfold_nn::device::choose(self.device)
            .map_err(|error| anyhow::anyhow!("--device {}: {error}", self.device.name()))?;
        Ok(())
    }
}

/// Burn creates some tensors, such as the restored state of an optimiser, on its default device before it moves them. In a build with
/// a GPU backend that is the GPU, even where there is none; this makes it the CPU.
#[cfg(feature = "gpu")]
fn burn_starts_on_the_cpu() {
    // SAFETY: called at the start of the program; its only other thread waits for a signal and reads no environment.
    #[allow(unsafe_code)]
    unsafe {
        std::env::set_var("BURN_DEVICE", "flex");
    }
}
