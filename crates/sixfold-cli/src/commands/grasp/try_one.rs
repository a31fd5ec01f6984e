//! `sixfold grasp try`: one grasp in the physics engine.

use std::path::PathBuf;

use anyhow::{Context, Result, anyhow, bail};
use clap::Args;
use serde::Serialize;
use sixfold_geometry::{Pose, Vec3};
use sixfold_grasp::{gripper_pose, read_tried_grasp};
use sixfold_mesh::Unit;
use sixfold_simulation::{
    ConvexParts, Outcome as Trial, PartsOptions, TrialReport, settle_at_centre, try_grasp,
};

use sixfold_shell::Outcome;
use sixfold_shell::grasp::trial::{PhysicsArguments, physics};
use sixfold_shell::objects;
use sixfold_shell::output::{JsonArguments, report};

#[derive(Debug, Args)]
pub(crate) struct TryArguments {
    /// Mesh file, or the name of a stored object
    #[arg(long, value_name = "NAME_OR_MESH")]
    pub object: String,
    /// Unit of the mesh file: m, cm, mm, in
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<Unit>,
    /// Point midway between the finger tips when they close, metres
    #[arg(
        long,
        value_name = "X,Y,Z",
        value_delimiter = ',',
        allow_hyphen_values = true,
        required_unless_present = "grasp"
    )]
    pub tip: Option<Vec<f64>>,
    /// Approach direction
    #[arg(
        long,
        value_name = "X,Y,Z",
        value_delimiter = ',',
        allow_hyphen_values = true,
        default_value = "0,0,-1"
    )]
    pub approach: Vec<f64>,
    /// Closing direction
    #[arg(
        long,
        value_name = "X,Y,Z",
        value_delimiter = ',',
        allow_hyphen_values = true,
        default_value = "1,0,0"
    )]
    pub closing: Vec<f64>,
    /// Distance of the pads before they close, metres (default: the gripper's maximum)
    #[arg(long, value_name = "M")]
    pub opening: Option<f64>,
    /// A trial of `sixfold grasp measure` in place of --tip: JSON with world_from_object, world_from_gripper, opening
    #[arg(long, value_name = "FILE", conflicts_with_all = ["tip", "opening"])]
    pub grasp: Option<PathBuf>,
    #[command(flatten)]
    pub physics: PhysicsArguments,
    /// Folder of stored objects
    #[arg(long, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
    #[command(flatten)]
    pub json: JsonArguments,
}

pub(super) fn run(a: &TryArguments) -> Result<Outcome> {
    let (gripper, options) = physics(&a.physics)?;
    let object = objects::find(&a.object, a.unit, &a.store)?;
    let parts =
        ConvexParts::of_mesh(&object.mesh, &PartsOptions::default()).with_context(|| a.object.clone())?;
    let (world_from_object, world_from_gripper, opening) = match &a.grasp {
        Some(path) => {
            let tried = read_tried_grasp(path)?;
            (tried.world_from_object, tried.world_from_gripper, tried.opening)
        }
        None => {
            let rest = settle_at_centre(&object.mesh, &parts, &Pose::identity())
                .ok_or_else(|| anyhow!("{}: the object does not come to rest on the table", a.object))?;
            let tip = a.tip.as_deref().ok_or_else(|| anyhow!("--tip X,Y,Z is missing"))?;
            let pose = gripper_pose(
                &three("--tip", tip)?,
                &three("--approach", &a.approach)?,
                &three("--closing", &a.closing)?,
            )
            .ok_or_else(|| {
                anyhow!(
                    "--approach and --closing: found {:?} and {:?}, expected two different directions",
                    a.approach,
                    a.closing
                )
            })?;
            (rest, pose, a.opening.unwrap_or(gripper.max_opening))
        }
    };
    let result = try_grasp(&parts, &world_from_object, &gripper, &world_from_gripper, opening, &options)?;
    let whole = Whole {
        object: object.name.clone(),
        gripper: gripper.name.clone(),
        world_from_object: world_from_object.rows(),
        world_from_gripper: world_from_gripper.rows(),
        opening,
        report: result,
    };
    report(&a.json, &whole, || {
        println!("{}: {}", whole.object, result.outcome);
        println!(
            "gap {:.1} mm, raised {:.1} mm, slid {:.1} mm and rotated {:.1} degrees in the gripper, pushed \
             {:.1} mm before the lift",
            1e3 * result.gap,
            1e3 * result.raised,
            1e3 * result.slip,
            result.turn.to_degrees(),
            1e3 * result.pushed
        );
    })?;
    Ok(if result.outcome == Trial::Held { Outcome::Found } else { Outcome::NothingFound })
}

#[derive(Serialize)]
struct Whole {
    object: String,
    gripper: String,
    world_from_object: [[f64; 4]; 4],
    world_from_gripper: [[f64; 4]; 4],
    opening: f64,
    report: TrialReport,
}

fn three(option: &str, numbers: &[f64]) -> Result<Vec3> {
    match numbers {
        [x, y, z] if numbers.iter().all(|v| v.is_finite()) => Ok(Vec3::new(*x, *y, *z)),
        _ => bail!("{option}: found {numbers:?}, expected three finite numbers"),
    }
}
