//! Changes of colour that stand for cameras and lamps that the training images do not show.

use sixfold_synth::augment::ColorAugmentation;

/// For finished training images: [`ColorAugmentation::real_images`] with strong contrast more often and of a wider range.
pub fn image_color_augmentation() -> ColorAugmentation {
    ColorAugmentation {
        strong_contrast_probability: 0.4,
        strong_contrast: [0.5, 1.8],
        ..ColorAugmentation::real_images()
    }
}
