//! Rendering on the CPU: depth, masks, normals, object coordinates, colour; and simulation of a depth camera.

use std::sync::Arc;

use numpy::{PyArray2, PyArray3, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::{PyIterator, PyList, PyTuple};
use sixfold::geometry::{Camera, Image, Mask, NormalImage, PointImage, Pose, RgbImage, Vec3};
use sixfold::mesh::Mesh;
use sixfold::render::{
    Culling, DepthSensor, Light, Material, RenderOptions, SceneObject, VisibilityBuffer, shade,
};

use crate::arrays::{self, about, bad, seed};
use crate::camera::PyCamera;
use crate::guard::free;
use crate::mesh::PyMesh;

/// The result of `render`. It unpacks in the following order.
///
/// depth: (H, W) float32, metres; 0 where the object is not visible.
/// mask: (H, W) bool.
/// normals: (H, W, 3) float32, unit normals in the camera frame that point towards the camera; 0 where the object is not
///     visible.
/// coordinates: (H, W, 3) float32, the visible point in the object's frame, metres; NaN where the object is not visible.
/// rgb: (H, W, 3) uint8.
#[pyclass(name = "Rendering", module = "sixfold", frozen)]
pub(crate) struct Rendering {
    /// Depth in metres.
    #[pyo3(get)]
    depth: Py<PyArray2<f32>>,
    /// Where the object is visible.
    #[pyo3(get)]
    mask: Py<PyArray2<bool>>,
    /// Unit normals in the camera frame.
    #[pyo3(get)]
    normals: Py<PyArray3<f32>>,
    /// Object coordinates in metres.
    #[pyo3(get)]
    coordinates: Py<PyArray3<f32>>,
    /// Colour.
    #[pyo3(get)]
    rgb: Py<PyArray3<u8>>,
}

#[pymethods]
impl Rendering {
    fn __iter__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyIterator>> {
        let parts =
            (&self.depth, &self.mask, &self.normals, &self.coordinates, &self.rgb).into_pyobject(py)?;
        parts.try_iter()
    }

    fn __len__(&self) -> usize {
        5
    }
}

/// The result of `render_scene`. Its attributes are those of `Rendering`, except that masks (K, H, W) bool has one mask per
/// object and instances (H, W) int32 is the index of the visible object, -1 for none. It does not unpack.
#[pyclass(name = "SceneRendering", module = "sixfold", frozen)]
pub(crate) struct SceneRendering {
    /// Depth in metres.
    #[pyo3(get)]
    depth: Py<PyArray2<f32>>,
    /// Where each object is visible, (K, H, W).
    #[pyo3(get)]
    masks: Py<PyArray3<bool>>,
    /// Index of the visible object, -1 for none.
    #[pyo3(get)]
    instances: Py<PyArray2<i32>>,
    /// Unit normals in the camera frame.
    #[pyo3(get)]
    normals: Py<PyArray3<f32>>,
    /// Coordinates in the frame of the visible object, metres.
    #[pyo3(get)]
    coordinates: Py<PyArray3<f32>>,
    /// Colour.
    #[pyo3(get)]
    rgb: Py<PyArray3<u8>>,
}

/// Ambient light, equal from all directions. Colours are linear; 1 is full white.
///
/// >>> light = AmbientLight((0.5, 0.5, 0.5))
/// >>> drawn = render(mesh, pose, camera, lights=[light])  # doctest: +SKIP
#[pyclass(name = "AmbientLight", module = "sixfold", frozen, from_py_object)]
#[derive(Clone)]
pub(crate) struct AmbientLight([f32; 3]);

#[pymethods]
impl AmbientLight {
    #[new]
    #[pyo3(signature = (color=[0.35, 0.35, 0.35]))]
    fn new(color: [f32; 3]) -> PyResult<Self> {
        Ok(AmbientLight(light_color(color)?))
    }
}

/// Light from infinitely far away that travels along `direction` (3,) in the camera frame. Colours are linear; 1 is full white.
///
/// Raises ValueError for a zero direction and a negative colour.
///
/// >>> light = DirectionalLight((0, 0.3, 1))  # from behind the camera, and from above
#[pyclass(name = "DirectionalLight", module = "sixfold", frozen, from_py_object)]
#[derive(Clone)]
pub(crate) struct DirectionalLight(Vec3, [f32; 3]);

#[pymethods]
impl DirectionalLight {
    #[new]
    #[pyo3(signature = (direction, color=[0.75, 0.75, 0.75]))]
    fn new(direction: &Bound<'_, PyAny>, color: [f32; 3]) -> PyResult<Self> {
        let direction = arrays::vector3("direction", direction)?;
        if direction.norm() < 1e-12 {
            return Err(bad("direction", "a direction that is not zero", "zeros"));
        }
        Ok(DirectionalLight(direction, light_color(color)?))
    }
}

/// Light from `position` (3,) in the camera frame, metres. It decreases with the square of the distance; `color` is its linear
/// colour at one metre.
///
/// >>> light = PointLight((0, -0.5, 0))  # half a metre above the camera
#[pyclass(name = "PointLight", module = "sixfold", frozen, from_py_object)]
#[derive(Clone)]
pub(crate) struct PointLight(Vec3, [f32; 3]);

#[pymethods]
impl PointLight {
    #[new]
    #[pyo3(signature = (position, color=[0.75, 0.75, 0.75]))]
    fn new(position: &Bound<'_, PyAny>, color: [f32; 3]) -> PyResult<Self> {
        Ok(PointLight(arrays::vector3("position", position)?, light_color(color)?))
    }
}

fn light_color(color: [f32; 3]) -> PyResult<[f32; 3]> {
    if color.iter().all(|c| c.is_finite() && *c >= 0.0) {
        return Ok(color);
    }
    Err(bad("color", "three finite numbers from 0", format!("{color:?}")))
}

#[derive(FromPyObject)]
enum AnyLight {
    Ambient(AmbientLight),
    Directional(DirectionalLight),
    Point(PointLight),
}

fn lights_of(lights: Option<&Bound<'_, PyAny>>) -> PyResult<Vec<Light>> {
    let Some(lights) = lights else { return Ok(Light::default_set()) };
    let expected = "a list of AmbientLight, DirectionalLight and PointLight";
    let wrong = |found: &Bound<'_, PyAny>| bad("lights", expected, found.get_type().to_string());
    let mut out = Vec::new();
    for light in lights.try_iter().map_err(|_| wrong(lights))? {
        let light = light?;
        out.push(match light.extract::<AnyLight>().map_err(|_| wrong(&light))? {
            AnyLight::Ambient(l) => Light::Ambient { color: l.0 },
            AnyLight::Directional(l) => Light::Directional { direction: l.0, color: l.1 },
            AnyLight::Point(l) => Light::Point { position: l.0, color: l.1 },
        });
    }
    Ok(out)
}

/// The checked options of rendering.
struct Style {
    lights: Vec<Light>,
    material: Material,
    background: Option<RgbImage>,
    options: RenderOptions,
}

#[allow(clippy::too_many_arguments)]
fn style(
    camera: &Camera,
    lights: Option<&Bound<'_, PyAny>>,
    background: Option<&Bound<'_, PyAny>>,
    specular: f32,
    shininess: f32,
    plain_color: [u8; 3],
    near: f64,
    cull_back_faces: bool,
) -> PyResult<Style> {
    let background = background.map(|b| arrays::rgb("background", b)).transpose()?;
    if let Some(image) = &background {
        camera.check_image(image.width(), image.height()).map_err(about("background"))?;
    }
    for (name, value) in [("specular", specular), ("shininess", shininess)] {
        if !(value.is_finite() && value >= 0.0) {
            return Err(bad(name, "a finite number from 0", value.to_string()));
        }
    }
    let near = arrays::positive("near", near)?;
    let culling = if cull_back_faces { Culling::Back } else { Culling::None };
    Ok(Style {
        lights: lights_of(lights)?,
        material: Material { specular, shininess, plain: plain_color },
        background,
        options: RenderOptions { near, culling, parallel: true },
    })
}

struct Drawn {
    depth: Image<f32>,
    masks: Vec<Mask>,
    instances: Image<i32>,
    normals: NormalImage,
    coordinates: PointImage,
    rgb: RgbImage,
}

fn draw(camera: &Camera, objects: &[(Arc<Mesh>, Pose)], style: &Style) -> Drawn {
    let objects: Vec<SceneObject<'_>> =
        objects.iter().map(|(mesh, pose)| SceneObject { mesh, camera_from_object: *pose }).collect();
    let mut frame = VisibilityBuffer::new(camera);
    frame.render(&objects, &style.options);
    Drawn {
        depth: frame.depth(),
        masks: (0..objects.len()).map(|i| frame.mask(i)).collect(),
        instances: frame.instances().map(|i| i.map_or(-1, |i| i as i32)),
        normals: frame.normals(&objects),
        coordinates: frame.object_coordinates(&objects),
        rgb: shade(&frame, &objects, &style.lights, &style.material, style.background.as_ref()),
    }
}

/// Renders a mesh at camera_from_object (4, 4) with Sixfold's own rasteriser on the CPU (Pineda 1988). Pixel centres have
/// integer coordinates. The image is that of a pinhole camera: the camera's distortion is ignored.
///
/// lights: a list of AmbientLight, DirectionalLight and PointLight in the camera frame. None: soft ambient light and a
///     directional light from beside the camera.
/// background: (H, W, 3) uint8.
/// specular, shininess: strength and exponent of Blinn's highlight.
/// plain_color: colour of meshes without colours.
/// near: surfaces nearer than this are cut off, metres.
/// cull_back_faces: leave out triangles that face away from the camera.
///
/// Raises ValueError for an invalid pose and a background of another size than the camera's.
///
/// >>> import numpy as np
/// >>> square = Mesh([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]], [[0, 1, 2], [0, 2, 3]])
/// >>> pose = np.eye(4); pose[2, 3] = 1.0
/// >>> depth, mask, normals, coordinates, rgb = render(square, pose, Camera(500, 500, 320, 240, 640, 480))
/// >>> int(mask.sum()), float(depth[240, 320])
/// (10000, 1.0)
#[pyfunction]
#[pyo3(signature = (mesh, camera_from_object, camera, lights=None, *, background=None, specular=0.0, shininess=20.0, plain_color=[200, 200, 200], near=0.01, cull_back_faces=false))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn render(
    py: Python<'_>,
    mesh: &Bound<'_, PyMesh>,
    camera_from_object: &Bound<'_, PyAny>,
    camera: PyCamera,
    lights: Option<&Bound<'_, PyAny>>,
    background: Option<&Bound<'_, PyAny>>,
    specular: f32,
    shininess: f32,
    plain_color: [u8; 3],
    near: f64,
    cull_back_faces: bool,
) -> PyResult<Rendering> {
    let pose = arrays::pose("camera_from_object", camera_from_object)?;
    let style = style(
        &camera.drawable()?,
        lights,
        background,
        specular,
        shininess,
        plain_color,
        near,
        cull_back_faces,
    )?;
    let objects = [(mesh.get().mesh.clone(), pose)];
    let mut drawn = free(py, || draw(&camera.0, &objects, &style))?;
    Ok(Rendering {
        depth: arrays::from_image(py, drawn.depth)?.unbind(),
        mask: arrays::from_image(py, drawn.masks.swap_remove(0))?.unbind(),
        normals: arrays::from_image_of(py, drawn.normals)?.unbind(),
        coordinates: arrays::from_point_image(py, drawn.coordinates)?.unbind(),
        rgb: arrays::from_image_of(py, drawn.rgb)?.unbind(),
    })
}

/// Renders several objects, [(mesh, camera_from_object (4, 4)), ...], into one image. The other arguments are those of render.
///
/// Raises ValueError if there is no object, for an invalid pose and for a background of another size than the camera's.
///
/// >>> import numpy as np
/// >>> square = Mesh([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]], [[0, 1, 2], [0, 2, 3]])
/// >>> near, far = np.eye(4), np.eye(4)
/// >>> near[:3, 3], far[:3, 3] = (0.1, 0, 1), (0, 0, 2)
/// >>> scene = render_scene([(square, near), (square, far)], Camera(500, 500, 320, 240, 640, 480))
/// >>> scene.masks.sum(axis=(1, 2))
/// array([10000,  1250])
#[pyfunction]
#[pyo3(signature = (objects, camera, lights=None, *, background=None, specular=0.0, shininess=20.0, plain_color=[200, 200, 200], near=0.01, cull_back_faces=false))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn render_scene(
    py: Python<'_>,
    objects: &Bound<'_, PyAny>,
    camera: PyCamera,
    lights: Option<&Bound<'_, PyAny>>,
    background: Option<&Bound<'_, PyAny>>,
    specular: f32,
    shininess: f32,
    plain_color: [u8; 3],
    near: f64,
    cull_back_faces: bool,
) -> PyResult<SceneRendering> {
    let objects = posed_objects("objects", objects)?;
    let style = style(
        &camera.drawable()?,
        lights,
        background,
        specular,
        shininess,
        plain_color,
        near,
        cull_back_faces,
    )?;
    let drawn = free(py, || draw(&camera.0, &objects, &style))?;
    let (width, height) = (camera.0.width, camera.0.height);
    let masks: Vec<bool> = drawn.masks.into_iter().flat_map(Image::into_vec).collect();
    let masks = numpy::PyArray1::from_vec(py, masks).reshape([objects.len(), height, width])?;
    Ok(SceneRendering {
        depth: arrays::from_image(py, drawn.depth)?.unbind(),
        masks: masks.unbind(),
        instances: arrays::from_image(py, drawn.instances)?.unbind(),
        normals: arrays::from_image_of(py, drawn.normals)?.unbind(),
        coordinates: arrays::from_point_image(py, drawn.coordinates)?.unbind(),
        rgb: arrays::from_image_of(py, drawn.rgb)?.unbind(),
    })
}

/// `[(mesh, camera_from_object), ...]` with at least one entry.
pub(crate) fn posed_objects(
    argument: &'static str,
    objects: &Bound<'_, PyAny>,
) -> PyResult<Vec<(Arc<Mesh>, Pose)>> {
    let wrong = |found: &Bound<'_, PyAny>| {
        bad(argument, "a list of pairs (Mesh, camera_from_object)", found.get_type().to_string())
    };
    let mut out = Vec::new();
    for entry in objects.try_iter().map_err(|_| wrong(objects))? {
        let entry = entry?;
        let pair = entry.cast::<PyTuple>().map(|t| t.as_any().clone());
        let pair = pair.or_else(|_| entry.cast::<PyList>().map(|l| l.as_any().clone()));
        let pair = pair.map_err(|_| wrong(&entry))?;
        let (mesh, pose) =
            pair.extract::<(Bound<'_, PyMesh>, Bound<'_, PyAny>)>().map_err(|_| wrong(&entry))?;
        out.push((mesh.get().mesh.clone(), arrays::pose("camera_from_object", &pose)?));
    }
    if out.is_empty() {
        return Err(bad(argument, "at least one object", "none"));
    }
    Ok(out)
}

/// Renders only the depth (H, W) float32 of a mesh at camera_from_object (4, 4), metres; 0 where it is not visible. It is the
/// depth of render.
///
/// >>> import numpy as np
/// >>> square = Mesh([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]], [[0, 1, 2], [0, 2, 3]])
/// >>> pose = np.eye(4); pose[2, 3] = 1.0
/// >>> render_depth(square, pose, Camera(500, 500, 320, 240, 640, 480)).max()
/// np.float32(1.0)
#[pyfunction]
pub(crate) fn render_depth<'py>(
    py: Python<'py>,
    mesh: &Bound<'py, PyMesh>,
    camera_from_object: &Bound<'py, PyAny>,
    camera: PyCamera,
) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let pose = arrays::pose("camera_from_object", camera_from_object)?;
    let (mesh, camera) = (mesh.get(), camera.drawable()?);
    arrays::from_image(py, free(py, || sixfold::render::render_depth(&mesh.mesh, &pose, &camera))?)
}

/// Simulates the depth (H, W) float32 in metres that a depth camera like the Kinect measures, from ideal depth (H, W) and the
/// normals (H, W, 3) of the same image (Nguyen et al. 2012; Khoshelham and Elberink 2012). The same seed gives the same bytes.
///
/// Raises ValueError if the images differ in size.
///
/// >>> import numpy as np
/// >>> normals = np.zeros((4, 6, 3), np.float32); normals[..., 2] = -1
/// >>> simulate_depth(np.full((4, 6), 0.8, np.float32), normals).shape
/// (4, 6)
#[pyfunction]
#[pyo3(signature = (depth, normals, *, seed=0))]
pub(crate) fn simulate_depth<'py>(
    py: Python<'py>,
    depth: &Bound<'py, PyAny>,
    normals: &Bound<'py, PyAny>,
    seed: i64,
) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let (depth, normals) = (arrays::depth("depth", depth)?, arrays::normal_image("normals", normals)?);
    if depth.size() != normals.size() {
        let size = |(width, height): (usize, usize)| format!("{width}x{height}");
        return Err(bad("normals", size(depth.size()) + ", as the depth", size(normals.size())));
    }
    let seed = self::seed(seed)?;
    let out = free(py, || sixfold::render::simulate_depth(&depth, &normals, &DepthSensor::kinect(), seed))?;
    arrays::from_image(py, out)
}

/// Estimates the table on which most of the objects [(mesh, camera_from_object (4, 4)), ...] stand: a Plane in the camera frame
/// with its normal up, or None. The camera is assumed to be upright (within 80 degrees) and above the table.
///
/// Raises ValueError if there is no object.
///
/// >>> table = support_plane([(mesh, pose)])  # doctest: +SKIP
#[pyfunction]
pub(crate) fn support_plane(
    py: Python<'_>,
    objects: &Bound<'_, PyAny>,
) -> PyResult<Option<crate::scene::PyPlane>> {
    let objects = posed_objects("objects", objects)?;
    let plane = free(py, || {
        let objects: Vec<SceneObject<'_>> =
            objects.iter().map(|(mesh, pose)| SceneObject { mesh, camera_from_object: *pose }).collect();
        sixfold::render::support_plane(&objects)
    })?;
    Ok(plane.map(crate::scene::PyPlane))
}
