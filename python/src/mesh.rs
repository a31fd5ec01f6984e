//! `Mesh`: a checked triangle mesh in metres, with the symmetries of its object.

use std::path::PathBuf;
use std::sync::{Arc, OnceLock};

use numpy::{PyArray1, PyArray2, PyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use sixfold::bop::ModelPoints;
use sixfold::geometry::{Pose, Vec3};
use sixfold::mesh::{
    ContinuousSymmetry, FoundSymmetry, Mesh, MeshOptions, ModelInfo, PlyFormat, SymmetryOptions, Unit,
    UnitError,
};

use crate::arrays::{self, about, bad, positive, seed, whole};
use crate::guard::{free, interruptible, mesh_file_error};

/// A triangle mesh in its object's frame, in metres; without faces, a point cloud. It cannot be changed.
///
/// vertices (N, 3) metres; faces (F, 3) vertex indices, counter-clockwise seen from outside; normals (N, 3) unit; colors (N, 3)
/// uint8; texcoords (N, 2), v up, with texture (H, W, 3) uint8. symmetries (S, 4, 4): transformations that map the object onto
/// itself (the identity is added); symmetry_axes: a list of (direction, point), axes about which it is symmetric under any
/// rotation.
///
/// Raises ValueError if there is no vertex, for numbers that are not finite, faces with an invalid vertex index, and texcoords or
/// texture without the other.
///
/// >>> triangle = Mesh([[0, 0, 0], [0.03, 0, 0], [0, 0.04, 0]], [[0, 1, 2]])
/// >>> triangle.diameter
/// 0.05
#[pyclass(name = "Mesh", module = "sixfold", frozen)]
pub(crate) struct PyMesh {
    pub(crate) mesh: Arc<Mesh>,
    discrete: Vec<Pose>,
    continuous: Vec<ContinuousSymmetry>,
    diameter: OnceLock<f64>,
    points: OnceLock<Arc<ModelPoints>>,
}

/// Direction and point of a symmetry axis.
type Axis<'py> = (Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>);

fn unit(word: &str) -> PyResult<Unit> {
    word.parse().map_err(|error: UnitError| PyValueError::new_err(error.to_string()))
}

impl PyMesh {
    pub(crate) fn plain(mesh: Mesh) -> Self {
        PyMesh::symmetric(mesh, Vec::new(), Vec::new())
    }

    pub(crate) fn symmetric(mesh: Mesh, discrete: Vec<Pose>, continuous: Vec<ContinuousSymmetry>) -> Self {
        let (mesh, diameter, points) = (Arc::new(mesh), OnceLock::new(), OnceLock::new());
        PyMesh { mesh, discrete, continuous, diameter, points }
    }

    pub(crate) fn with_info(mesh: Mesh, info: Option<&ModelInfo>) -> Self {
        match info {
            None => PyMesh::plain(mesh),
            Some(i) => {
                PyMesh::symmetric(mesh, i.symmetries_discrete.clone(), i.symmetries_continuous.clone())
            }
        }
    }

    /// Another mesh with the symmetries of this one.
    fn like(&self, mesh: Mesh) -> Self {
        PyMesh::symmetric(mesh, self.discrete.clone(), self.continuous.clone())
    }

    pub(crate) fn known_diameter(&self) -> f64 {
        *self.diameter.get_or_init(|| self.mesh.diameter())
    }

    pub(crate) fn symmetry_poses(&self, max_step: f64) -> Vec<Pose> {
        self.turns().symmetry_poses(max_step)
    }

    /// The symmetries as the library expects them; they do not depend on size and diameter.
    fn turns(&self) -> ModelInfo {
        ModelInfo {
            diameter: 1.0,
            min: Vec3::zeros(),
            size: Vec3::zeros(),
            symmetries_discrete: self.discrete.clone(),
            symmetries_continuous: self.continuous.clone(),
        }
    }

    /// Diameter, bounding box and symmetries of the object.
    pub(crate) fn info(&self) -> ModelInfo {
        let (symmetries_discrete, symmetries_continuous) = (self.discrete.clone(), self.continuous.clone());
        ModelInfo { symmetries_discrete, symmetries_continuous, ..ModelInfo::of_mesh(&self.mesh) }
    }

    /// The vertices in the form that the pose errors need.
    pub(crate) fn model_points(&self) -> PyResult<Arc<ModelPoints>> {
        if let Some(points) = self.points.get() {
            return Ok(points.clone());
        }
        let points = ModelPoints::new(self.mesh.vertices())
            .ok_or_else(|| bad("mesh", "finite vertices", "none, or one that is not finite"))?;
        Ok(self.points.get_or_init(|| Arc::new(points)).clone())
    }
}

/// A symmetry axis with the properties that the library assumes.
fn symmetry_axis(entry: &Bound<'_, PyAny>) -> PyResult<ContinuousSymmetry> {
    let parts = || entry.extract::<(Bound<'_, PyAny>, Bound<'_, PyAny>)>();
    let (axis, offset) =
        parts().map_err(|_| bad("symmetry_axes", "a list of pairs (direction, point)", "something else"))?;
    let axis = arrays::vector3("symmetry_axes", &axis)?;
    let offset = arrays::vector3("symmetry_axes", &offset)?;
    let axis = axis
        .try_normalize(1e-9)
        .ok_or_else(|| bad("symmetry_axes", "directions with a length", "a direction of length zero"))?;
    Ok(ContinuousSymmetry { axis, offset })
}

fn symmetries_of(
    discrete: Option<&Bound<'_, PyAny>>,
    axes: Option<&Bound<'_, PyAny>>,
) -> PyResult<(Vec<Pose>, Vec<ContinuousSymmetry>)> {
    let mut poses = match discrete {
        Some(object) => arrays::poses("symmetries", object)?,
        None => Vec::new(),
    };
    poses.retain(|p| p.rotation_angle_to(&Pose::identity()) > 1e-9 || p.translation().norm() > 1e-12);
    let mut continuous = Vec::new();
    if let Some(axes) = axes {
        for entry in axes.try_iter()? {
            continuous.push(symmetry_axis(&entry?)?);
        }
    }
    Ok((poses, continuous))
}

#[pymethods]
impl PyMesh {
    #[new]
    #[pyo3(signature = (vertices, faces=None, *, normals=None, colors=None, texcoords=None, texture=None, symmetries=None, symmetry_axes=None))]
    #[allow(clippy::too_many_arguments)]
    fn new(
        vertices: &Bound<'_, PyAny>,
        faces: Option<&Bound<'_, PyAny>>,
        normals: Option<&Bound<'_, PyAny>>,
        colors: Option<&Bound<'_, PyAny>>,
        texcoords: Option<&Bound<'_, PyAny>>,
        texture: Option<&Bound<'_, PyAny>>,
        symmetries: Option<&Bound<'_, PyAny>>,
        symmetry_axes: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let vertices = arrays::points3("vertices", vertices)?;
        if vertices.is_empty() {
            return Err(bad("vertices", "at least one", "none"));
        }
        let faces = faces.map_or(Ok(Vec::new()), |f| arrays::faces("faces", f))?;
        let mut mesh = Mesh::new(vertices, faces).map_err(about("faces"))?;
        if let Some(normals) = normals {
            let normals = arrays::points3("normals", normals)?;
            let unit = normals.iter().map(|n| n.try_normalize(1e-12).unwrap_or_else(Vec3::zeros)).collect();
            mesh = mesh.with_normals(unit).map_err(about("normals"))?;
        }
        if let Some(colors) = colors {
            mesh = mesh.with_colors(arrays::colors("colors", colors)?).map_err(about("colors"))?;
        }
        match (texcoords, texture) {
            (Some(texcoords), Some(texture)) => {
                let texcoords = arrays::pairs_f32("texcoords", texcoords)?;
                let texture = arrays::rgb("texture", texture)?;
                mesh = mesh.with_texture(texcoords, texture).map_err(about("texcoords"))?;
            }
            (None, None) => {}
            _ => return Err(bad("texture", "texcoords and texture together", "one of them alone")),
        }
        let (discrete, continuous) = symmetries_of(symmetries, symmetry_axes)?;
        Ok(PyMesh::symmetric(mesh, discrete, continuous))
    }

    /// Reads a PLY, OBJ, STL, glTF/GLB or XYZ file. `unit` is the unit of the lengths in the file, "m", "mm", "cm" or "in"; files
    /// do not state it.
    ///
    /// Raises OSError when the file cannot be read; ValueError when it is broken, or, with check_size, when the object would be
    /// smaller than 5 mm or larger than 5 m (the message states which unit fits). Textures, materials and buffers that the file
    /// names are read only from its folder and below; with allow_outside, from anywhere.
    ///
    /// >>> Mesh.load("data/demo/models/obj_000001.ply", unit="mm").diameter  # doctest: +SKIP
    /// 0.10209...
    #[classmethod]
    #[pyo3(signature = (path, unit, *, check_size=true, allow_outside=false))]
    fn load(
        _class: &Bound<'_, PyType>,
        py: Python<'_>,
        path: PathBuf,
        unit: &str,
        check_size: bool,
        allow_outside: bool,
    ) -> PyResult<Self> {
        let unit = self::unit(unit)?;
        let options = MeshOptions { allow_outside, check_size };
        let mesh =
            free(py, || sixfold::mesh::read_mesh_with(&path, unit, &options))?.map_err(mesh_file_error)?;
        Ok(PyMesh::plain(mesh))
    }

    /// Writes a PLY file with lengths in `unit` ("m", "mm", "cm", "in") as 32-bit floats, binary or as text. A texture becomes a
    /// PNG file beside it. Each file is replaced as a whole or not at all. Raises OSError, or ValueError for coordinates that do
    /// not fit a 32-bit float.
    ///
    /// >>> mesh.save("cup.ply", unit="mm")  # doctest: +SKIP
    #[pyo3(signature = (path, unit, *, binary=true))]
    fn save(&self, py: Python<'_>, path: PathBuf, unit: &str, binary: bool) -> PyResult<()> {
        let unit = self::unit(unit)?;
        let format = if binary { PlyFormat::BinaryLittleEndian } else { PlyFormat::Ascii };
        free(py, || sixfold::mesh::write_ply(&path, &self.mesh, unit, format))?.map_err(mesh_file_error)
    }

    /// Vertices, (N, 3) float64, metres.
    #[getter]
    fn vertices<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::from_points3(py, self.mesh.vertices())
    }

    /// Triangles, (F, 3) uint32 vertex indices.
    #[getter]
    fn faces<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<u32>>> {
        arrays::from_rows(py, self.mesh.faces().to_vec())
    }

    /// Unit normals of the vertices, (N, 3) float64, or None.
    #[getter]
    fn normals<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<f64>>>> {
        self.mesh.normals().map(|n| arrays::from_points3(py, n)).transpose()
    }

    /// Colours of the vertices, (N, 3) uint8, or None.
    #[getter]
    fn colors<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<u8>>>> {
        self.mesh.colors().map(|c| arrays::from_rows(py, c.to_vec())).transpose()
    }

    /// Texture coordinates of the vertices, (N, 2) float32, v up, or None.
    #[getter]
    fn texcoords<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<f32>>>> {
        self.mesh.texcoords().map(|c| arrays::from_rows(py, c.to_vec())).transpose()
    }

    /// The texture, (H, W, 3) uint8, or None.
    #[getter]
    fn texture<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray3<u8>>>> {
        self.mesh.texture().map(|t| arrays::from_image_of(py, t.clone())).transpose()
    }

    /// Diameter: the largest distance between two vertices, metres, exact.
    #[getter]
    fn diameter(&self, py: Python<'_>) -> PyResult<f64> {
        free(py, || self.known_diameter())
    }

    /// Transformations that map the object onto itself, (S, 4, 4), the identity first: the identity and each discrete one, each
    /// followed by 315 steps about every axis, as BOP's evaluation discretises them (Hodan et al. 2020, section 2.2).
    #[getter]
    fn symmetries<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f64>>> {
        arrays::from_poses(py, &self.symmetry_poses(ModelInfo::BOP_MAX_STEP))
    }

    /// Axes about which the object is symmetric under any rotation: a list of (direction (3,), point (3,) in metres).
    #[getter]
    fn symmetry_axes<'py>(&self, py: Python<'py>) -> Vec<Axis<'py>> {
        let axes = self.continuous.iter();
        axes.map(|s| (arrays::from_vector3(py, &s.axis), arrays::from_vector3(py, &s.offset))).collect()
    }

    /// The same mesh with other symmetries (S, 4, 4) and symmetry axes [(direction, point), ...].
    ///
    /// >>> cup = Mesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]).with_symmetries(axes=[((0, 0, 1), (0, 0, 0))])
    /// >>> cup.symmetries.shape
    /// (315, 4, 4)
    #[pyo3(signature = (symmetries=None, axes=None))]
    fn with_symmetries(
        &self,
        symmetries: Option<&Bound<'_, PyAny>>,
        axes: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<PyMesh> {
        let (discrete, continuous) = symmetries_of(symmetries, axes)?;
        Ok(PyMesh {
            mesh: self.mesh.clone(),
            discrete,
            continuous,
            diameter: self.diameter.clone(),
            points: self.points.clone(),
        })
    }

    /// Corners of the axis-aligned bounding box, (2, 3), metres: smallest and largest coordinates.
    #[getter]
    fn bounding_box<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let (low, high) = self.mesh.bounding_box();
        arrays::from_points3(py, &[low, high])
    }

    /// Area of all faces, square metres.
    #[getter]
    fn surface_area(&self) -> f64 {
        self.mesh.surface_area()
    }

    /// A unit normal for every vertex, (N, 3): those given, or computed from the faces, each weighted by its angle at the vertex
    /// (Thuermer and Wuethrich 1998); zero where there is no face.
    fn vertex_normals<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let normals = free(py, || self.mesh.vertex_normals())?;
        arrays::from_points3(py, &normals)
    }

    /// Samples `count` points of the surface, uniformly by area (Osada et al. 2002): points (n, 3), unit normals (n, 3), face
    /// indices (n,). The same seed gives the same points; a mesh without area gives none.
    ///
    /// >>> triangle = Mesh([[0, 0, 0], [0.03, 0, 0], [0, 0.04, 0]], [[0, 1, 2]])
    /// >>> points, normals, faces = triangle.sample_surface(100)
    /// >>> points.shape
    /// (100, 3)
    #[pyo3(signature = (count, *, seed=0))]
    #[allow(clippy::type_complexity)]
    fn sample_surface<'py>(
        &self,
        py: Python<'py>,
        count: i64,
        seed: i64,
    ) -> PyResult<(Bound<'py, PyArray2<f64>>, Bound<'py, PyArray2<f64>>, Bound<'py, PyArray1<u32>>)> {
        let (count, seed) = (whole("count", count, 0)?, self::seed(seed)?);
        if count > 1 << 26 {
            return Err(bad("count", "at most 67108864", count.to_string()));
        }
        let samples = free(py, || self.mesh.sample_surface(count, seed))?;
        Ok((
            arrays::from_points3(py, &samples.points)?,
            arrays::from_points3(py, &samples.normals)?,
            PyArray1::from_vec(py, samples.faces),
        ))
    }

    /// Simplifies the mesh to at most `faces` faces that follow its shape (Garland and Heckbert 1997); more remain when no edge can
    /// be collapsed without flipping a face. Vertex colours are kept; a texture becomes vertex colours. Ctrl-C interrupts it.
    ///
    /// >>> coarse = mesh.simplify(2000)  # doctest: +SKIP
    fn simplify(&self, py: Python<'_>, faces: i64) -> PyResult<PyMesh> {
        let (mesh, faces) = (self.mesh.clone(), whole("faces", faces, 1)?);
        Ok(self.like(interruptible(py, move |_| sixfold::mesh::simplify(&mesh, faces))?))
    }

    /// Convex hull of the vertices (Barber et al. 1996), without colours. Raises ValueError when they lie in a plane.
    fn convex_hull(&self, py: Python<'_>) -> PyResult<PyMesh> {
        Ok(self.like(free(py, || self.mesh.convex_hull())?.map_err(about("mesh"))?))
    }

    /// A mesh of discs through the vertices, to render a point cloud (Pfister et al. 2000), without colours. Raises ValueError for
    /// fewer than four points or for points on a line.
    fn surfels(&self, py: Python<'_>) -> PyResult<PyMesh> {
        Ok(self.like(free(py, || self.mesh.surfels())?.map_err(about("mesh"))?))
    }

    /// The mesh transformed by a pose (4, 4), without its symmetries.
    fn transformed(&self, pose: &Bound<'_, PyAny>) -> PyResult<PyMesh> {
        Ok(PyMesh::plain(self.mesh.transformed(&arrays::pose("pose", pose)?)))
    }

    /// The mesh with every length multiplied by `factor`, without its symmetries.
    fn scaled(&self, factor: f64) -> PyResult<PyMesh> {
        Ok(PyMesh::plain(self.mesh.scaled(positive("factor", factor)?)))
    }

    /// One mesh with the faces of several, without their symmetries.
    ///
    /// >>> part = Mesh([[0, 0, 0], [0.03, 0, 0], [0, 0.04, 0]], [[0, 1, 2]])
    /// >>> len(Mesh.merged([part, part]).faces)
    /// 2
    #[staticmethod]
    fn merged(meshes: Vec<Py<PyMesh>>) -> PyResult<PyMesh> {
        let parts: Vec<Mesh> = meshes.iter().map(|m| m.get().mesh.as_ref().clone()).collect();
        Ok(PyMesh::plain(Mesh::merged(&parts).map_err(about("meshes"))?))
    }

    fn __repr__(&self) -> String {
        let symmetric =
            if self.discrete.is_empty() && self.continuous.is_empty() { "" } else { ", symmetric" };
        format!(
            "<Mesh: {} vertices, {} faces{symmetric}>",
            self.mesh.vertices().len(),
            self.mesh.faces().len()
        )
    }

    fn __reduce__<'py>(
        slf: &Bound<'py, Self>,
        py: Python<'py>,
    ) -> PyResult<(Py<PyAny>, (Bound<'py, PyDict>,))> {
        let this = slf.get();
        let parts = PyDict::new(py);
        parts.set_item("vertices", this.vertices(py)?)?;
        parts.set_item("faces", this.faces(py)?)?;
        parts.set_item("normals", this.normals(py)?)?;
        parts.set_item("colors", this.colors(py)?)?;
        parts.set_item("texcoords", this.texcoords(py)?)?;
        parts.set_item("texture", this.texture(py)?)?;
        let discrete =
            if this.discrete.is_empty() { None } else { Some(arrays::from_poses(py, &this.discrete)?) };
        parts.set_item("symmetries", discrete)?;
        parts.set_item("symmetry_axes", this.symmetry_axes(py))?;
        let restore = py.import("sixfold._sixfold")?.getattr("_mesh_of")?;
        Ok((restore.unbind(), (parts,)))
    }
}

/// Restores a mesh from its pickled parts.
#[pyfunction]
pub(crate) fn _mesh_of<'py>(py: Python<'py>, parts: &Bound<'py, PyDict>) -> PyResult<Bound<'py, PyAny>> {
    py.get_type::<PyMesh>().call((), Some(parts))
}

/// A found symmetry as a dict.
fn found_symmetry<'py>(py: Python<'py>, s: &FoundSymmetry) -> PyResult<Bound<'py, PyDict>> {
    let entry = PyDict::new(py);
    entry.set_item("axis", arrays::from_vector3(py, &s.axis))?;
    entry.set_item("point", arrays::from_vector3(py, &s.point))?;
    entry.set_item("order", s.order)?;
    entry.set_item("deviation_p95", s.deviation.p95)?;
    entry.set_item("deviation_max", s.deviation.max)?;
    entry.set_item("color_difference_mean", s.color.map(|c| c.mean))?;
    entry.set_item("color_difference_p95", s.color.map(|c| c.p95))?;
    entry.set_item("by_shape", s.by_shape.name())?;
    entry.set_item("by_shape_and_color", s.by_shape_and_color.name())?;
    entry.set_item("poses", arrays::from_poses(py, &s.poses())?)?;
    Ok(entry)
}

/// Finds the rotations that map a mesh onto itself: those that are at least likely by its shape, continuous ones first. `noise`:
/// standard deviation of the surface in metres, 0.001 for a mesh from photographs.
///
/// Returns a dict for each: axis (3,), a unit direction, and point (3,) on it; order (rotations by multiples of a full rotation
/// divided by it; None for any rotation); deviation_p95 and deviation_max, distances of the rotated surface from itself, metres;
/// color_difference_mean and color_difference_p95, 0 to 1, None without colours; by_shape and by_shape_and_color, "sure", "likely"
/// or "none"; poses (order - 1, 4, 4), empty when order is None.
///
/// Raises ValueError for noise outside 0 to 0.02 m or above a fiftieth of the object's diameter.
///
/// >>> slab = Mesh([[0, 0, 0], [0.06, 0, 0], [0.06, 0.04, 0], [0, 0.04, 0]], [[0, 1, 2], [0, 2, 3]])
/// >>> [s["order"] for s in find_symmetries(slab) if s["by_shape"] == "sure"]
/// [2, 2, 2]
#[pyfunction]
#[pyo3(signature = (mesh, *, noise=0.0, seed=0))]
pub(crate) fn find_symmetries<'py>(
    py: Python<'py>,
    mesh: &Bound<'py, PyMesh>,
    noise: f64,
    seed: i64,
) -> PyResult<Vec<Bound<'py, PyDict>>> {
    let options = SymmetryOptions { noise, seed: self::seed(seed)?, ..SymmetryOptions::default() };
    let mesh = mesh.get().mesh.clone();
    let found = free(py, || sixfold::mesh::find_symmetries(&mesh, &options))?
        .map_err(|error| PyValueError::new_err(error.to_string()))?;
    found.iter().map(|s| found_symmetry(py, s)).collect()
}
