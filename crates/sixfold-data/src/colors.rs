//! Colour augmentation that imitates cameras and lamps missing from the training images.

use sixfold_synth::augment::ColorAugmentation;

/// For finished training images: [`ColorAugmentation::real_images`] with strong contrast more often and over a wider
/// range.
pub fn image_color_augmentation() -> ColorAugmentation {
    ColorAugmentation {
        strong_contrast_probability: 0.4,
        strong_contrast: [0.5, 1.8],
        ..ColorAugmentation::real_images()
    }
}
