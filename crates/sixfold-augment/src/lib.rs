//! Image augmentation, occluders, procedural backgrounds and textures.
