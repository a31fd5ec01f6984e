//! The processor of all networks: this computer's cores with the kernels of this crate, or a GPU through Burn (feature `gpu`).

use std::str::FromStr;
use std::sync::OnceLock;

use burn::backend::DispatchDevice;
use burn::tensor::Device;

/// A kind of processor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Processor {
    /// The cores of this computer.
    #[default]
    Cpu,
    /// The graphics processor that the system prefers, through Vulkan, Metal or DirectX 12.
    Gpu,
}

impl Processor {
    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Processor::Cpu => "cpu",
            Processor::Gpu => "gpu",
        }
    }
}

impl FromStr for Processor {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        [Processor::Cpu, Processor::Gpu]
            .into_iter()
            .find(|p| p.name() == text)
            .ok_or_else(|| format!("expected cpu or gpu, found {text:?}"))
    }
}

/// Why a processor cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ProcessorError {
    /// The program was built without the feature.
    #[error(
        "this program was built without a GPU backend: build it with the feature `gpu`, or use the processor `cpu`"
    )]
    NotBuilt,
    /// No driver offers a GPU.
    #[error(
        "no GPU was found: expected one with a driver for Vulkan, Metal or DirectX 12; use the processor `cpu`"
    )]
    NoGpu,
    /// Networks were already loaded.
    #[error("the processor must be chosen before the first network is loaded")]
    TooLate,
}

static CHOSEN: OnceLock<Device> = OnceLock::new();

/// Chooses the processor of this process. To be called once, before networks are loaded; without it they are on the CPU.
///
/// # Errors
/// [`ProcessorError`] if the processor is not available, or another one is in use.
pub fn choose(processor: Processor) -> Result<(), ProcessorError> {
    let device = match processor {
        Processor::Cpu => Device::flex(),
        Processor::Gpu => gpu()?,
    };
    if *CHOSEN.get_or_init(|| device.clone()) == device { Ok(()) } else { Err(ProcessorError::TooLate) }
}

/// The device of new networks and their inputs.
pub fn chosen() -> Device {
    CHOSEN.get_or_init(Device::flex).clone()
}

#[cfg(not(feature = "gpu"))]
fn gpu() -> Result<Device, ProcessorError> {
    Err(ProcessorError::NotBuilt)
}

#[cfg(feature = "gpu")]
fn gpu() -> Result<Device, ProcessorError> {
    use burn::tensor::{DeviceKind, DeviceType};
    if Device::enumerate(DeviceType::Wgpu).is_empty() {
        return Err(ProcessorError::NoGpu);
    }
    Ok(Device::wgpu(DeviceKind::DefaultDevice))
}

/// Whether this crate's kernels run on a device; elsewhere [`crate::portable`] computes the same.
pub(crate) fn has_kernels(device: &Device) -> bool {
    matches!(device.clone().inner().as_dispatch(), DispatchDevice::Flex(_))
}
