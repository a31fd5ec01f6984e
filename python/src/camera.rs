//! `Camera`: pinhole intrinsics with optional lens distortion, and removal of the distortion from images.

use std::path::PathBuf;

use numpy::{PyArray1, PyArray2, PyArray3};
use pyo3::prelude::*;
use pyo3::types::{PyTuple, PyType};
use sixfold::geometry::{BrownConrady, Camera, Vec2};
use sixfold::io::CameraFile;

use crate::arrays::{self, about, bad, whole};
use crate::guard::{camera_file_error, free};

/// A pinhole camera with focal lengths, principal point and image size in pixels. The centre of the top left pixel is (0, 0);
/// x points right, y down, z forward (OpenCV's frame).
///
/// distortion: Brown's coefficients in OpenCV's order, (k1, k2, p1, p2) or (k1, k2, p1, p2, k3).
///
/// Raises ValueError for parameters that no real lens has: a focal length that is not above 0, above 1000000 pixels or not in
/// pixels (an edge of the image is more than 85 degrees off the optical axis); fx and fy that differ by more than a factor of 2; a
/// distortion that moves an edge of the image by more than a factor of 5; an empty image; numbers that are not finite.
///
/// >>> camera = Camera(572.4, 573.6, 325.3, 242.0, 640, 480)
/// >>> camera.matrix[0].tolist()
/// [572.4, 0.0, 325.3]
#[pyclass(name = "Camera", module = "sixfold", frozen, eq, from_py_object)]
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct PyCamera(pub(crate) Camera);

/// Maximum number of pixels of a rendered image: 64 megapixels.
const MAX_PIXELS: u64 = 1 << 26;

impl PyCamera {
    /// The camera, or an error if no real lens has its parameters.
    fn checked(camera: Camera) -> PyResult<Self> {
        camera.check_lens().map_err(|error| pyo3::exceptions::PyValueError::new_err(error.to_string()))?;
        Ok(PyCamera(camera))
    }

    /// The camera, or an error if it has lens distortion.
    pub(crate) fn pinhole(&self) -> PyResult<Camera> {
        if self.0.distortion.is_some() {
            return Err(bad(
                "camera",
                "one without distortion",
                "lens distortion; undistort the image (undistort_rgb, undistort_depth) and give camera.without_distortion()",
            ));
        }
        Ok(self.0)
    }

    /// The camera, or an error if its image is too large to be rendered: running out of memory would end the interpreter.
    pub(crate) fn drawable(&self) -> PyResult<Camera> {
        let pixels = self.0.width as u64 * self.0.height as u64;
        if pixels > MAX_PIXELS {
            let found = format!("{} x {}", self.0.width, self.0.height);
            return Err(bad(
                "camera",
                format!("an image of at most {MAX_PIXELS} pixels for rendering"),
                found,
            ));
        }
        Ok(self.0)
    }

    /// The camera, or an error if it has lens distortion or its image is not of this size.
    pub(crate) fn of_image(&self, argument: &'static str, size: (usize, usize)) -> PyResult<Camera> {
        let camera = self.pinhole()?;
        camera.check_image(size.0, size.1).map_err(about(argument))?;
        Ok(camera)
    }
}

#[pymethods]
impl PyCamera {
    #[new]
    #[pyo3(signature = (fx, fy, cx, cy, width, height, distortion=None))]
    fn new(
        fx: f64,
        fy: f64,
        cx: f64,
        cy: f64,
        width: i64,
        height: i64,
        distortion: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<Self> {
        let distortion = match distortion {
            None => None,
            Some(object) => {
                let c = arrays::numbers("distortion", object)?;
                if c.len() != 4 && c.len() != 5 {
                    let expected = "4 or 5 coefficients (k1, k2, p1, p2[, k3])";
                    return Err(bad("distortion", expected, format!("{} of them", c.len())));
                }
                let k3 = c.get(4).copied().unwrap_or(0.0);
                Some(BrownConrady { k1: c[0], k2: c[1], p1: c[2], p2: c[3], k3 })
            }
        };
        let (width, height) = (whole("width", width, 1)?, whole("height", height, 1)?);
        let camera = Camera { fx, fy, cx, cy, width, height, distortion };
        PyCamera::checked(camera)
    }

    /// Reads a camera file. It holds fx, fy, cx, cy or a matrix, and optionally width, height, distortion and depth_scale, as
    /// written by BOP, OpenCV (YAML, XML, JSON) and ROS (CameraInfo, calibration files); or it is a scene_camera.json of one
    /// image.
    ///
    /// width, height: the image's size in pixels; not needed if the file states it. Returns the camera and the file's depth_scale
    /// (millimetres per unit of the depth image, or None).
    ///
    /// Raises OSError when the file cannot be read. Raises ValueError, with file and field, when the file is invalid, states
    /// another size, has an unknown key or a fisheye lens, or cannot be the camera of a whole image of that size (for example with
    /// a wrong unit or another resolution).
    ///
    /// >>> camera, mm_per_unit = Camera.load("data/demo/camera.json", 640, 480)  # doctest: +SKIP
    #[classmethod]
    #[pyo3(signature = (path, width=None, height=None))]
    fn load(
        _class: &Bound<'_, PyType>,
        py: Python<'_>,
        path: PathBuf,
        width: Option<i64>,
        height: Option<i64>,
    ) -> PyResult<(Self, Option<f64>)> {
        let file = free(py, || CameraFile::read(&path))?.map_err(camera_file_error)?;
        let (width, height) = match (width, height) {
            (Some(width), Some(height)) => (whole("width", width, 1)?, whole("height", height, 1)?),
            (None, None) if file.sized => (file.camera.width, file.camera.height),
            _ => {
                let expected = "the image's width and height, as the file does not state them";
                return Err(bad("width and height", expected, "one or none of them"));
            }
        };
        let camera = file.for_image(width, height, &path).map_err(camera_file_error)?;
        Ok((PyCamera(camera), file.depth_scale))
    }

    /// Focal length in x, pixels.
    #[getter]
    fn fx(&self) -> f64 {
        self.0.fx
    }

    /// Focal length in y, pixels.
    #[getter]
    fn fy(&self) -> f64 {
        self.0.fy
    }

    /// Principal point in x, pixels.
    #[getter]
    fn cx(&self) -> f64 {
        self.0.cx
    }

    /// Principal point in y, pixels.
    #[getter]
    fn cy(&self) -> f64 {
        self.0.cy
    }

    /// Image width, pixels.
    #[getter]
    fn width(&self) -> usize {
        self.0.width
    }

    /// Image height, pixels.
    #[getter]
    fn height(&self) -> usize {
        self.0.height
    }

    /// Distortion coefficients (k1, k2, p1, p2, k3), or None for a camera without distortion.
    #[getter]
    fn distortion(&self) -> Option<(f64, f64, f64, f64, f64)> {
        self.0.distortion.map(|d| (d.k1, d.k2, d.p1, d.p2, d.k3))
    }

    /// The intrinsic matrix K, (3, 3) float64.
    #[getter]
    fn matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::from_matrix3(py, &self.0.matrix())
    }

    /// Projects points (N, 3) in the camera frame, metres, to pinhole pixels (N, 2); NaN for points at or behind the camera.
    ///
    /// >>> Camera(500, 500, 320, 240, 640, 480).project([[0.1, 0.0, 1.0]])
    /// array([[370., 240.]])
    fn project<'py>(
        &self,
        py: Python<'py>,
        points: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let points = arrays::points3("points", points)?;
        arrays::from_points2(py, points.iter().map(|p| self.0.project(p)))
    }

    /// Computes the points (N, 3) in the camera frame, metres, from pinhole pixels (N, 2) and their depths (N,), metres.
    ///
    /// >>> Camera(500, 500, 320, 240, 640, 480).unproject([[370, 240]], [1.0])
    /// array([[0.1, 0. , 1. ]])
    fn unproject<'py>(
        &self,
        py: Python<'py>,
        pixels: &Bound<'py, PyAny>,
        depth: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let (pixels, depth) = (arrays::points2("pixels", pixels)?, arrays::numbers("depth", depth)?);
        if pixels.len() != depth.len() {
            return Err(bad(
                "depth",
                format!("{} numbers, one per pixel", pixels.len()),
                depth.len().to_string(),
            ));
        }
        let points: Vec<_> = pixels.iter().zip(&depth).map(|(p, z)| self.0.unproject(p, *z)).collect();
        arrays::from_points3(py, &points)
    }

    /// Converts pinhole pixels (N, 2) to pixels (N, 2) of the raw, distorted image.
    fn distort_points<'py>(
        &self,
        py: Python<'py>,
        pixels: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let pixels = arrays::points2("pixels", pixels)?;
        arrays::from_points2(py, pixels.iter().map(|p| Some(self.0.distort_point(p))))
    }

    /// Converts pixels (N, 2) of the raw, distorted image to pinhole pixels (N, 2); NaN where the distortion has no inverse.
    fn undistort_points<'py>(
        &self,
        py: Python<'py>,
        pixels: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let pixels = arrays::points2("pixels", pixels)?;
        arrays::from_points2(py, pixels.iter().map(|p: &Vec2| self.0.undistort_point(p)))
    }

    /// The same camera without distortion: the camera of an undistorted image.
    fn without_distortion(&self) -> PyCamera {
        PyCamera(self.0.without_distortion())
    }

    /// The camera of a crop of the image; box: (x, y, width, height) in pixels.
    ///
    /// >>> Camera(500, 500, 320, 240, 640, 480).crop((100, 50, 200, 200)).cx
    /// 220.0
    fn crop(&self, r#box: &Bound<'_, PyAny>) -> PyResult<PyCamera> {
        let boxes = arrays::boxes("box", r#box)?;
        let [rect] = boxes[..] else { return Err(bad("box", "one box", format!("{}", boxes.len()))) };
        if !(rect.width >= 1.0 && rect.height >= 1.0 && rect.width <= 1048576.0 && rect.height <= 1048576.0) {
            return Err(bad(
                "box",
                "a side of 1 to 1048576 pixels",
                format!("{} x {}", rect.width, rect.height),
            ));
        }
        PyCamera::checked(self.0.crop(&rect))
    }

    /// The camera of the image resized to width x height pixels.
    fn resize(&self, width: i64, height: i64) -> PyResult<PyCamera> {
        let camera = self.0.resize(whole("width", width, 1)?, whole("height", height, 1)?);
        PyCamera::checked(camera)
    }

    fn __repr__(&self) -> String {
        let c = &self.0;
        let lens = match self.distortion() {
            Some(d) => format!(", distortion={d:?}"),
            None => String::new(),
        };
        format!(
            "Camera(fx={}, fy={}, cx={}, cy={}, width={}, height={}{lens})",
            c.fx, c.fy, c.cx, c.cy, c.width, c.height
        )
    }

    fn __getnewargs__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        let c = &self.0;
        (c.fx, c.fy, c.cx, c.cy, c.width, c.height, self.distortion()).into_pyobject(py)
    }
}

/// Removes lens distortion from a colour image (H, W, 3) uint8. The result is the image of a pinhole camera with the same
/// intrinsics: interpolated bilinearly, black outside the raw image.
///
/// Raises ValueError when the image is not of the camera's size.
///
/// >>> import numpy as np
/// >>> camera = Camera(500, 500, 320, 240, 640, 480, distortion=(0.1, 0, 0, 0))
/// >>> undistort_rgb(np.zeros((480, 640, 3), np.uint8), camera).shape
/// (480, 640, 3)
#[pyfunction]
pub(crate) fn undistort_rgb<'py>(
    py: Python<'py>,
    rgb: &Bound<'py, PyAny>,
    camera: PyCamera,
) -> PyResult<Bound<'py, PyArray3<u8>>> {
    let image = arrays::rgb("rgb", rgb)?;
    let out = free(py, || sixfold::geometry::undistort_rgb(&image, &camera.0))?.map_err(about("rgb"))?;
    arrays::from_image_of(py, out)
}

/// Removes lens distortion from a depth image (H, W) float32 in metres. The result is the image of a pinhole camera with the same
/// intrinsics: values of the nearest raw pixel, 0 outside the raw image.
///
/// Raises ValueError when the image is not of the camera's size.
///
/// >>> import numpy as np
/// >>> camera = Camera(500, 500, 320, 240, 640, 480, distortion=(0.1, 0, 0, 0))
/// >>> undistort_depth(np.ones((480, 640), np.float32), camera).max()
/// np.float32(1.0)
#[pyfunction]
pub(crate) fn undistort_depth<'py>(
    py: Python<'py>,
    depth: &Bound<'py, PyAny>,
    camera: PyCamera,
) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let image = arrays::depth("depth", depth)?;
    let out = free(py, || sixfold::geometry::undistort_depth(&image, &camera.0))?.map_err(about("depth"))?;
    arrays::from_image(py, out)
}

/// Computes a pose (4, 4) from six numbers (v, w) by the exponential map of SE(3) (Barfoot 2017, section 7.1). v is in metres; w
/// is a rotation vector in radians.
///
/// >>> pose_exp([0.1, 0, 1, 0, 0, 0])[:3, 3]
/// array([0.1, 0. , 1. ])
#[pyfunction]
pub(crate) fn pose_exp<'py>(
    py: Python<'py>,
    twist: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let v = arrays::numbers("twist", twist)?;
    let v: [f64; 6] =
        v.try_into().map_err(|v: Vec<f64>| bad("twist", "6 numbers (v, w)", format!("{}", v.len())))?;
    arrays::from_pose(py, &sixfold::geometry::Pose::exp(&v.into()))
}

/// Computes the six numbers (v, w) of pose_exp from a pose (4, 4), for rotation angles below pi.
///
/// >>> pose_log(pose_exp([0.1, 0, 1, 0, 0, 0.5])).round(9) + 0
/// array([0.1, 0. , 1. , 0. , 0. , 0.5])
#[pyfunction]
pub(crate) fn pose_log<'py>(
    py: Python<'py>,
    pose: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let twist = arrays::pose("pose", pose)?.log();
    Ok(PyArray1::from_vec(py, twist.iter().copied().collect()))
}
