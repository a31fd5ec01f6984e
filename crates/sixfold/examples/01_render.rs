//! Example 1: render a depth image and a colour image from a mesh, a camera and a pose:
//! `cargo run -p sixfold --example 01_render -- FOLDER`.

use std::path::PathBuf;

use sixfold::io::{write_depth, write_rgb};
use sixfold::prelude::*;
use sixfold::render::{Light, Material, RenderOptions, SceneObject, VisibilityBuffer, shade};
use sixfold::synth::primitives::mug;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = std::env::args().nth(1).map_or_else(std::env::temp_dir, PathBuf::from);
    let camera = Camera::new(600.0, 600.0, 159.5, 119.5, 320, 240)?;
    let mesh = mug(0.04, 0.10, 0.004, 0.03)?;

    // A pose takes points of the object's frame to the camera's: x right, y down, z forward, metres.
    let tilted = Pose::exp(&[0.0, 0.0, 0.0, 2.0, 0.3, 0.4].into());
    let camera_from_object = tilted.with_translation(Vec3::new(0.0, 0.02, 0.5));

    // One pass over the triangles; depth, masks, normals and colours are read from the frame.
    let objects = [SceneObject { mesh: &mesh, camera_from_object }];
    let mut frame = VisibilityBuffer::new(&camera);
    frame.render(&objects, &RenderOptions::default());
    let colour = shade(&frame, &objects, &Light::default_set(), &Material::default(), None);
    println!("{} pixels show the mug", frame.mask(0).as_slice().iter().filter(|inside| **inside).count());

    write_depth(&folder.join("mug-depth.png"), &frame.depth(), 0.001)?;
    write_rgb(&folder.join("mug-rgb.png"), &colour)?;
    println!("mug-depth.png and mug-rgb.png are in {}", folder.display());
    Ok(())
}
