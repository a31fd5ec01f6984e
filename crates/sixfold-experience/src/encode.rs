//! Images and numbers as bytes: PNG for images that people may want to view, little-endian numbers for the rest.

use std::io::Cursor;
use std::path::Path;

use image::{DynamicImage, ImageBuffer, ImageFormat, Luma, Rgb};
use sixfold_geometry::nalgebra::Matrix4;
use sixfold_geometry::{Camera, Plane, Pose, Vec2, Vec3};
use sixfold_io::{ImageFile, ImageFileError};

use super::StoreError;
use crate::Attempt;
use crate::Crop;

/// Steps of the stored depth, metres: 6.5 m fit into 16 bits.
const DEPTH_STEP: f64 = 1e-4;

/// Depth, normals and VD-NOC as PNG files.
pub(super) struct Images {
    pub depth: Vec<u8>,
    pub normals: Vec<u8>,
    pub vd_noc: Vec<u8>,
}

pub(super) fn images(crop: &Crop) -> Option<Images> {
    let side = crop.side as u32;
    let depth = crop
        .points
        .iter()
        .zip(&crop.mask)
        .map(
            |(p, seen)| {
                if *seen { (f64::from(p[2]) / DEPTH_STEP).round().clamp(1.0, 65535.0) as u16 } else { 0 }
            },
        )
        .collect();
    let depth = ImageBuffer::<Luma<u16>, Vec<u16>>::from_raw(side, side, depth)?;
    let color = |values: &[[f32; 3]]| {
        let bytes =
            values.iter().flatten().map(|v| (127.5 + 127.5 * v).round().clamp(0.0, 255.0) as u8).collect();
        ImageBuffer::<Rgb<u8>, Vec<u8>>::from_raw(side, side, bytes)
    };
    Some(Images {
        depth: png(depth.into())?,
        normals: png(color(&crop.normals)?.into())?,
        vd_noc: png(color(&crop.vd_noc)?.into())?,
    })
}

fn png(image: DynamicImage) -> Option<Vec<u8>> {
    let mut bytes = Cursor::new(vec![]);
    image.write_to(&mut bytes, ImageFormat::Png).ok()?;
    Some(bytes.into_inner())
}

/// An image column, which must have the crop's size: larger images are not decoded.
fn stored<'a>(bytes: &'a [u8], field: &'static str, side: usize) -> ImageFile<'a> {
    ImageFile::of_bytes(Path::new(field), bytes).with_limit((side * side) as u64)
}

/// The crop of stored images. Points are computed from depth and camera. The extent could be as well, but it is stored, so that it
/// is exactly the one of the VD-NOC.
pub(super) fn crop(
    images: &Images,
    camera: &Camera,
    extent: crate::Extent,
    table: Option<Plane>,
) -> Result<Crop, (&'static str, String)> {
    let side = camera.width;
    let wrong = |field, error: ImageFileError| (field, error.to_string());
    let sized = |field, size: (usize, usize)| match size {
        (width, height) if (width, height) == (side, side) => Ok(()),
        (width, height) => Err((field, format!("{width}x{height} pixels, not {side}x{side}"))),
    };
    let depth = stored(&images.depth, "depth", side).units().map_err(|e| wrong("depth", e))?;
    sized("depth", depth.size())?;
    let color = |bytes: &[u8], field| -> Result<Vec<[f32; 3]>, (&'static str, String)> {
        let image = stored(bytes, field, side).rgb().map_err(|e| wrong(field, e))?;
        sized(field, image.size())?;
        Ok(image.as_slice().iter().map(|p| p.map(|v| (f32::from(v) - 127.5) / 127.5)).collect())
    };
    let mut normals = color(&images.normals, "normals")?;
    let mut vd_noc = color(&images.vd_noc, "vd_noc")?;
    let total = side * side;
    let (mut mask, mut points) = (vec![false; total], vec![[0.0; 3]; total]);
    for (i, &units) in depth.as_slice().iter().enumerate() {
        if units == 0 {
            (normals[i], vd_noc[i]) = ([0.0; 3], [0.0; 3]);
            continue;
        }
        mask[i] = true;
        let z = f64::from(units) * DEPTH_STEP;
        let p = camera.unproject(&Vec2::new((i % side) as f64, (i / side) as f64), z);
        points[i] = [p.x as f32, p.y as f32, p.z as f32];
    }
    let source = (0..total as u32).collect();
    Ok(Crop { side, camera: *camera, mask, source, normals, points, vd_noc, extent, table })
}

/// Bits, eight per byte, the first in the lowest bit.
pub(super) fn bits(values: &[bool]) -> Vec<u8> {
    values.chunks(8).map(|c| c.iter().enumerate().fold(0, |b, (k, v)| b | u8::from(*v) << k)).collect()
}

pub(super) fn from_bits(bytes: &[u8], count: usize) -> Option<Vec<bool>> {
    (bytes.len() == count.div_ceil(8)).then(|| (0..count).map(|i| bytes[i / 8] >> (i % 8) & 1 == 1).collect())
}

#[cfg(feature = "sqlite")]
pub(super) fn floats(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

#[cfg(feature = "sqlite")]
pub(super) fn from_floats(bytes: &[u8]) -> Vec<f32> {
    bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
}

/// Sixteen numbers of a pose's matrix, row by row.
pub(super) fn pose(pose: &Pose) -> Vec<u8> {
    let m = pose.to_matrix();
    (0..16).flat_map(|i| m[(i / 4, i % 4)].to_le_bytes()).collect()
}

/// Focal lengths and principal point.
pub(super) fn camera(camera: &Camera) -> Vec<u8> {
    [camera.fx, camera.fy, camera.cx, camera.cy].into_iter().flat_map(f64::to_le_bytes).collect()
}

/// Normal and offset of a plane.
pub(super) fn plane(plane: &Plane) -> Vec<u8> {
    let n = plane.normal;
    [n.x, n.y, n.z, plane.offset].into_iter().flat_map(f64::to_le_bytes).collect()
}

pub(super) fn from_plane(bytes: &[u8]) -> Option<Plane> {
    let &[x, y, z, offset] = doubles(bytes).as_slice() else { return None };
    let normal = Vec3::new(x, y, z);
    ((normal.norm() - 1.0).abs() < 1e-6 && offset.is_finite()).then_some(Plane { normal, offset })
}

/// A pose rounded to a millionth, which does not change when it is written and read.
pub(super) fn rounded(pose: &Pose) -> Vec<u8> {
    let m = pose.to_matrix();
    (0..12).flat_map(|i| ((m[(i / 4, i % 4)] * 1e6).round() as i64).to_le_bytes()).collect()
}

pub(super) fn from_pose(bytes: &[u8]) -> Option<Pose> {
    let numbers = doubles(bytes);
    (numbers.len() == 16)
        .then(|| Pose::from_matrix(&Matrix4::from_fn(|i, j| numbers[4 * i + j])).ok())
        .flatten()
}

pub(super) fn doubles(bytes: &[u8]) -> Vec<f64> {
    bytes
        .chunks_exact(8)
        .map(|b| f64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]]))
        .collect()
}

pub(super) fn vectors(vectors: &[Vec3]) -> Vec<u8> {
    vectors.iter().flat_map(|v| [v.x, v.y, v.z]).flat_map(f64::to_le_bytes).collect()
}

/// An attempt as text, and the key that identifies it, computed from everything but the time.
pub(super) fn attempt(attempt: &Attempt) -> Result<([u8; 16], String), StoreError> {
    let wrong = |field, found: String| StoreError::Field { id: 0, field, expected: "a finite number", found };
    attempt.check().map_err(|field| wrong(field, "none".to_owned()))?;
    let attempt = attempt.clone().rounded();
    let text = |a: &Attempt| serde_json::to_string(a).map_err(|e| wrong("attempt", e.to_string()));
    let key = key(&[text(&Attempt { time: 0, ..attempt.clone() })?.as_bytes()]);
    Ok((key, text(&attempt)?))
}

pub(super) fn from_attempt(id: i64, text: &str) -> Result<Attempt, StoreError> {
    let attempt: Attempt =
        serde_json::from_str(text).map_err(|e| StoreError::Attempt { id, reason: e.to_string() })?;
    match attempt.check() {
        Ok(()) => Ok(attempt),
        Err(field) => Err(StoreError::Attempt { id, reason: format!("no finite number in {field}") }),
    }
}

/// FNV-1a over 128 bits: the same bytes give the same key on every machine.
pub(super) fn key(parts: &[&[u8]]) -> [u8; 16] {
    const PRIME: u128 = 0x0000000001000000000000000000013B;
    let mut hash: u128 = 0x6c62272e07bb014262b821756295c58d;
    for part in parts {
        for byte in (part.len() as u64).to_le_bytes().iter().chain(part.iter()) {
            hash = (hash ^ u128::from(*byte)).wrapping_mul(PRIME);
        }
    }
    hash.to_be_bytes()
}
