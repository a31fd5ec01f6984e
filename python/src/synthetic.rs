//! `synthetic_mesh`, `drop_objects`: synthetic objects (`sixfold-synth`), and scenes of objects dropped on a table
//! (`sixfold-simulation`).

use numpy::PyArray2;
use pyo3::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sixfold::simulation::{ConvexParts, PileOptions};
use sixfold::synth::shapes::{Family, member, toy};

use crate::arrays::{self, about, bad};
use crate::guard::{free, interruptible};
use crate::mesh::PyMesh;
use crate::trial::{PySolid, simulation_error};

/// Generates a synthetic object, a Mesh in metres. kind: a household family ("can", "mug", "cup", "bottle", "bowl", "box", "clamp"
/// or "drill"), or "toy", which belongs to no family. Each seed gives a different object.
///
/// Raises ValueError for another kind.
///
/// >>> 0.05 < synthetic_mesh("mug", seed=3).diameter < 0.4
/// True
#[pyfunction]
#[pyo3(signature = (kind="toy", *, seed=0))]
pub(crate) fn synthetic_mesh(py: Python<'_>, kind: &str, seed: i64) -> PyResult<PyMesh> {
    let mut random = ChaCha8Rng::seed_from_u64(arrays::seed(seed)?);
    let family = Family::ALL.into_iter().find(|family| family.name() == kind);
    if family.is_none() && kind != "toy" {
        let expected = Family::ALL.map(Family::name).join(", ");
        return Err(bad("kind", format!("{expected} or toy"), format!("{kind:?}")));
    }
    let mesh = free(py, || match family {
        Some(family) => member(family, &mut random).map(|member| member.mesh),
        None => toy(&mut random),
    })?;
    Ok(PyMesh::with_info(mesh.map_err(about("kind"))?, None))
}

/// Drops objects on a table in a physics simulation. Returns the pose of each at rest, world_from_object (4, 4) in metres, z up,
/// the table top at z = 0; None for an object that rolls away or does not come to rest.
///
/// solids: a list of Solids, which may contain the same one several times. radius: radius of the disc around the origin over which
/// objects are dropped, metres; reach: objects further than this from the origin are removed, metres. upright: fraction of the
/// objects that start with their z axis up; the others start in any orientation. stacked: fraction of those others that are dropped
/// at any place; all other objects are put at a free place, if one is found. The same arguments give the same result on every
/// machine. Ctrl-C interrupts it.
///
/// Raises ValueError for options out of range.
///
/// >>> can = Solid(synthetic_mesh("can"), convex=True)
/// >>> [pose.shape for pose in drop_objects([can, can], stacked=0) if pose is not None]
/// [(4, 4), (4, 4)]
#[pyfunction]
#[pyo3(signature = (solids, *, radius=0.18, reach=0.31, upright=0.5, stacked=0.4, seed=0))]
pub(crate) fn drop_objects<'py>(
    py: Python<'py>,
    solids: Vec<Bound<'py, PyAny>>,
    radius: f64,
    reach: f64,
    upright: f64,
    stacked: f64,
    seed: i64,
) -> PyResult<Vec<Option<Bound<'py, PyArray2<f64>>>>> {
    let options = PileOptions { radius, reach, upright, stacked };
    options.check().map_err(simulation_error)?;
    let seed = arrays::seed(seed)?;
    let parts = solids
        .iter()
        .map(|solid| match solid.cast::<PySolid>() {
            Ok(solid) => Ok(solid.get().parts()),
            Err(_) => Err(bad("solids", "a list of Solids", solid.get_type().to_string())),
        })
        .collect::<PyResult<Vec<_>>>()?;
    let poses = interruptible(py, move |_| {
        let parts: Vec<&ConvexParts> = parts.iter().map(AsRef::as_ref).collect();
        sixfold::simulation::drop_objects(&parts, &options, seed, 0)
    })?;
    poses.iter().map(|pose| pose.as_ref().map(|pose| arrays::from_pose(py, pose)).transpose()).collect()
}
