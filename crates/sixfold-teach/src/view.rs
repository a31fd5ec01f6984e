//! Photographs with known poses, and their views of a volume.

use std::sync::Arc;

use rayon::prelude::*;
use sixfold_geometry::{Camera, DepthImage, Image, Mask, Pose, RgbImage, Vec2, Vec3};

/// Maximum number of samples along a side of a pixel when a photograph is made smaller.
const MAX_SAMPLES: f64 = 4.0;

/// A photograph with known camera and pose. The poses define the world frame: the board's, or an object's.
#[derive(Debug, Clone)]
pub struct PosedPhotograph {
    /// Its name in messages.
    pub name: String,
    /// The image, as stored.
    pub image: Arc<RgbImage>,
    /// Measured depth in metres, from the same pixels.
    pub depth: Option<Arc<DepthImage>>,
    /// A given mask of the pixels where the object is or may be, without lens distortion.
    pub mask: Option<Arc<Mask>>,
    /// The part of the mask where something may occlude the object; these pixels are ignored.
    pub hidden: Option<Arc<Mask>>,
    /// Its camera, with lens distortion.
    pub camera: Camera,
    /// Takes points of the world to the camera's frame.
    pub camera_from_world: Pose,
}

/// A box with sides along the axes of the world, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Volume {
    /// Smallest coordinates.
    pub low: Vec3,
    /// Largest coordinates.
    pub high: Vec3,
}

impl Volume {
    /// Its sides, metres.
    pub fn size(&self) -> Vec3 {
        self.high - self.low
    }

    /// Its centre.
    pub fn centre(&self) -> Vec3 {
        (self.low + self.high) * 0.5
    }

    /// The box with the same centre and sides multiplied by a factor.
    #[must_use]
    pub fn scaled(&self, factor: f64) -> Volume {
        let half = self.size() * (0.5 * factor);
        Volume { low: self.centre() - half, high: self.centre() + half }
    }

    /// The box enlarged by a length on each side.
    #[must_use]
    pub fn grown(&self, margin: f64) -> Volume {
        let margin = Vec3::repeat(margin);
        Volume { low: self.low - margin, high: self.high + margin }
    }

    /// The intersection with another box.
    #[must_use]
    pub fn within(&self, other: &Volume) -> Volume {
        Volume { low: self.low.sup(&other.low), high: self.high.inf(&other.high) }
    }

    /// The smallest and largest pixel coordinates of its projection in a pinhole camera; `None` if a part is
    /// behind the camera.
    pub(crate) fn seen_by(&self, pinhole: &Camera, camera_from_world: &Pose) -> Option<[Vec2; 2]> {
        let (mut low, mut high) = (Vec2::repeat(f64::INFINITY), Vec2::repeat(f64::NEG_INFINITY));
        for corner in self.corners() {
            let pixel = pinhole.project(&camera_from_world.transform_point(&corner))?;
            (low, high) = (low.inf(&pixel), high.sup(&pixel));
        }
        Some([low, high])
    }

    fn corners(&self) -> [Vec3; 8] {
        std::array::from_fn(|i| {
            let pick =
                |bit: usize, axis: usize| if i >> bit & 1 == 0 { self.low[axis] } else { self.high[axis] };
            Vec3::new(pick(0, 0), pick(1, 1), pick(2, 2))
        })
    }
}

/// A part of a photograph, without lens distortion, reduced to the size used for processing.
#[derive(Debug, Clone)]
pub(crate) struct View {
    pub image: RgbImage,
    pub camera: Camera,
    pub camera_from_world: Pose,
    /// The camera's centre in the world.
    pub eye: Vec3,
    /// Metres; 0 where nothing was measured.
    pub depth: Option<DepthImage>,
    /// A given mask of the pixels where the object is or may be.
    pub mask: Option<Mask>,
    /// The part of it where something may occlude the object.
    pub hidden: Option<Mask>,
}

impl View {
    /// The part of a photograph that shows a volume, at most `side` pixels wide and high; `None` if the volume is
    /// not in the image.
    pub fn new(photograph: &PosedPhotograph, volume: &Volume, side: usize) -> Option<View> {
        let pinhole = photograph.camera.without_distortion();
        let [low, high] = volume.seen_by(&pinhole, &photograph.camera_from_world)?;
        let most = Vec2::new(pinhole.width as f64 - 0.5, pinhole.height as f64 - 0.5);
        let (low, high) = (low.sup(&Vec2::repeat(-0.5)), high.inf(&most));
        let size = high - low;
        if !(size.min() >= 8.0) {
            return None;
        }
        let scale = (side as f64 / size.max()).min(1.0);
        let (width, height) = ((size.x * scale).round().max(8.0), (size.y * scale).round().max(8.0));
        let camera = Camera {
            fx: pinhole.fx * scale,
            fy: pinhole.fy * scale,
            cx: (pinhole.cx - low.x) * scale - 0.5,
            cy: (pinhole.cy - low.y) * scale - 0.5,
            width: width as usize,
            height: height as usize,
            distortion: None,
        };
        let source = |x: f64, y: f64| {
            photograph.camera.distort_point(&Vec2::new((x + 0.5) / scale + low.x, (y + 0.5) / scale + low.y))
        };
        let nearest =
            |x: usize, y: usize| nearest_pixel(&source(x as f64, y as f64), pinhole.width, pinhole.height);
        let (width, height) = (camera.width, camera.height);
        let depth = photograph.depth.as_ref().map(|depth| {
            Image::from_fn(width, height, |x, y| nearest(x, y).map_or(0.0, |pixel| depth[pixel]))
        });
        // Masks have no lens distortion.
        let of_mask = |mask: &Arc<Mask>| {
            Image::from_fn(width, height, |x, y| {
                let (u, v) = ((x as f64 + 0.5) / scale + low.x, (y as f64 + 0.5) / scale + low.y);
                nearest_pixel(&Vec2::new(u, v), mask.width(), mask.height()).is_some_and(|pixel| mask[pixel])
            })
        };
        let (mask, hidden) = (photograph.mask.as_ref().map(of_mask), photograph.hidden.as_ref().map(of_mask));
        let image = reduced(&photograph.image, (width, height), 1.0 / scale, &source);
        let eye = photograph.camera_from_world.inverse().translation();
        Some(View {
            image,
            camera,
            camera_from_world: photograph.camera_from_world,
            eye,
            depth,
            mask,
            hidden,
        })
    }

    /// The pixel and the depth of a point of the world; `None` behind the camera or outside the view.
    pub fn project(&self, point: &Vec3) -> Option<(Vec2, f64)> {
        let p = self.camera_from_world.transform_point(point);
        let pixel = self.camera.project(&p)?;
        let (w, h) = (self.camera.width as f64 - 1.0, self.camera.height as f64 - 1.0);
        (pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x <= w && pixel.y <= h).then_some((pixel, p.z))
    }

    /// Whether something may occlude the object at a pixel.
    pub fn is_hidden(&self, pixel: (usize, usize)) -> bool {
        self.hidden.as_ref().is_some_and(|hidden| hidden[pixel])
    }

    /// The point of the world at a pixel and a depth, metres.
    pub fn unproject(&self, x: f64, y: f64, depth: f64) -> Vec3 {
        self.camera_from_world.inverse().transform_point(&self.camera.unproject(&Vec2::new(x, y), depth))
    }
}

/// The pixel of an image nearest to a point; `None` outside.
pub(crate) fn nearest_pixel(p: &Vec2, width: usize, height: usize) -> Option<(usize, usize)> {
    let (x, y) = (p.x.round(), p.y.round());
    (x >= 0.0 && y >= 0.0 && x < width as f64 && y < height as f64).then_some((x as usize, y as usize))
}

/// The mean of bilinear samples within each pixel. `step` is a pixel's side in the source.
pub(crate) fn reduced(
    image: &RgbImage,
    (width, height): (usize, usize),
    step: f64,
    source: &(impl Fn(f64, f64) -> Vec2 + Sync),
) -> RgbImage {
    let samples = step.ceil().clamp(1.0, MAX_SAMPLES) as usize;
    let offset = |k: usize| (k as f64 + 0.5) / samples as f64 - 0.5;
    let pixel = |x: usize, y: usize| {
        let mut sum = [0.0; 3];
        for i in 0..samples * samples {
            let p = source(x as f64 + offset(i % samples), y as f64 + offset(i / samples));
            let color = bilinear_rgb(image, p.x, p.y);
            (0..3).for_each(|c| sum[c] += color[c]);
        }
        sum.map(|s| (s / (samples * samples) as f64).round() as u8)
    };
    let rows: Vec<[u8; 3]> =
        (0..height).into_par_iter().flat_map_iter(|y| (0..width).map(move |x| pixel(x, y))).collect();
    // The number of pixels matches the size.
    Image::from_vec(width, height, rows).unwrap_or_else(|_| Image::filled(width, height, [0; 3]))
}

/// The bilinearly interpolated colour; outside the image, that of the border.
pub(crate) fn bilinear_rgb(image: &RgbImage, x: f64, y: f64) -> [f64; 3] {
    let (x0, x1, fx) = neighbours(x, image.width());
    let (y0, y1, fy) = neighbours(y, image.height());
    let (a, b, c, d) = (image[(x0, y0)], image[(x1, y0)], image[(x0, y1)], image[(x1, y1)]);
    std::array::from_fn(|k| {
        let top = f64::from(a[k]) * (1.0 - fx) + f64::from(b[k]) * fx;
        let bottom = f64::from(c[k]) * (1.0 - fx) + f64::from(d[k]) * fx;
        top * (1.0 - fy) + bottom * fy
    })
}

/// The bilinearly interpolated value; outside the image, that of the border.
pub(crate) fn bilinear(image: &Image<f32>, x: f64, y: f64) -> f32 {
    let (x0, x1, fx) = neighbours(x, image.width());
    let (y0, y1, fy) = neighbours(y, image.height());
    let (fx, fy) = (fx as f32, fy as f32);
    let top = image[(x0, y0)] * (1.0 - fx) + image[(x1, y0)] * fx;
    let bottom = image[(x0, y1)] * (1.0 - fx) + image[(x1, y1)] * fx;
    top * (1.0 - fy) + bottom * fy
}

fn neighbours(x: f64, length: usize) -> (usize, usize, f64) {
    let x = x.clamp(0.0, length as f64 - 1.0);
    let low = x.floor();
    (low as usize, (low as usize + 1).min(length - 1), x - low)
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::BrownConrady;

    use super::*;

    #[test]
    fn masks_are_those_of_the_photograph_without_distortion() {
        let distortion = Some(BrownConrady { k1: 0.4, ..BrownConrady::default() });
        let camera = Camera { fx: 200.0, fy: 200.0, cx: 99.5, cy: 74.5, width: 200, height: 150, distortion };
        let left = Image::from_fn(200, 150, |x, _| x < 40);
        let photograph = PosedPhotograph {
            name: "p".to_owned(),
            image: Arc::new(Image::filled(200, 150, [0; 3])),
            depth: None,
            mask: Some(Arc::new(left.clone())),
            hidden: Some(Arc::new(left)),
            camera,
            camera_from_world: Pose::from_translation(Vec3::new(0.0, 0.0, 1.0)),
        };
        let wide = Volume { low: Vec3::new(-2.0, -2.0, 0.0), high: Vec3::new(2.0, 2.0, 0.1) };
        let view = View::new(&photograph, &wide, 200).unwrap();
        // The border is at column 39.5 of the pinhole's pixels, 60 pixels left of the centre.
        let border = (view.camera.cx - 60.0 * view.camera.fx / 200.0).round() as usize;
        let row = view.camera.height / 2;
        let mask = view.mask.as_ref().unwrap();
        assert!(mask[(border - 1, row)] && !mask[(border + 1, row)]);
        assert!(view.is_hidden((border - 1, row)) && !view.is_hidden((border + 1, row)));
    }
}
