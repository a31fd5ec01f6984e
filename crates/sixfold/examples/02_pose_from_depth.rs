//! Example 2: the pose of a known object in a real depth image, without training:
//! `cargo run --release -p sixfold --example 02_pose_from_depth`.

use sixfold::bop::Models;
use sixfold::mesh::ModelInfo;
use sixfold::prelude::*;
use sixfold::runner::{ImageRun, pose_table};

const DEMO: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../data/demo");
/// The watering can.
const OBJECT: u32 = 5;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let dataset = BopDataset::open(DEMO.as_ref(), "test")?;
    let scene = dataset.scene(2)?;
    let camera = scene.camera(3)?;
    let depth = scene.depth(3)?.ok_or("the frame has no depth")?;

    // Only this line depends on the method.
    let method: &dyn PoseEstimator = &PpfEstimator::default();

    // The image is prepared once for all objects: holes, normals, table plane, cloud.
    let prepared = PreparedDepth::new(&depth, &camera, &method.depth_options())?;
    let query = Query { depth: Some(&prepared), ..Query::new(&camera) };
    let run = ImageRun { estimator: method, query };

    let mesh = dataset.model(OBJECT, Models::Rendering)?;
    let info = ModelInfo::of_mesh(&mesh);
    let found = run.find(&Object::of_mesh("can", mesh, info))?;
    print!("{}", pose_table(&run.report(&[found])));

    let truth = scene.image(3)?.ground_truth.iter().find(|g| g.obj_id == OBJECT).ok_or("no ground truth")?;
    println!("ground truth: {:.4?}", truth.camera_from_object.translation().as_slice());
    Ok(())
}
