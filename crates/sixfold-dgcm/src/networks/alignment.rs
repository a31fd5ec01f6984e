//! Alignment of two views in the experience's VD-NOC frame: render, compare, move, as Li et al. (2018, DeepIM) do with images.
//!
//! The decoder predicts where a view's pixels lie in the experience's frame without seeing the result. Here both views are drawn into
//! that frame, as seen along its z axis: the experience, and the view at its predicted coordinates. From the two drawings a small
//! network predicts how places of the frame have to be shifted, and an affine transformation of the coordinates is fitted to these
//! shifts; then the view is drawn again.

use burn::module::Module;
use burn::nn::Linear;
use burn::tensor::activation::leaky_relu;
use burn::tensor::{Device, Tensor, TensorData};
use rand::Rng;
use rayon::prelude::*;
use sixfold_geometry::nalgebra::{Matrix4, Matrix4x3, RowVector3, RowVector4, Vector4};
use sixfold_nn::dense::dense;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig};
use sixfold_nn::ops::upsample;

use super::{FEATURE, VIEW, numbers};

/// Side of a drawing in cells, and half of the side of the square that it covers.
const CELLS: usize = 40;
const HALF: f32 = 1.25;
const AREA: usize = CELLS * CELLS;
/// Planes of both drawings.
const PLANES: usize = 11;
/// Channels of the maps, at 1, 1/2, 1/4 and 1/8 of the drawing's resolution.
const CHANNELS: [usize; 4] = [24, 48, 64, 96];
/// Numbers that describe the whole pair, and channels with which these join the smallest map.
const HIDDEN: usize = 256;
const CONTEXT: usize = 32;
/// Channels behind the join.
const JOINED: usize = 64;
/// Side of the field of shifts: between its nodes shifts are interpolated.
pub(crate) const NODES: usize = CELLS / 4;
/// Favours small changes of the matrix where the object's pixels do not determine it, such as on a plane.
const RIDGE: f64 = 0.003;
const RIDGE_OF_SHIFT: f64 = 1e-6;
/// Slope of LeakyReLU in the dense layers.
const SLOPE: f64 = 0.1;

/// Predicts how to move a view's coordinates from drawings of both views.
#[derive(Module, Debug)]
#[module(custom_display)]
pub struct Alignment {
    convolutions: Vec<Conv>,
    hidden: Linear,
    context: Linear,
    joined: Vec<Conv>,
    head: Conv,
}

sixfold_nn::displayed_by_name!(Alignment);

impl Alignment {
    /// With random weights.
    pub(crate) fn init(rng: &mut impl Rng, device: &Device) -> Alignment {
        let mut inputs = PLANES;
        let convolutions = CHANNELS
            .iter()
            .enumerate()
            .map(|(k, &outputs)| {
                let stride = if k == 0 { 1 } else { 2 };
                let channels = [std::mem::replace(&mut inputs, outputs), outputs];
                ConvConfig::new(channels, 3, Activation::Relu).with_stride(stride).init(2.0, rng, device)
            })
            .collect();
        let smallest = (CELLS / 8).pow(2);
        let same = |channels: [usize; 2], rng: &mut _| {
            ConvConfig::new(channels, 3, Activation::Relu).init(2.0, rng, device)
        };
        Alignment {
            convolutions,
            hidden: dense([smallest * CHANNELS[3] + FEATURE, HIDDEN], rng, device),
            context: dense([HIDDEN, smallest * CONTEXT], rng, device),
            joined: vec![
                same([CHANNELS[3] + CONTEXT, JOINED], rng),
                same([JOINED + CHANNELS[2], JOINED], rng),
            ],
            head: ConvConfig::new([JOINED, 3], 3, Activation::Linear).init(0.1, rng, device),
        }
    }

    /// One that always predicts this shift, for tests.
    #[cfg(test)]
    pub(crate) fn constant(shift: [f32; 3], device: &Device) -> Alignment {
        let head = ConvConfig::new([JOINED, 3], 3, Activation::Linear);
        let head = head.with_values(vec![0.0; 3 * JOINED * 9], shift.to_vec(), device);
        Alignment { head, ..Alignment::init(&mut sixfold_geometry::random::stream(0, 0), device) }
    }

    /// The field of shifts (`batch x 3 x nodes x nodes`) that moves the coordinates of the first view of every pair onto the second.
    /// Gradients do not pass through the drawings.
    pub(crate) fn field(&self, coordinates: &[f32], pairs: &Pairs) -> Tensor<4> {
        let (batch, device) = (pairs.objects.len(), pairs.feature.device());
        let drawings = TensorData::new(pairs.drawings(coordinates), [batch, PLANES, CELLS, CELLS]);
        let mut maps = vec![Tensor::from_data(drawings, &device)];
        for convolution in &self.convolutions {
            maps.push(convolution.forward(maps[maps.len() - 1].clone()));
        }
        let (smallest, before) = (maps[4].clone(), maps[3].clone());
        let [_, channels, h, w] = smallest.dims();
        let whole =
            Tensor::cat(vec![smallest.clone().reshape([batch, channels * h * w]), pairs.feature.clone()], 1);
        let whole = leaky_relu(self.hidden.forward(whole), SLOPE);
        let context = self.context.forward(whole).reshape([batch, CONTEXT, h, w]);
        let x = self.joined[0].forward(Tensor::cat(vec![smallest, context], 1));
        let x = self.joined[1].forward(Tensor::cat(vec![upsample(x), before], 1));
        self.head.forward(x)
    }
}

/// What the rounds of an alignment need of both views of every pair of a batch.
pub(crate) struct Pairs {
    /// Pixels of a view.
    pixels: usize,
    /// Planes of the first views.
    views: Vec<f32>,
    /// The first views' features, `batch x 256`.
    feature: Tensor<2>,
    /// The pixels that show the object, of every first view.
    pub objects: Vec<Vec<usize>>,
    /// The drawings of the second views.
    experiences: Vec<Vec<f32>>,
}

impl Pairs {
    /// Of the first views (`batch x 6 x side x side`), their features (`batch x 256`), and the second views' VD-NOC
    /// (`batch x 3 x side x side`).
    pub(crate) fn new(views: &Tensor<4>, feature: Tensor<2>, vd_noc: &Tensor<4>) -> Pairs {
        let [_, _, height, width] = views.dims();
        let pixels = height * width;
        let (views, vd_noc) = (numbers(views), numbers(vd_noc));
        let objects = views.par_chunks_exact(VIEW * pixels).map(|view| object(view, pixels)).collect();
        let experiences = vd_noc.par_chunks_exact(3 * pixels);
        let experiences = experiences.map(|points| drawn(points, &object(points, pixels), &[])).collect();
        Pairs { pixels, views, feature, objects, experiences }
    }

    /// The planes of every pair: which cells the first view covers, its mean z, normals and own VD-NOC there; the first two of the
    /// second view; and the difference in z where both are.
    fn drawings(&self, coordinates: &[f32]) -> Vec<f32> {
        let of_pair = |(pair, coordinates): (usize, &[f32])| {
            let view = self.views.chunks_exact(self.pixels).skip(pair * VIEW).take(VIEW);
            let mut planes = drawn(coordinates, &self.objects[pair], &view.collect::<Vec<_>>());
            let (a, b) = (planes.as_slice(), self.experiences[pair].as_slice());
            let difference: Vec<f32> = (0..AREA).map(|i| (a[AREA + i] - b[AREA + i]) * a[i] * b[i]).collect();
            planes.extend(b);
            planes.extend(difference);
            planes
        };
        let pairs = coordinates.par_chunks_exact(3 * self.pixels).enumerate();
        pairs.map(of_pair).collect::<Vec<Vec<f32>>>().concat()
    }

    /// Moves the coordinates by the affine transformation that is nearest to the field of shifts on the object. The coordinates of two
    /// views are related by one, up to an error of about 0.04; the field alone is less exact.
    pub(crate) fn shift(&self, coordinates: &mut [f32], field: &Tensor<4>) {
        let pixels = self.pixels;
        let of_pair = |((coordinates, field), object): ((&mut [f32], &[f32]), &Vec<usize>)| {
            let place = |coordinates: &[f32], i: usize| {
                let [x, y, z] = [0, 1, 2].map(|k| f64::from(coordinates[k * pixels + i]));
                RowVector4::new(x, y, z, 1.0)
            };
            let (mut normal, mut right) = (Matrix4::zeros(), Matrix4x3::zeros());
            for &i in object {
                let nodes = interpolated(coordinates[i], coordinates[pixels + i]);
                let shift = |k: usize| {
                    let field = &field[k * NODES * NODES..];
                    f64::from(nodes.iter().map(|&(node, weight)| weight * field[node]).sum::<f32>())
                };
                let (place, shift) = (place(coordinates, i), RowVector3::from_fn(|_, k| shift(k)));
                normal += place.transpose() * place;
                right += place.transpose() * shift;
            }
            let count = object.len() as f64;
            normal += Matrix4::from_diagonal(&Vector4::new(RIDGE, RIDGE, RIDGE, RIDGE_OF_SHIFT)) * count;
            let Some(affine) = normal.cholesky().map(|system| system.solve(&right)) else { return };
            for &i in object {
                let shift = place(coordinates, i) * affine;
                for k in 0..3 {
                    let coordinate = &mut coordinates[k * pixels + i];
                    *coordinate = (f64::from(*coordinate) + shift[k]) as f32;
                }
            }
        };
        let fields = numbers(field);
        let coordinates = coordinates.par_chunks_exact_mut(3 * pixels);
        coordinates.zip(fields.par_chunks_exact(3 * NODES * NODES)).zip(&self.objects).for_each(of_pair);
    }
}

/// The pixels at which the first three planes of an image are not all zero.
fn object(planes: &[f32], pixels: usize) -> Vec<usize> {
    (0..pixels).filter(|&i| (0..3).any(|k| planes[k * pixels + i] != 0.0)).collect()
}

/// A place of the frame in a grid with `side` cells along each axis, in cells from the middle of the first.
fn in_grid(x: f32, y: f32, side: usize) -> [f32; 2] {
    [x, y].map(|c| (c + HALF) * (side as f32 / (2.0 * HALF)) - 0.5)
}

/// The four cells of a grid around a place that is inside it, with their weights.
fn around([u, v]: [f32; 2], side: usize) -> [(usize, f32); 4] {
    let (column, row) = (u as usize, v as usize);
    let (du, dv) = (u - column as f32, v - row as f32);
    let cell = row * side + column;
    [
        (cell, (1.0 - du) * (1.0 - dv)),
        (cell + 1, du * (1.0 - dv)),
        (cell + side, (1.0 - du) * dv),
        (cell + side + 1, du * dv),
    ]
}

/// The four nodes of a field around a place, the nearest if it is outside, with their weights.
pub(crate) fn interpolated(x: f32, y: f32) -> [(usize, f32); 4] {
    around(in_grid(x, y, NODES).map(|c| c.clamp(0.0, (NODES - 1) as f32 - 1e-3)), NODES)
}

/// How much the points of some pixels cover each cell (0 to 1), and their mean z and other values there. Each point counts in the four
/// cells around it.
fn drawn(points: &[f32], object: &[usize], others: &[&[f32]]) -> Vec<f32> {
    let pixels = points.len() / 3;
    let mut planes = vec![0.0f32; (2 + others.len()) * AREA];
    for &i in object {
        let [x, y, z] = [0, 1, 2].map(|k| points[k * pixels + i]);
        let place = in_grid(x, y, CELLS);
        if !place.iter().all(|c| (0.0..(CELLS - 1) as f32).contains(c)) {
            continue;
        }
        for (cell, weight) in around(place, CELLS) {
            planes[cell] += weight;
            planes[AREA + cell] += weight * z.clamp(-2.0, 2.0);
            for (k, other) in others.iter().enumerate() {
                planes[(2 + k) * AREA + cell] += weight * other[i];
            }
        }
    }
    let (weights, sums) = planes.split_at_mut(AREA);
    for sums in sums.chunks_exact_mut(AREA) {
        for (sum, weight) in sums.iter_mut().zip(&*weights) {
            *sum = if *weight > 0.05 { *sum / *weight } else { 0.0 };
        }
    }
    for weight in weights {
        *weight = weight.min(1.0);
    }
    planes
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;

    /// Coordinates of a slanted plane that a view shows at every pixel, and a pair of this view with itself.
    fn plane(side: usize) -> (Vec<f32>, Pairs) {
        let at = |i: usize| [(i % side) as f32, (i / side) as f32].map(|c| 1.6 * c / (side - 1) as f32 - 0.8);
        let pixels = side * side;
        let coordinates: Vec<f32> = (0..3 * pixels)
            .map(|i| {
                let [x, y] = at(i % pixels);
                [x, y, 0.5 * x - 0.3 * y][i / pixels]
            })
            .collect();
        let device = Device::flex();
        let image =
            |values, planes| Tensor::from_data(TensorData::new(values, [1, planes, side, side]), &device);
        let (view, vd_noc) = (image(vec![0.5; VIEW * pixels], VIEW), image(coordinates.clone(), 3));
        (coordinates, Pairs::new(&view, Tensor::zeros([1, FEATURE], &device), &vd_noc))
    }

    #[test]
    fn points_are_drawn_into_the_four_cells_around_them() {
        // A quarter of a cell right of the middle, where four cells meet; the second point is outside.
        let quarter = 0.25 * 2.0 * HALF / CELLS as f32;
        let points = [quarter, 9.0, 0.0, 0.0, 0.6, 0.6];
        let planes = drawn(&points, &[0, 1], &[&[0.25, 7.0]]);
        let (n, middle) = (AREA, CELLS / 2);
        for (row, column, weight) in [
            (middle - 1, middle - 1, 0.125),
            (middle - 1, middle, 0.375),
            (middle, middle - 1, 0.125),
            (middle, middle, 0.375),
        ] {
            let cell = row * CELLS + column;
            let found = [0, 1, 2].map(|k| planes[k * n + cell]);
            assert!(found.iter().zip([weight, 0.6, 0.25]).all(|(a, b)| (a - b).abs() < 1e-5), "{found:?}");
        }
        assert!((planes[..n].iter().sum::<f32>() - 1.0).abs() < 1e-5);
    }

    #[test]
    fn a_view_in_its_place_differs_nowhere_from_itself() {
        let (coordinates, pairs) = plane(96);
        let (drawings, n) = (pairs.drawings(&coordinates), AREA);
        assert_eq!(drawings[..2 * n], drawings[8 * n..10 * n]);
        assert!(drawings[10 * n..].iter().all(|d| *d == 0.0));
        assert!(drawings[..n].iter().filter(|c| **c > 0.9).count() > 400);
    }

    #[test]
    fn coordinates_move_with_the_field() {
        let (before, mut pairs) = plane(48);
        // A turn around the z axis by a small angle, and a shift: at every node, the shift of its place.
        let node = |i: usize| {
            let along = |n: usize| (n as f32 + 0.5) * 2.0 * HALF / NODES as f32 - HALF;
            [along(i % NODES), along(i / NODES)]
        };
        let field: Vec<f32> = (0..3 * NODES * NODES)
            .map(|i| {
                let [x, y] = node(i % (NODES * NODES));
                [0.05 - 0.1 * y, 0.1 * x, -0.2][i / (NODES * NODES)]
            })
            .collect();
        let field = Tensor::from_data(TensorData::new(field, [1, 3, NODES, NODES]), &Device::flex());
        let mut after = before.clone();
        pairs.shift(&mut after, &field);
        let pixels = 48 * 48;
        for i in (0..pixels).step_by(97) {
            let [x, y, z] = [0, 1, 2].map(|k| before[k * pixels + i]);
            let expected = [x + 0.05 - 0.1 * y, y + 0.1 * x, z - 0.2];
            for k in 0..3 {
                let found = after[k * pixels + i];
                assert!((found - expected[k]).abs() < 0.01, "{i} {k}: {found}, expected {}", expected[k]);
            }
        }
        // Where the view does not show the object nothing moves.
        pairs.objects = vec![vec![]];
        let mut nothing = before.clone();
        pairs.shift(&mut nothing, &field);
        assert_eq!(before, nothing);
    }
}
