//! Every operation of this crate on a GPU against the kernels: values and gradients. Needs the feature `gpu` and a driver; software
//! drivers such as Mesa's llvmpipe will do.

#![cfg(feature = "gpu")]

use std::sync::Arc;

use burn::module::Param;
use burn::tensor::{Device, Tensor, TensorData};
use sixfold_nn::batch_norm::BatchNormConfig;
use sixfold_nn::conv_transpose::{TransposedSpec, conv_transpose};
use sixfold_nn::device::{self, Processor, ProcessorError};
use sixfold_nn::kernels::{Activation, ConvSpec, Places, Regions, SampledPixel};
use sixfold_nn::ops::{conv, doubled, pixel_shuffle, upsample};
use sixfold_nn::recurrent::{gather, lstm_cell};
use sixfold_nn::roi_align::roi_align;

fn tensor<const D: usize>(shape: [usize; D], seed: f32, device: &Device) -> Tensor<D> {
    let numbers: Vec<f32> =
        (0..shape.iter().product()).map(|i| ((i * i) as f32 * 0.013 + seed + i as f32).sin()).collect();
    Tensor::from_data(TensorData::new(numbers, shape), device)
}

type Operation = Box<dyn Fn(Tensor<4>) -> Tensor<4>>;

/// Output and gradient with respect to the input.
fn run(operation: &Operation, shape: [usize; 4], device: &Device) -> [Vec<f32>; 2] {
    let device = device.clone().autodiff();
    let x = tensor(shape, 0.3, &device).require_grad();
    let y = operation(x.clone());
    let gradients = (y.clone() * tensor(y.dims(), 2.0, &device)).sum().backward();
    [y.inner(), x.grad(&gradients).unwrap()].map(|t| t.try_into_vec_as().unwrap())
}

/// Name, shape of the input, and function of the operations.
fn operations() -> Vec<(String, [usize; 4], Operation)> {
    let mut all: Vec<(String, [usize; 4], Operation)> = vec![];
    for (kernel, stride, depthwise) in
        [(1, 1, false), (3, 1, false), (3, 2, false), (5, 2, true), (3, 1, true)]
    {
        let operation = move |x: Tensor<4>| {
            let (device, side) = (x.device(), x.dims()[2]);
            let spec = ConvSpec {
                stride,
                padding: ConvSpec::same(side, kernel, stride),
                groups: if depthwise { 6 } else { 1 },
                activation: Activation::Relu6,
            };
            let weight = tensor([6, if depthwise { 1 } else { 6 }, kernel, kernel], 1.0, &device);
            conv(x, weight, tensor([6], 4.0, &device), spec)
        };
        all.push((format!("convolution {kernel} {stride} {depthwise}"), [2, 6, 12, 12], Box::new(operation)));
    }
    let transposed = |x: Tensor<4>| {
        let weight = tensor([4, 7, 5, 5], 1.0, &x.device());
        conv_transpose(x, weight, TransposedSpec::same(5, 2))
    };
    all.push(("transposed convolution".into(), [3, 4, 5, 6], Box::new(transposed)));
    all.push(("repeated pixels".into(), [2, 3, 4, 5], Box::new(upsample)));
    all.push(("bilinear upsampling".into(), [2, 3, 4, 5], Box::new(doubled)));
    all.push(("pixel shuffle".into(), [2, 8, 4, 5], Box::new(|x| pixel_shuffle(x, 2))));
    let lstm = |x: Tensor<4>| {
        let (hidden, state) = lstm_cell(x.clone().narrow(1, 0, 12) * 2.0, x.narrow(1, 12, 3));
        Tensor::cat(vec![hidden, state], 1)
    };
    all.push(("LSTM cell".into(), [2, 15, 4, 5], Box::new(lstm)));
    let place = |pixel, x, y| SampledPixel { pixel, x, y };
    let images =
        vec![vec![place(0, 0.1, 0.2), place(3, 0.5, 0.99), place(7, 1.0, 0.0)], vec![place(5, 0.4, 0.7)]];
    let places = Arc::new(Places { size: [2, 4], images });
    all.push(("sampled maps".into(), [2, 3, 5, 6], Box::new(move |x| gather(x, places.clone()))));
    let boxes = vec![[2.0, 2.0, 20.0, 16.0], [8.0, 4.0, 90.0, 60.0], [-9.0, -30.0, 12.0, 5.0]];
    let regions = Regions { boxes, scale: 0.25, side: 3, samples: Some(2) };
    all.push(("RoIAlign".into(), [1, 4, 12, 20], Box::new(move |x| roi_align(x, regions.clone()))));
    for slope in [1.0, 0.0, 0.3] {
        let operation = move |x: Tensor<4>| {
            let mut layer = BatchNormConfig::new(5).init(&x.device());
            layer.weight = Param::from_tensor(tensor([5], 0.4, &x.device()));
            let residual = x.clone().flip([2]);
            layer.forward_rectified(x, Some(residual), slope)
        };
        all.push((format!("batch normalisation, slope {slope}"), [3, 5, 4, 6], Box::new(operation)));
    }
    all
}

#[test]
fn operations_on_a_gpu_are_those_of_the_kernels() {
    match device::choose(Processor::Gpu) {
        Ok(()) => {}
        Err(ProcessorError::NoGpu) => {
            eprintln!("skipped: no GPU, and no software driver");
            return;
        }
        Err(error) => panic!("{error}"),
    }
    let gpu = device::chosen();
    assert_ne!(gpu, Device::flex());
    for (name, shape, operation) in operations() {
        let pairs = run(&operation, shape, &Device::flex()).into_iter().zip(run(&operation, shape, &gpu));
        for ((cpu, gpu), what) in pairs.zip(["value", "gradient"]) {
            assert_eq!(cpu.len(), gpu.len(), "{name}: {what}");
            let scale = cpu.iter().fold(0.0f32, |m, v| m.max(v.abs()));
            assert!(scale > 0.01, "{name}: {what}: all are small");
            for (i, (a, b)) in cpu.iter().zip(&gpu).enumerate() {
                assert!((a - b).abs() <= 1e-4 * scale, "{name}: {what} {i}: {a} on the CPU, {b} on the GPU");
            }
        }
    }
}
