//! Depth images: points, normals, planes.

use numpy::{PyArray1, PyArray2, PyArray3};
use pyo3::prelude::*;
use sixfold::geometry::{NormalOptions, Plane, PlaneOptions, PointCloud, Vec3};

use crate::arrays::{self, bad, positive, seed, whole};
use crate::camera::PyCamera;
use crate::guard::{free, interruptible};

/// Computes unit normals (H, W, 3) float32 in the camera frame, pointing towards the camera, from depth (H, W) in metres
/// (Hinterstoisser et al. 2012, section 3.3). They are 0 where depth is missing or fewer than six neighbours lie on the same
/// surface.
///
/// radius: half width of the window in pixels (default 3). Values above 64 count as 64.
/// max_relative_step: a neighbour counts if its depth differs by less than this fraction of the depth (default 0.02).
///
/// Raises ValueError if depth and camera differ in size.
///
/// >>> import numpy as np
/// >>> normals_from_depth(np.ones((480, 640), np.float32), Camera(500, 500, 320, 240, 640, 480))[240, 320].round(6)
/// array([ 0.,  0., -1.], dtype=float32)
#[pyfunction]
#[pyo3(signature = (depth, camera, *, radius=None, max_relative_step=None))]
pub(crate) fn normals_from_depth<'py>(
    py: Python<'py>,
    depth: &Bound<'py, PyAny>,
    camera: PyCamera,
    radius: Option<i64>,
    max_relative_step: Option<f64>,
) -> PyResult<Bound<'py, PyArray3<f32>>> {
    let depth = arrays::depth("depth", depth)?;
    let camera = camera.of_image("depth", depth.size())?;
    let mut options = NormalOptions::default();
    if let Some(radius) = radius {
        options.radius = whole("radius", radius, 1)?.min(64);
    }
    if let Some(step) = max_relative_step {
        options.max_relative_step = positive("max_relative_step", step)?;
    }
    let normals = free(py, || sixfold::geometry::normals_from_depth(&depth, &camera, &options))?;
    arrays::from_image_of(py, normals)
}

/// Fills holes in depth (H, W) from their borders, up to 2 * rounds pixels wide.
///
/// >>> import numpy as np
/// >>> inpaint_depth(np.array([[1, 0, 1]], np.float32), 1)
/// array([[1., 1., 1.]], dtype=float32)
#[pyfunction]
#[pyo3(signature = (depth, rounds=2))]
pub(crate) fn inpaint_depth<'py>(
    py: Python<'py>,
    depth: &Bound<'py, PyAny>,
    rounds: i64,
) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let (depth, rounds) = (arrays::depth("depth", depth)?, whole("rounds", rounds, 0)?);
    // More rounds than the longer side of the image has pixels change nothing.
    let rounds = rounds.min(depth.width().max(depth.height()));
    arrays::from_image(py, free(py, || sixfold::geometry::inpaint_depth(&depth, rounds))?)
}

/// Computes the points (N, 3) float64 in the camera frame of a depth image (H, W) in metres, and their normals (N, 3). There is
/// one point per valid pixel; pixels without a normal are left out.
///
/// Raises ValueError if depth and camera differ in size.
///
/// >>> import numpy as np
/// >>> points, normals = point_cloud(np.ones((48, 64), np.float32), Camera(50, 50, 32, 24, 64, 48))
/// >>> points.shape[1], float(points[:, 2].mean())
/// (3, 1.0)
#[pyfunction]
#[allow(clippy::type_complexity)]
pub(crate) fn point_cloud<'py>(
    py: Python<'py>,
    depth: &Bound<'py, PyAny>,
    camera: PyCamera,
) -> PyResult<(Bound<'py, PyArray2<f64>>, Bound<'py, PyArray2<f64>>)> {
    let depth = arrays::depth("depth", depth)?;
    let camera = camera.of_image("depth", depth.size())?;
    let cloud = free(py, || {
        let normals = sixfold::geometry::normals_from_depth(&depth, &camera, &NormalOptions::default());
        PointCloud::from_depth(&depth, Some(&normals), &camera)
    })?;
    Ok((arrays::from_points3(py, &cloud.points)?, arrays::from_points3(py, &cloud.normals)?))
}

/// Downsamples points (N, 3) with normals (N, 3) or None to one point per voxel of edge `size` metres and per group of similar
/// normals in it (Vidal et al. 2018, section 3.1). Returns points and normals, or None without normals.
///
/// max_angle: largest angle between the normals of a group and its first one, radians.
///
/// >>> import numpy as np
/// >>> points, normals = voxel_downsample(np.zeros((10, 3)), 0.01)
/// >>> len(points), normals
/// (1, None)
#[pyfunction]
#[pyo3(signature = (points, size, normals=None, *, max_angle=1.0))]
#[allow(clippy::type_complexity)]
pub(crate) fn voxel_downsample<'py>(
    py: Python<'py>,
    points: &Bound<'py, PyAny>,
    size: f64,
    normals: Option<&Bound<'py, PyAny>>,
    max_angle: f64,
) -> PyResult<(Bound<'py, PyArray2<f64>>, Option<Bound<'py, PyArray2<f64>>>)> {
    let points = arrays::points3("points", points)?;
    let (size, max_angle) = (positive("size", size)?, positive("max_angle", max_angle)?);
    let normals = normals.map(|n| arrays::points3("normals", n)).transpose()?;
    if let Some(n) = &normals
        && n.len() != points.len()
    {
        return Err(bad("normals", format!("{} normals, one per point", points.len()), n.len().to_string()));
    }
    let with_normals = normals.is_some();
    let cloud = PointCloud { points, normals: normals.unwrap_or_default() };
    let thin = free(py, || cloud.voxel_downsample(size, max_angle))?;
    let normals = with_normals.then(|| arrays::from_points3(py, &thin.normals)).transpose()?;
    Ok((arrays::from_points3(py, &thin.points)?, normals))
}

/// A plane: the points p with normal . p = offset, metres.
#[pyclass(name = "Plane", module = "sixfold", frozen)]
pub(crate) struct PyPlane(pub(crate) Plane);

#[pymethods]
impl PyPlane {
    /// Unit normal, (3,) float64.
    #[getter]
    fn normal<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        arrays::from_vector3(py, &self.0.normal)
    }

    /// Signed distance of the plane from the origin along the normal, metres.
    #[getter]
    fn offset(&self) -> f64 {
        self.0.offset
    }

    /// Signed distances (N,) of points (N, 3), metres; positive on the side to which the normal points.
    fn distance<'py>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray1<f64>>> {
        let points = arrays::points3("points", points)?;
        Ok(PyArray1::from_vec(py, points.iter().map(|p| self.0.distance(p)).collect()))
    }

    fn __repr__(&self) -> String {
        let n = &self.0.normal;
        format!("<Plane: normal ({:.4}, {:.4}, {:.4}), offset {:.4} m>", n.x, n.y, n.z, self.0.offset)
    }
}

/// Finds the plane with the most points of (N, 3) by RANSAC (Fischler and Bolles 1981). Its normal points towards the origin.
/// None if no plane has at least `min_fraction` of the points.
///
/// threshold: distance within which a point belongs to the plane, metres. normals (N, 3): if given, they must agree with the
/// plane's within 30 degrees. iterations: number of random samples.
///
/// >>> import numpy as np
/// >>> grid = np.stack(np.meshgrid(np.linspace(-1, 1, 20), np.linspace(-1, 1, 20), [1.0]), -1).reshape(-1, 3)
/// >>> dominant_plane(grid).normal.round(6) + 0
/// array([ 0.,  0., -1.])
#[pyfunction]
#[pyo3(signature = (points, normals=None, *, threshold=0.01, iterations=300, min_fraction=0.15, seed=0))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn dominant_plane(
    py: Python<'_>,
    points: &Bound<'_, PyAny>,
    normals: Option<&Bound<'_, PyAny>>,
    threshold: f64,
    iterations: i64,
    min_fraction: f64,
    seed: i64,
) -> PyResult<Option<PyPlane>> {
    let points = arrays::points3("points", points)?;
    let normals = normals.map(|n| arrays::points3("normals", n)).transpose()?.unwrap_or_default();
    if !normals.is_empty() && normals.len() != points.len() {
        return Err(bad(
            "normals",
            format!("{} normals, one per point", points.len()),
            normals.len().to_string(),
        ));
    }
    let options = PlaneOptions {
        threshold: positive("threshold", threshold)?,
        iterations: whole("iterations", iterations, 1)?,
        min_fraction,
        ..PlaneOptions::default()
    };
    let (cloud, seed) = (PointCloud { points, normals }, self::seed(seed)?);
    let plane = interruptible(py, move |_| sixfold::geometry::dominant_plane(&cloud, &options, seed))?;
    Ok(plane.map(PyPlane))
}

/// Computes the least-squares plane through points (N, 3).
///
/// Raises ValueError for fewer than three points, or points on one line.
///
/// >>> fit_plane([[0, 0, 1], [1, 0, 1], [0, 1, 1]]).distance([[0, 0, 3]])
/// array([2.])
#[pyfunction]
pub(crate) fn fit_plane(py: Python<'_>, points: &Bound<'_, PyAny>) -> PyResult<PyPlane> {
    let points = arrays::points3("points", points)?;
    let plane = free(py, || sixfold::geometry::fit_plane(&points))?;
    let found = format!("{} points that do not determine a plane", points.len());
    plane.map(PyPlane).ok_or_else(|| bad("points", "at least three points that are not on one line", found))
}

/// Computes `count` evenly distributed unit directions (N, 3): a Fibonacci sphere (Gonzalez 2010).
///
/// >>> sphere_directions(100).shape
/// (100, 3)
#[pyfunction]
pub(crate) fn sphere_directions<'py>(py: Python<'py>, count: i64) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let count = whole("count", count, 0)?;
    if count > 1 << 26 {
        return Err(bad("count", "at most 67108864", count.to_string()));
    }
    let directions: Vec<Vec3> = free(py, || sixfold::geometry::sphere_directions(count))?;
    arrays::from_points3(py, &directions)
}
