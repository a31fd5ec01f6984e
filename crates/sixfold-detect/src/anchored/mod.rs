//! Faster R-CNN (Ren et al. 2015), Mask R-CNN (He et al. 2017) and RetinaNet (Lin et al. 2017, "Focal loss") on a ResNet
//! with a feature pyramid (Lin et al. 2017), as torchvision has them: its names of tensors, its constants and its
//! order of steps, so that its weights give its detections. The same on EfficientNet-Lite0 instead of the ResNet, to be trained
//! without a graphics processor ([`AnchoredConfig::compact`]).
//!
//! The short way: [`AnchoredNetwork::from_pytorch`], [`AnchoredNetwork::detect`].

mod anchors;
mod boxes;
mod config;
mod faster;
mod file;
mod fpn;
mod heads;
mod load;
mod loss;
mod masks;
mod matching;
mod network;
mod retina;
mod rpn;
mod training;
mod transform;

pub use config::{AnchoredConfig, AnchoredKind, Thresholds};
pub(crate) use file::Wrong;
pub use masks::{MASK_SIDE, MaskProbabilities, PastedMask};
pub use network::{AnchoredDetection, AnchoredNetwork};
pub use training::{AnchoredImage, AnchoredTraining};
