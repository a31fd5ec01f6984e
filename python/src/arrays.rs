//! Conversion of numpy arrays to checked values and back. Input is copied once, because the interpreter lock is released while
//! it is used, and another thread could write to it meanwhile. Images and masks are returned without a copy.
//!
//! Every invalid value raises a `ValueError` with the argument's name, what was expected and what was found.

use numpy::PyUntypedArrayMethods;
use numpy::{
    Element, PyArray1, PyArray2, PyArray3, PyArrayDescrMethods, PyArrayDyn, PyArrayMethods, PyUntypedArray,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sixfold::bop::Placement;
use sixfold::geometry::nalgebra::{Matrix4, Vector2, Vector3};
use sixfold::geometry::{
    DepthImage, Image, Mask, Mat3, NormalImage, PointImage, Pose, Rect, RgbImage, Vec2, Vec3,
};

/// A `ValueError` in the common form of all arguments.
pub(crate) fn bad(argument: &str, expected: impl AsRef<str>, found: impl AsRef<str>) -> PyErr {
    PyValueError::new_err(format!("{argument}: expected {}, found {}", expected.as_ref(), found.as_ref()))
}

/// A `ValueError` with the argument's name before the library's message.
pub(crate) fn about<E: std::fmt::Display>(argument: &'static str) -> impl Fn(E) -> PyErr {
    move |error| PyValueError::new_err(format!("{argument}: {error}"))
}

/// A whole number from `minimum`.
pub(crate) fn whole(argument: &str, value: i64, minimum: i64) -> PyResult<usize> {
    if value < minimum {
        return Err(bad(argument, format!("a whole number from {minimum}"), value.to_string()));
    }
    usize::try_from(value).map_err(|_| bad(argument, "a smaller number", value.to_string()))
}

/// A seed, from 0.
pub(crate) fn seed(value: i64) -> PyResult<u64> {
    whole("seed", value, 0).map(|s| s as u64)
}

/// The id of a scene, image or object.
pub(crate) fn id(argument: &str, value: i64) -> PyResult<u32> {
    u32::try_from(value).map_err(|_| bad(argument, "an id from 0 to 4294967295", value.to_string()))
}

/// Pairs of scene and image id.
pub(crate) fn pairs(argument: &str, list: &Bound<'_, PyAny>) -> PyResult<Vec<(u32, u32)>> {
    let pairs: Vec<(i64, i64)> = list
        .extract()
        .map_err(|_| bad(argument, "a list of pairs (scene_id, im_id)", list.get_type().to_string()))?;
    pairs.into_iter().map(|(s, i)| Ok((id(argument, s)?, id(argument, i)?))).collect()
}

/// A finite number above zero.
pub(crate) fn positive(argument: &str, value: f64) -> PyResult<f64> {
    if value.is_finite() && value > 0.0 {
        return Ok(value);
    }
    Err(bad(argument, "a finite number above zero", value.to_string()))
}

/// The permitted type of an argument: numpy's kinds, the type it is converted to, and its name in messages.
struct Type {
    kinds: &'static [u8],
    dtype: &'static str,
    words: &'static str,
}

const REAL: Type = Type { kinds: b"fiu", dtype: "float64", words: "real numbers (float64)" };
const METRES: Type = Type {
    kinds: b"f",
    dtype: "float32",
    words: "float32 or float64 in metres (a depth image in integer units has to be scaled first)",
};
const COLOR: Type = Type { kinds: b"u", dtype: "uint8", words: "uint8 from 0 to 255" };
const MASK: Type = Type { kinds: b"b", dtype: "bool", words: "bool" };
const WHOLE: Type = Type { kinds: b"iu", dtype: "int64", words: "whole numbers (int64)" };

struct Numbers<T> {
    shape: Vec<usize>,
    values: Vec<T>,
}

fn shape_words(shape: &[Option<usize>]) -> String {
    const NAMES: [&str; 3] = ["N", "M", "K"];
    let words: Vec<String> = shape
        .iter()
        .enumerate()
        .map(|(i, side)| side.map_or_else(|| NAMES[i.min(2)].to_owned(), |n| n.to_string()))
        .collect();
    if words.len() == 1 { format!("({},)", words[0]) } else { format!("({})", words.join(", ")) }
}

/// The values, row by row, of an array or of an object that numpy converts to one.
fn read<T: Element + Copy>(
    argument: &str,
    object: &Bound<'_, PyAny>,
    of: &Type,
    shape: &[Option<usize>],
) -> PyResult<Numbers<T>> {
    let py = object.py();
    let numpy = py.import("numpy")?;
    let expected = || format!("an array of shape {} of {}", shape_words(shape), of.words);
    let array = match object.cast::<PyUntypedArray>() {
        Ok(array) => array.clone(),
        Err(_) => numpy
            .call_method1("asarray", (object,))
            .map_err(|error| bad(argument, expected(), error.value(py).to_string()))?
            .cast_into::<PyUntypedArray>()
            .map_err(|_| bad(argument, expected(), "something else"))?,
    };
    let found: Vec<usize> = array.shape().to_vec();
    let fits = found.len() == shape.len() && found.iter().zip(shape).all(|(f, s)| s.is_none_or(|s| s == *f));
    let kind = array.dtype().kind();
    // numpy makes a float64 array of an empty list; it has no value that could be of a wrong kind.
    let empty = found.contains(&0) && fits;
    if !fits || !(of.kinds.contains(&kind) || empty) || (of.dtype == "uint8" && array.dtype().itemsize() != 1)
    {
        let found =
            format!("shape {:?} of {}", found, array.dtype().str()?).replace('[', "(").replace(']', ")");
        return Err(bad(argument, expected(), found));
    }
    let options = PyDict::new(py);
    options.set_item("dtype", of.dtype)?;
    options.set_item("order", "C")?;
    let array = numpy.call_method("asarray", (array,), Some(&options))?;
    let array = array.cast::<PyArrayDyn<T>>().map_err(|_| bad(argument, expected(), "another type"))?;
    let readable =
        array.try_readonly().map_err(|error| bad(argument, "a readable array", error.to_string()))?;
    let values = readable.as_slice().map_err(|error| bad(argument, expected(), error.to_string()))?.to_vec();
    Ok(Numbers { shape: found, values })
}

fn finite(argument: &str, numbers: &Numbers<f64>) -> PyResult<()> {
    let Some(at) = numbers.values.iter().position(|v| !v.is_finite()) else { return Ok(()) };
    let mut index = vec![0; numbers.shape.len()];
    let mut rest = at;
    for (slot, side) in index.iter_mut().zip(&numbers.shape).rev() {
        *slot = rest % side;
        rest /= side;
    }
    Err(bad(argument, "finite numbers", format!("{} at index {index:?}", numbers.values[at])))
}

/// `(N, 3)` finite points or directions.
pub(crate) fn points3(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<Vec<Vec3>> {
    let numbers = read::<f64>(argument, object, &REAL, &[None, Some(3)])?;
    finite(argument, &numbers)?;
    Ok(numbers.values.as_chunks::<3>().0.iter().map(|p| Vector3::from(*p)).collect())
}

/// `(N, 2)` finite image points in pixels.
pub(crate) fn points2(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<Vec<Vec2>> {
    let numbers = read::<f64>(argument, object, &REAL, &[None, Some(2)])?;
    finite(argument, &numbers)?;
    Ok(numbers.values.as_chunks::<2>().0.iter().map(|p| Vector2::from(*p)).collect())
}

/// `(N, 2)` finite numbers of any range, for texture coordinates.
pub(crate) fn pairs_f32(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<Vec<[f32; 2]>> {
    let numbers = read::<f64>(argument, object, &REAL, &[None, Some(2)])?;
    finite(argument, &numbers)?;
    Ok(numbers.values.as_chunks::<2>().0.iter().map(|p| p.map(|v| v as f32)).collect())
}

/// `(N,)` finite numbers.
pub(crate) fn numbers(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<Vec<f64>> {
    let numbers = read::<f64>(argument, object, &REAL, &[None])?;
    finite(argument, &numbers)?;
    Ok(numbers.values)
}

/// Exactly three finite numbers.
pub(crate) fn vector3(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<Vec3> {
    let numbers = read::<f64>(argument, object, &REAL, &[Some(3)])?;
    finite(argument, &numbers)?;
    Ok(Vector3::new(numbers.values[0], numbers.values[1], numbers.values[2]))
}

/// A `(3, 3)` matrix of finite numbers.
pub(crate) fn matrix3(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<Mat3> {
    let numbers = read::<f64>(argument, object, &REAL, &[Some(3), Some(3)])?;
    finite(argument, &numbers)?;
    Ok(Mat3::from_row_slice(&numbers.values))
}

/// A `(4, 4)` pose; its rotation is replaced by the nearest exact one.
pub(crate) fn pose(argument: &'static str, object: &Bound<'_, PyAny>) -> PyResult<Pose> {
    let numbers = read::<f64>(argument, object, &REAL, &[Some(4), Some(4)])?;
    finite(argument, &numbers)?;
    Pose::from_matrix(&Matrix4::from_row_slice(&numbers.values)).map_err(about(argument))
}

/// A `(4, 4)` pose with its rotation unchanged. Errors are computed with it, as the official BOP toolkit does.
pub(crate) fn placement(argument: &'static str, object: &Bound<'_, PyAny>) -> PyResult<Placement> {
    pose(argument, object)?;
    let v = read::<f64>(argument, object, &REAL, &[Some(4), Some(4)])?.values;
    let rotation = Mat3::new(v[0], v[1], v[2], v[4], v[5], v[6], v[8], v[9], v[10]);
    Ok(Placement { rotation, translation: Vec3::new(v[3], v[7], v[11]) })
}

/// `(S, 4, 4)` poses.
pub(crate) fn poses(argument: &'static str, object: &Bound<'_, PyAny>) -> PyResult<Vec<Pose>> {
    let numbers = read::<f64>(argument, object, &REAL, &[None, Some(4), Some(4)])?;
    finite(argument, &numbers)?;
    numbers
        .values
        .as_chunks::<16>()
        .0
        .iter()
        .enumerate()
        .map(|(index, values)| {
            Pose::from_matrix(&Matrix4::from_row_slice(values))
                .map_err(|error| PyValueError::new_err(format!("{argument}: pose {index}: {error}")))
        })
        .collect()
}

fn image<T>(argument: &str, shape: &[usize], values: Vec<T>) -> PyResult<Image<T>> {
    if shape[0] == 0 || shape[1] == 0 {
        return Err(bad(argument, "at least one pixel", format!("{} rows, {} columns", shape[0], shape[1])));
    }
    Image::from_vec(shape[1], shape[0], values)
        .map_err(|error| PyValueError::new_err(format!("{argument}: {error}")))
}

/// `(H, W)` depth in metres; values that are not finite and positive are missing.
pub(crate) fn depth(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<DepthImage> {
    let numbers = read::<f32>(argument, object, &METRES, &[None, None])?;
    image(argument, &numbers.shape, numbers.values)
}

/// `(H, W, 3)` colour image.
pub(crate) fn rgb(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<RgbImage> {
    let numbers = read::<u8>(argument, object, &COLOR, &[None, None, Some(3)])?;
    image(argument, &numbers.shape, numbers.values.as_chunks::<3>().0.to_vec())
}

/// `(H, W)` mask.
pub(crate) fn mask(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<Mask> {
    let numbers = read::<bool>(argument, object, &MASK, &[None, None])?;
    image(argument, &numbers.shape, numbers.values)
}

/// `(H, W, 3)` normals; zero where unknown.
pub(crate) fn normal_image(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<NormalImage> {
    let numbers = read::<f32>(argument, object, &METRES, &[None, None, Some(3)])?;
    image(argument, &numbers.shape, numbers.values.as_chunks::<3>().0.to_vec())
}

/// `(N, 3)` colours.
pub(crate) fn colors(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<Vec<[u8; 3]>> {
    let numbers = read::<u8>(argument, object, &COLOR, &[None, Some(3)])?;
    Ok(numbers.values.as_chunks::<3>().0.to_vec())
}

/// `(F, 3)` vertex indices.
pub(crate) fn faces(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<Vec<[u32; 3]>> {
    let numbers = read::<i64>(argument, object, &WHOLE, &[None, Some(3)])?;
    let corner = |v: i64| u32::try_from(v).map_err(|_| bad(argument, "vertex indices from 0", v.to_string()));
    numbers
        .values
        .as_chunks::<3>()
        .0
        .iter()
        .map(|[a, b, c]| Ok([corner(*a)?, corner(*b)?, corner(*c)?]))
        .collect()
}

/// `(N,)` ids.
pub(crate) fn ids(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<Vec<u32>> {
    read::<i64>(argument, object, &WHOLE, &[None])?.values.into_iter().map(|v| id(argument, v)).collect()
}

/// `(N, 4)` boxes `x, y, width, height` in pixels; a single box may be `(4,)`.
pub(crate) fn boxes(argument: &str, object: &Bound<'_, PyAny>) -> PyResult<Vec<Rect>> {
    let numbers = match read::<f64>(argument, object, &REAL, &[Some(4)]) {
        Ok(one) => one,
        Err(_) => read::<f64>(argument, object, &REAL, &[None, Some(4)])?,
    };
    finite(argument, &numbers)?;
    let rect = |[x, y, width, height]: &[f64; 4]| Rect { x: *x, y: *y, width: *width, height: *height };
    Ok(numbers.values.as_chunks::<4>().0.iter().map(rect).collect())
}

fn rows<'py, T: Element>(
    py: Python<'py>,
    values: Vec<T>,
    columns: usize,
) -> PyResult<Bound<'py, PyArray2<T>>> {
    let count = values.len() / columns;
    PyArray1::from_vec(py, values).reshape([count, columns])
}

/// `(N, 3)`.
pub(crate) fn from_points3<'py>(py: Python<'py>, points: &[Vec3]) -> PyResult<Bound<'py, PyArray2<f64>>> {
    rows(py, points.iter().flat_map(|p| [p.x, p.y, p.z]).collect(), 3)
}

/// `(N, 2)`, NaN where there is no point.
pub(crate) fn from_points2<'py>(
    py: Python<'py>,
    points: impl Iterator<Item = Option<Vec2>>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    rows(py, points.flat_map(|p| p.map_or([f64::NAN; 2], |p| [p.x, p.y])).collect(), 2)
}

/// `(N, K)` of any element type.
pub(crate) fn from_rows<'py, T: Element, const K: usize>(
    py: Python<'py>,
    values: Vec<[T; K]>,
) -> PyResult<Bound<'py, PyArray2<T>>> {
    rows(py, values.into_flattened(), K)
}

fn pose_values(pose: &Pose) -> [f64; 16] {
    let m = pose.to_matrix();
    std::array::from_fn(|i| m[(i / 4, i % 4)])
}

/// `(4, 4)`.
pub(crate) fn from_pose<'py>(py: Python<'py>, pose: &Pose) -> PyResult<Bound<'py, PyArray2<f64>>> {
    rows(py, pose_values(pose).to_vec(), 4)
}

/// `(4, 4)`, with the rotation unchanged.
pub(crate) fn from_placement<'py>(
    py: Python<'py>,
    placement: &Placement,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let (r, t) = (&placement.rotation, &placement.translation);
    let mut values = vec![0.0; 16];
    for row in 0..3 {
        for column in 0..3 {
            values[4 * row + column] = r[(row, column)];
        }
        values[4 * row + 3] = t[row];
    }
    values[15] = 1.0;
    rows(py, values, 4)
}

/// `(3, 3)`.
pub(crate) fn from_matrix3<'py>(py: Python<'py>, m: &Mat3) -> PyResult<Bound<'py, PyArray2<f64>>> {
    rows(py, m.transpose().as_slice().to_vec(), 3)
}

/// `(3,)`.
pub(crate) fn from_vector3<'py>(py: Python<'py>, v: &Vec3) -> Bound<'py, PyArray1<f64>> {
    PyArray1::from_vec(py, vec![v.x, v.y, v.z])
}

/// `(S, 4, 4)`.
pub(crate) fn from_poses<'py>(py: Python<'py>, poses: &[Pose]) -> PyResult<Bound<'py, PyArray3<f64>>> {
    let values: Vec<f64> = poses.iter().flat_map(pose_values).collect();
    PyArray1::from_vec(py, values).reshape([poses.len(), 4, 4])
}

/// `(H, W)`, without a copy.
pub(crate) fn from_image<'py, T: Element>(
    py: Python<'py>,
    image: Image<T>,
) -> PyResult<Bound<'py, PyArray2<T>>> {
    let (width, height) = image.size();
    PyArray1::from_vec(py, image.into_vec()).reshape([height, width])
}

/// `(H, W, K)`, without a copy.
pub(crate) fn from_image_of<'py, T: Element, const K: usize>(
    py: Python<'py>,
    image: Image<[T; K]>,
) -> PyResult<Bound<'py, PyArray3<T>>> {
    let (width, height) = image.size();
    PyArray1::from_vec(py, image.into_vec().into_flattened()).reshape([height, width, K])
}

/// `(H, W, 3)` points, without a copy.
pub(crate) fn from_point_image<'py>(
    py: Python<'py>,
    image: PointImage,
) -> PyResult<Bound<'py, PyArray3<f32>>> {
    from_image_of(py, image)
}
