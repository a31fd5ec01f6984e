//! The Python package `sixfold`: numpy arrays in, poses out. Each file of this crate exposes one part of the library to Python;
//! nothing is computed here.
//!
//! Three rules apply to every function: arguments are checked, and a `ValueError` names the invalid one; the interpreter lock is
//! released while the library works; no panic reaches Python (`guard.rs`).

// PyO3 passes arguments by value, and a Python function has as many as it needs.
#![allow(clippy::needless_pass_by_value)]

mod align;
mod arrays;
mod bop;
mod camera;
mod coco;
mod dataset_run;
mod detector;
mod dgcm_net;
mod estimator;
mod experience;
mod experienced;
mod grasp;
mod gripper;
mod guard;
mod mesh;
mod methods;
mod metrics;
mod mttm;
mod photograph;
mod photographs;
mod pix2pose;
mod ppf;
mod recipes;
mod render;
mod scene;
mod scene_writer;
mod synthetic;
mod training;
mod trial;

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

pyo3::create_exception!(
    sixfold,
    NoSolutionError,
    PyValueError,
    "The input is valid but has no solution: no pose agrees with enough correspondences, or too few points have one."
);

/// The compiled part of the package `sixfold`.
#[pymodule]
fn _sixfold(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("NoSolutionError", py.get_type::<NoSolutionError>())?;
    module.add_class::<camera::PyCamera>()?;
    module.add_class::<mesh::PyMesh>()?;
    module.add_class::<render::Rendering>()?;
    module.add_class::<render::SceneRendering>()?;
    module.add_class::<render::AmbientLight>()?;
    module.add_class::<render::DirectionalLight>()?;
    module.add_class::<render::PointLight>()?;
    module.add_class::<align::PnpResult>()?;
    module.add_class::<align::IcpResult>()?;
    module.add_class::<scene::PyPlane>()?;
    module.add_class::<estimator::PyEstimator>()?;
    module.add_class::<estimator::PyPoseEstimate>()?;
    module.add_class::<ppf::PpfModel>()?;
    module.add_class::<ppf::PpfScene>()?;
    module.add_class::<ppf::PpfEstimate>()?;
    module.add_class::<mttm::PyTemplates>()?;
    module.add_class::<mttm::Mttm>()?;
    module.add_class::<mttm::MttmEstimate>()?;
    module.add_class::<gripper::PyGripper>()?;
    module.add_class::<grasp::PyGrasp>()?;
    module.add_class::<trial::PySolid>()?;
    module.add_class::<trial::GraspTrial>()?;
    module.add_class::<dgcm_net::DgcmNet>()?;
    module.add_class::<experience::ExperienceStore>()?;
    module.add_class::<experienced::PyExperience>()?;
    module.add_class::<detector::Detector>()?;
    module.add_class::<detector::PyViewsDetector>()?;
    module.add_class::<detector::DetectedObject>()?;
    module.add_class::<photograph::PyPhotograph>()?;
    module.add_class::<photographs::RefinedPoses>()?;
    module.add_class::<photographs::SynthesizedView>()?;
    module.add_class::<pix2pose::Pix2Pose>()?;
    module.add_class::<pix2pose::Pix2PosePose>()?;
    module.add_function(wrap_pyfunction!(mesh::_mesh_of, module)?)?;
    module.add_function(wrap_pyfunction!(mesh::find_symmetries, module)?)?;
    module.add_function(wrap_pyfunction!(camera::undistort_rgb, module)?)?;
    module.add_function(wrap_pyfunction!(camera::undistort_depth, module)?)?;
    module.add_function(wrap_pyfunction!(camera::pose_exp, module)?)?;
    module.add_function(wrap_pyfunction!(camera::pose_log, module)?)?;
    module.add_function(wrap_pyfunction!(render::render, module)?)?;
    module.add_function(wrap_pyfunction!(render::render_scene, module)?)?;
    module.add_function(wrap_pyfunction!(render::render_depth, module)?)?;
    module.add_function(wrap_pyfunction!(render::simulate_depth, module)?)?;
    module.add_function(wrap_pyfunction!(render::support_plane, module)?)?;
    module.add_function(wrap_pyfunction!(align::pnp_ransac, module)?)?;
    module.add_function(wrap_pyfunction!(align::epnp, module)?)?;
    module.add_function(wrap_pyfunction!(align::refine_pose, module)?)?;
    module.add_function(wrap_pyfunction!(align::kabsch, module)?)?;
    module.add_function(wrap_pyfunction!(align::umeyama, module)?)?;
    module.add_function(wrap_pyfunction!(align::icp, module)?)?;
    module.add_function(wrap_pyfunction!(align::icp_to_depth, module)?)?;
    module.add_function(wrap_pyfunction!(scene::normals_from_depth, module)?)?;
    module.add_function(wrap_pyfunction!(scene::inpaint_depth, module)?)?;
    module.add_function(wrap_pyfunction!(scene::point_cloud, module)?)?;
    module.add_function(wrap_pyfunction!(scene::voxel_downsample, module)?)?;
    module.add_function(wrap_pyfunction!(scene::dominant_plane, module)?)?;
    module.add_function(wrap_pyfunction!(scene::fit_plane, module)?)?;
    module.add_function(wrap_pyfunction!(scene::sphere_directions, module)?)?;
    module.add_function(wrap_pyfunction!(ppf::estimate_ppf, module)?)?;
    module.add_function(wrap_pyfunction!(photographs::refine_poses, module)?)?;
    module.add_function(wrap_pyfunction!(photographs::synthesize, module)?)?;
    module.add_function(wrap_pyfunction!(recipes::train_pix2pose, module)?)?;
    module.add_function(wrap_pyfunction!(recipes::train_detector, module)?)?;
    module.add_function(wrap_pyfunction!(recipes::train_dgcm, module)?)?;
    module.add_function(wrap_pyfunction!(recipes::train_mttm, module)?)?;
    module.add_function(wrap_pyfunction!(recipes::train_nol, module)?)?;
    module.add_function(wrap_pyfunction!(recipes::train_views, module)?)?;
    module.add_function(wrap_pyfunction!(recipes::train_refiner, module)?)?;
    module.add_function(wrap_pyfunction!(recipes::train_proposals, module)?)?;
    module.add_function(wrap_pyfunction!(mttm::estimate_mttm, module)?)?;
    module.add_function(wrap_pyfunction!(synthetic::synthetic_mesh, module)?)?;
    module.add_function(wrap_pyfunction!(synthetic::drop_objects, module)?)?;
    module.add_function(wrap_pyfunction!(trial::gripper_pose, module)?)?;
    module.add_function(wrap_pyfunction!(trial::try_grasp, module)?)?;
    module.add_function(wrap_pyfunction!(grasp::find_objects, module)?)?;
    module.add_function(wrap_pyfunction!(grasp::propose_grasps, module)?)?;
    module.add_function(wrap_pyfunction!(grasp::draw_grasps, module)?)?;
    for (name, register) in [
        ("metrics", metrics::register as fn(&Bound<'_, PyModule>) -> PyResult<()>),
        ("bop", bop::register),
        ("coco", coco::register),
    ] {
        let part = PyModule::new(py, name)?;
        register(&part)?;
        module.add_submodule(&part)?;
    }
    Ok(())
}
