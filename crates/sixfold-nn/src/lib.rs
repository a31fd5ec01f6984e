//! Backbones, fast convolutions, weight files and the training loop on Burn.
