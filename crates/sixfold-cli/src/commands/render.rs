//! `sixfold render`: renderings of one object as images.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::Args;
use serde_json::json;
use sixfold_geometry::nalgebra::{Matrix4, UnitQuaternion, Vector3};
use sixfold_geometry::{Pose, Vec3};
use sixfold_io::{CameraFile, write_depth, write_mask, write_rgb};
use sixfold_mesh::Unit;
use sixfold_render::{
    BoundingBoxScale, Light, Material, RenderOptions, SceneObject, VisibilityBuffer, portrait_camera,
    portrait_pose, shade,
};

use sixfold_shell::Outcome;
use sixfold_shell::folder::OutputFolder;
use sixfold_shell::output::{JsonArguments, report};
use sixfold_shell::{objects, overlay};

#[derive(Debug, Args)]
pub(crate) struct RenderArguments {
    /// Mesh file or name of a stored object
    #[arg(long, value_name = "NAME_OR_MESH")]
    pub object: String,
    /// Unit of the mesh file: m, cm, mm, in
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<Unit>,
    /// Camera file (default: 640x480, 60 degrees wide)
    #[arg(long, value_name = "FILE")]
    pub camera: Option<PathBuf>,
    /// Pose camera_from_object: tx,ty,tz,rx,ry,rz (metres, rotation vector in radians) or 16 numbers of a 4x4 matrix
    /// row by row (default: fills the image, seen from above)
    #[arg(long, value_name = "NUMBERS", value_delimiter = ',', allow_hyphen_values = true)]
    pub pose: Option<Vec<f64>>,
    /// Folder for the images
    #[arg(long, value_name = "DIR", default_value = "out/render")]
    pub out: PathBuf,
    /// Folder of stored objects
    #[arg(long, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
    #[command(flatten)]
    pub json: JsonArguments,
}

pub(crate) fn run(a: &RenderArguments) -> Result<Outcome> {
    let object = objects::find(&a.object, a.unit, &a.store)?;
    let camera = match &a.camera {
        Some(path) => {
            let file = CameraFile::read(path)?;
            if !file.sized {
                bail!("{}: fields width and height are missing: how large is the image?", path.display());
            }
            file.camera.without_distortion()
        }
        None => portrait_camera(640, 480),
    };
    let pose = match &a.pose {
        None => portrait_pose(&object.mesh, &camera),
        Some(n) if n.len() == 6 => {
            if n.iter().any(|v| !v.is_finite()) {
                bail!("--pose: found {n:?}, expected finite numbers");
            }
            let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(n[3], n[4], n[5]));
            Pose::new(rotation, Vec3::new(n[0], n[1], n[2]))
        }
        Some(n) if n.len() == 16 => Pose::from_matrix(&Matrix4::from_row_slice(n)).context("--pose")?,
        Some(n) => bail!("--pose: found {} numbers, expected 6 or 16", n.len()),
    };
    let objects = [SceneObject { mesh: &object.mesh, camera_from_object: pose }];
    let mut frame = VisibilityBuffer::new(&camera);
    frame.render(&objects, &RenderOptions { parallel: true, ..RenderOptions::default() });
    let (low, high) = object.mesh.bounding_box();
    let scale = BoundingBoxScale::of_corners(&low, &high);
    let mut folder = OutputFolder::take(&a.out)?;
    let files = folder.files(&["depth.png", "mask.png", "normals.png", "coordinates.png", "rgb.png"])?;
    write_depth(&files[0], &frame.depth(), 1e-4)?;
    write_mask(&files[1], &frame.mask(0))?;
    write_rgb(&files[2], &overlay::normal_picture(&frame.normals(&objects)))?;
    let coordinates = frame.normalised_coordinates(&objects, &[scale]);
    write_rgb(&files[3], &overlay::coordinate_picture(&coordinates))?;
    let rgb = shade(&frame, &objects, &Light::default_set(), &Material::default(), None);
    write_rgb(&files[4], &rgb)?;
    let pixels = frame.mask(0).as_slice().iter().filter(|m| **m).count();
    let value = json!({
        "object": object.name,
        "camera_from_object": pose.rows(),
        "pixels": pixels,
        "depth_scale_mm": 0.1,
        "files": files,
    });
    report(&a.json, &value, || {
        println!(
            "{pixels} pixels; depth.png (0.1 mm units), mask.png, normals.png, coordinates.png, rgb.png in {}",
            a.out.display()
        );
    })?;
    Ok(if pixels > 0 { Outcome::Found } else { Outcome::NothingFound })
}
