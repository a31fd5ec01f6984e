//! Templates and keypoints of an object's views in a file: with the hash of their inputs at the beginning and a checksum at the end.

use std::io;
use std::path::Path;

use half::f16;
use sixfold_geometry::nalgebra::{DMatrix, Quaternion, UnitQuaternion};
use sixfold_geometry::{Camera, Pose, Vec3};
use sixfold_io::{fnv1a, limits, read_regular, write_atomically};
use sixfold_nn::xfeat::CHANNELS;

use crate::printed::{View, ViewKeypoint, from_byte, to_byte};
use crate::recognition::{self, Appearance};
use crate::sift::LENGTH;
use crate::templates::Template;

/// Magic bytes of such a file; the digit is the format's version.
const MAGIC: &[u8; 8] = b"sfviews4";
/// Bytes of a template without its cells: pose, focal length, side, number of cells, number of cells with a colour (all or none), number of cells
/// by which it is recognised.
const HEAD: usize = 8 * 8 + 4 * 4;
/// Bytes of a cell without its colour: number, feature, point.
const PER_CELL: usize = 2 + 2 * CHANNELS + 3 * 4;

/// Bytes of a view without its keypoints: pose, focal length, number of keypoints.
const VIEW_HEAD: usize = 8 * 8 + 4;
/// Bytes of a keypoint: size, orientation, point, descriptor.
const PER_KEYPOINT: usize = 5 * 4 + LENGTH;

fn write_pose(out: &mut Vec<u8>, pose: &Pose, focal: f64) {
    let (rotation, translation) = (pose.rotation(), pose.translation());
    let numbers = rotation.coords.iter().chain(translation.iter()).chain([&focal]);
    numbers.for_each(|v| out.extend_from_slice(&v.to_le_bytes()));
}

/// Writes the views of an object; `key` is the hash of their inputs.
pub(crate) fn write(path: &Path, key: u64, templates: &[Template], printed: &[View]) -> io::Result<()> {
    let mut out = Vec::new();
    out.extend_from_slice(MAGIC);
    out.extend_from_slice(&key.to_le_bytes());
    out.extend_from_slice(&(templates.len() as u32).to_le_bytes());
    for template in templates {
        write_pose(&mut out, &template.crop_from_object, template.camera.fx);
        out.extend_from_slice(&(template.camera.width as u32).to_le_bytes());
        out.extend_from_slice(&(template.cells.len() as u32).to_le_bytes());
        out.extend_from_slice(&(template.chromas.len() as u32).to_le_bytes());
        out.extend_from_slice(&(template.appearance.cells.len() as u32).to_le_bytes());
        template.cells.iter().for_each(|c| out.extend_from_slice(&c.to_le_bytes()));
        template.features.iter().for_each(|v| out.extend_from_slice(&f16::from_f32(*v).to_le_bytes()));
        template.points.as_flattened().iter().for_each(|v| out.extend_from_slice(&v.to_le_bytes()));
        let Appearance { cells, features } = &template.appearance;
        cells.iter().for_each(|c| out.extend_from_slice(&c.to_le_bytes()));
        let halves = features.iter().chain(template.chromas.as_flattened());
        halves.for_each(|v| out.extend_from_slice(&f16::from_f32(*v).to_le_bytes()));
    }
    out.extend_from_slice(&(printed.len() as u32).to_le_bytes());
    for view in printed {
        write_pose(&mut out, &view.view_from_object, view.focal);
        out.extend_from_slice(&(view.keypoints.len() as u32).to_le_bytes());
        for keypoint in &view.keypoints {
            let numbers = [keypoint.size, keypoint.orientation].into_iter().chain(keypoint.point);
            numbers.for_each(|v| out.extend_from_slice(&v.to_le_bytes()));
        }
        out.extend(view.descriptors.iter().map(|v| to_byte(*v)));
    }
    let sum = fnv1a(&out);
    out.extend_from_slice(&sum.to_le_bytes());
    write_atomically(path, &out)
}

/// The views of an object in a file.
pub(crate) type Kept = (Vec<Template>, Vec<View>);

/// The views of a file, `None` if it has another `key` or is damaged.
///
/// # Errors
/// If it exists but cannot be read.
pub(crate) fn read(path: &Path, key: u64) -> io::Result<Option<Kept>> {
    match read_regular(path, limits::DERIVED) {
        Ok(bytes) => Ok(decode(&bytes, key)),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
    }
}

fn decode(bytes: &[u8], key: u64) -> Option<Kept> {
    let (body, sum) = bytes.split_last_chunk::<8>()?;
    let mut rest = Reader(body.strip_prefix(MAGIC)?);
    if fnv1a(body).to_le_bytes() != *sum || u64::from_le_bytes(rest.take()?) != key {
        return None;
    }
    let count = u32::from_le_bytes(rest.take()?) as usize;
    if count > rest.0.len() / HEAD {
        return None;
    }
    let mut templates = Vec::with_capacity(count);
    for _ in 0..count {
        templates.push(rest.template()?);
    }
    let count = u32::from_le_bytes(rest.take()?) as usize;
    if count > rest.0.len() / VIEW_HEAD {
        return None;
    }
    let mut printed = Vec::with_capacity(count);
    for _ in 0..count {
        printed.push(rest.view()?);
    }
    rest.0.is_empty().then_some((templates, printed))
}

struct Reader<'a>(&'a [u8]);

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (first, rest) = self.0.split_first_chunk::<N>()?;
        self.0 = rest;
        Some(*first)
    }

    fn number(&mut self) -> Option<f64> {
        Some(f64::from_le_bytes(self.take()?)).filter(|v| v.is_finite())
    }

    fn single(&mut self) -> Option<f32> {
        Some(f32::from_le_bytes(self.take()?)).filter(|v| v.is_finite())
    }

    fn half(&mut self) -> Option<f32> {
        Some(f16::from_le_bytes(self.take()?).to_f32()).filter(|v| v.is_finite())
    }

    /// A pose and a focal length.
    fn pose(&mut self) -> Option<(Pose, f64)> {
        let mut numbers = [0.0; 8];
        for value in &mut numbers {
            *value = self.number()?;
        }
        let [i, j, k, w, x, y, z, focal] = numbers;
        let rotation = UnitQuaternion::try_new(Quaternion::new(w, i, j, k), 1e-6)?;
        Some((Pose::new(rotation, Vec3::new(x, y, z)), focal))
    }

    fn view(&mut self) -> Option<View> {
        let (view_from_object, focal) = self.pose()?;
        let count = u32::from_le_bytes(self.take()?) as usize;
        if count > self.0.len() / PER_KEYPOINT || focal <= 0.0 {
            return None;
        }
        let mut keypoints = Vec::with_capacity(count);
        for _ in 0..count {
            let [size, orientation] = [self.single()?, self.single()?];
            let point = [self.single()?, self.single()?, self.single()?];
            keypoints.push(ViewKeypoint { size, orientation, point });
        }
        let (descriptors, rest) = self.0.split_at_checked(count * LENGTH)?;
        self.0 = rest;
        let descriptors = DMatrix::from_iterator(LENGTH, count, descriptors.iter().map(|b| from_byte(*b)));
        keypoints.iter().all(|k| k.size > 0.0).then_some(View {
            focal,
            view_from_object,
            keypoints,
            descriptors,
        })
    }

    /// Numbers of cells, each below `most`.
    fn cells(&mut self, count: usize, most: usize) -> Option<Vec<u16>> {
        let (cells, rest) = self.0.split_at_checked(2 * count)?;
        self.0 = rest;
        let (cells, _) = cells.as_chunks::<2>();
        let cells: Vec<u16> = cells.iter().map(|c| u16::from_le_bytes(*c)).collect();
        cells.iter().all(|c| usize::from(*c) < most).then_some(cells)
    }

    fn template(&mut self) -> Option<Template> {
        let (crop_from_object, focal) = self.pose()?;
        let side = u32::from_le_bytes(self.take()?) as usize;
        let count = u32::from_le_bytes(self.take()?) as usize;
        let coloured = u32::from_le_bytes(self.take()?) as usize;
        let recognised = u32::from_le_bytes(self.take()?) as usize;
        if count > self.0.len() / PER_CELL || side > MAX_SIDE || (coloured != 0 && coloured != count) {
            return None;
        }
        let centre = 0.5 * (side as f64 - 1.0);
        let camera = Camera::new(focal, focal, centre, centre, side, side).ok()?;
        let mut template = Template {
            crop_from_object,
            camera,
            cells: Vec::new(),
            features: Vec::with_capacity(count * CHANNELS),
            points: Vec::with_capacity(count),
            chromas: Vec::with_capacity(coloured),
            appearance: Appearance::default(),
        };
        template.cells = self.cells(count, (side / sixfold_nn::xfeat::CELL).pow(2))?;
        for _ in 0..count * CHANNELS {
            template.features.push(self.half()?);
        }
        for _ in 0..count {
            template.points.push([self.single()?, self.single()?, self.single()?]);
        }
        template.appearance.cells = self.cells(recognised, (side / recognition::CELL).pow(2))?;
        for _ in 0..recognised * recognition::CHANNELS {
            template.appearance.features.push(self.half()?);
        }
        for _ in 0..coloured {
            template.chromas.push([self.half()?, self.half()?]);
        }
        Some(template)
    }
}

/// Longest side of a crop, pixels: beyond it, numbers of cells do not fit into 16 bits.
const MAX_SIDE: usize = 2048;

#[cfg(test)]
mod tests {
    use super::*;

    fn template(count: usize, coloured: bool) -> Template {
        Template {
            crop_from_object: Pose::exp(&[0.1, 0.2, 0.9, 0.3, -0.4, 0.5].into()),
            camera: Camera::new(500.0, 500.0, 79.5, 79.5, 160, 160).unwrap(),
            cells: (0..count as u16).map(|c| 3 * c).collect(),
            features: (0..count * CHANNELS).map(|i| (i % 16) as f32 / 16.0).collect(),
            points: (0..count).map(|i| [i as f32, 0.5, -0.25]).collect(),
            chromas: (0..count * usize::from(coloured)).map(|i| [0.25, -0.5 * i as f32]).collect(),
            appearance: Appearance {
                cells: (0..count as u16).collect(),
                features: (0..count * recognition::CHANNELS).map(|i| (i % 8) as f32 / 8.0).collect(),
            },
        }
    }

    #[test]
    fn templates_come_back_and_damaged_or_foreign_files_do_not() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("views.bin");
        assert!(read(&file, 7).unwrap().is_none(), "no file");
        let templates = [template(5, true), template(0, false), template(3, false)];
        let view = |count: usize| View {
            focal: 700.0,
            view_from_object: Pose::exp(&[0.1, -0.2, 0.9, 0.3, 0.4, 0.5].into()),
            keypoints: (0..count)
                .map(|i| ViewKeypoint {
                    size: 2.5,
                    orientation: 0.1 * i as f32,
                    point: [i as f32, 0.5, -0.25],
                })
                .collect(),
            descriptors: DMatrix::from_fn(LENGTH, count, |row, column| from_byte((row + column) as u8)),
        };
        write(&file, 7, &templates, &[view(3), view(0)]).unwrap();
        let (back, printed) = read(&file, 7).unwrap().unwrap();
        assert_eq!(back.len(), 3);
        assert_eq!(printed.len(), 2);
        for (back, view) in printed.iter().zip([view(3), view(0)]) {
            assert!(back.view_from_object.rotation_angle_to(&view.view_from_object) < 1e-7);
            assert_eq!((&back.keypoints, &back.descriptors), (&view.keypoints, &view.descriptors));
        }
        for (back, template) in back.iter().zip(&templates) {
            assert!(back.crop_from_object.distance_to(&template.crop_from_object) < 1e-12);
            assert!(back.crop_from_object.rotation_angle_to(&template.crop_from_object) < 1e-7);
            assert_eq!((back.camera, &back.cells), (template.camera, &template.cells));
            assert_eq!((&back.features, &back.points), (&template.features, &template.points));
            assert_eq!((&back.chromas, &back.appearance), (&template.chromas, &template.appearance));
        }
        assert!(read(&file, 8).unwrap().is_none(), "of another object");
        let whole = std::fs::read(&file).unwrap();
        for length in 0..whole.len() {
            assert!(decode(&whole[..length], 7).is_none(), "{length} bytes");
        }
        // A forged count with a valid checksum does not allocate memory.
        let mut forged = whole[..whole.len() - 8].to_vec();
        forged[16..20].copy_from_slice(&u32::MAX.to_le_bytes());
        let sum = fnv1a(&forged);
        forged.extend_from_slice(&sum.to_le_bytes());
        assert!(decode(&forged, 7).is_none());
    }
}
