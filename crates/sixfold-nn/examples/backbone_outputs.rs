//! Feature maps, logits and gradients of a backbone with given PyTorch weights, for `checks/backbones_vs_pytorch.py`.
//!
//! `backbone_outputs resnet50|densenet121|efficientnet-lite0|xfeat|xfeat-keypoints|u2netp WEIGHTS INPUT.safetensors OUTPUT.safetensors`: the input holds `x`
//! (`batch x 3 x height x width`) and `factor` (of the last map's shape), the output the maps (`map0` ..) and the `logits`; of a
//! training step the `loss` (mean of last map times factor, plus mean of the squared logits), every parameter's gradient and
//! every running statistic's new value. EfficientNet-Lite0, whose normalisation is folded, gives its seven maps alone. XFeat
//! takes pairs of features as `factor`; `xfeat-keypoints` gives `positions`, `scores` and `descriptors` of one image with values 0 to 1.
//! U2-Net-p (also for `checks/salient_vs_onnxruntime.py`) gives `salience`.

use std::collections::BTreeMap;
use std::error::Error;
use std::path::Path;

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use sixfold_geometry::RgbImage;
use sixfold_nn::densenet::DenseNet121Config;
use sixfold_nn::keypoints::{KeypointFinder, KeypointOptions};
use sixfold_nn::lite0::Lite0Config;
use sixfold_nn::resnet::ResNet50Config;
use sixfold_nn::salient::SalientNetwork;
use sixfold_nn::xfeat::{CHANNELS, XFeat};

type Outputs = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [network, weights, input, output] = arguments.as_slice() else {
        return Err(
            "expected resnet50|densenet121|efficientnet-lite0|xfeat|xfeat-keypoints|u2netp WEIGHTS INPUT.safetensors OUTPUT.safetensors"
                .into(),
        );
    };
    let bytes = std::fs::read(input)?;
    let file = SafeTensors::deserialize(&bytes)?;
    let read = |name: &str| -> Result<TensorData, Box<dyn Error>> {
        let x = file.tensor(name)?;
        let values: Vec<f32> = x.data().as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        Ok(TensorData::new(values, [x.shape()[0], x.shape()[1], x.shape()[2], x.shape()[3]]))
    };
    let data = [read("x")?, read("factor")?];

    let mut outputs = Outputs::new();
    let device = Device::default().autodiff();
    match network.as_str() {
        "resnet50" => {
            let network = ResNet50Config::imagenet().from_pytorch(Path::new(weights), &device)?;
            run(network, data, |n, x| n.features(x), |n, m| n.classify_map(m), &mut outputs)?;
        }
        "densenet121" => {
            let network = DenseNet121Config::imagenet().from_pytorch(Path::new(weights), &device)?;
            run(network, data, |n, x| n.features(x), |n, m| n.classify_map(m), &mut outputs)?;
        }
        "efficientnet-lite0" => {
            let device = Device::default();
            let network = Lite0Config { stages: 7 }.from_pytorch(Path::new(weights), &device)?;
            let [x, _] = data;
            for (i, map) in network.forward(Tensor::from_data(x, &device)).into_iter().enumerate() {
                keep(&mut outputs, format!("map{i}"), map)?;
            }
        }
        "xfeat" => {
            let device = Device::default();
            let network = xfeat(weights, &device)?;
            let [x, pairs] = data;
            let x = XFeat::normalised(Tensor::from_data(x, &device));
            keep(&mut outputs, "keypoints".to_owned(), network.keypoints(x.clone()))?;
            let seen = network.forward(x);
            keep(&mut outputs, "features".to_owned(), seen.features)?;
            keep(&mut outputs, "reliability".to_owned(), seen.reliability)?;
            let pairs = Tensor::<4>::from_data(pairs, &device);
            let count = pairs.dims()[0];
            let fine = network.fine_matches(pairs.reshape([count, 128]));
            keep(&mut outputs, "fine_matches".to_owned(), fine)?;
        }
        "xfeat-keypoints" => {
            let device = Device::default();
            let [x, _] = data;
            let found = KeypointFinder::new(xfeat(weights, &device)?, device)
                .find(&image_of(x)?, &KeypointOptions::default())?;
            let count = found.scores.len();
            let positions = found.positions.iter().flat_map(|p| [p.x as f32, p.y as f32]).collect();
            outputs.insert("positions".to_owned(), (vec![count, 2], positions));
            outputs.insert("scores".to_owned(), (vec![count], found.scores));
            outputs.insert("descriptors".to_owned(), (vec![count, CHANNELS], found.descriptors));
        }
        "u2netp" => {
            let device = Device::default();
            let network = match weights.as_str() {
                "shipped" => SalientNetwork::shipped(&device)?,
                file => SalientNetwork::load(Path::new(file), &device)?,
            };
            let [x, _] = data;
            keep(
                &mut outputs,
                "salience".to_owned(),
                network.layers().forward(Tensor::from_data(x, &device)),
            )?;
        }
        other => {
            let names = "resnet50, densenet121, efficientnet-lite0, xfeat, xfeat-keypoints or u2netp";
            return Err(format!("expected {names}, found {other}").into());
        }
    }
    write(&outputs, Path::new(output))
}

fn xfeat(weights: &str, device: &Device) -> Result<XFeat, Box<dyn Error>> {
    Ok(match weights {
        "shipped" => XFeat::shipped(device)?,
        file => XFeat::from_pytorch(Path::new(file), device)?,
    })
}

/// The first image of a batch, whose values are 0 to 1.
fn image_of(batch: TensorData) -> Result<RgbImage, Box<dyn Error>> {
    let batch = Tensor::<4>::from_data(batch, &Device::default());
    let [_, 3, height, width] = batch.dims() else { return Err("expected 3 channels".into()) };
    let values: Vec<f32> = batch.try_into_vec_as()?;
    let at = |x: usize, y: usize, c: usize| (values[(c * height + y) * width + x] * 255.0).round() as u8;
    Ok(RgbImage::from_fn(width, height, |x, y| [0, 1, 2].map(|c| at(x, y, c))))
}

fn run<M: Module>(
    network: M,
    [x, factor]: [TensorData; 2],
    features: impl Fn(&M, Tensor<4>) -> Vec<Tensor<4>>,
    classify: impl Fn(&M, Tensor<4>) -> Option<Tensor<2>>,
    outputs: &mut Outputs,
) -> Result<(), Box<dyn Error>> {
    let forward = |network: &M, device: &Device| {
        let maps = features(network, Tensor::from_data(x.clone(), device));
        let last = maps.last().cloned().ok_or("no maps")?;
        let logits = classify(network, last.clone()).ok_or("no classifier")?;
        Ok::<_, Box<dyn Error>>((maps, last, logits))
    };
    let device = Device::default();
    let (maps, _, logits) = forward(&network.valid(), &device)?;
    for (i, map) in maps.into_iter().enumerate() {
        keep(outputs, format!("map{i}"), map)?;
    }
    keep(outputs, "logits".to_owned(), logits)?;

    let device = device.autodiff();
    let (_, last, logits) = forward(&network, &device)?;
    let loss = (last * Tensor::from_data(factor, &device)).mean() + logits.square().mean();
    keep(outputs, "loss".to_owned(), loss.clone())?;
    let gradients = GradientsParams::from_grads(loss.backward(), &network);
    // A validation copy settles the running statistics.
    drop(network.valid());
    let mut collector = Collector { path: Vec::new(), gradients, outputs, error: None };
    network.visit(&mut collector);
    collector.error.map_or(Ok(()), Err)
}

fn keep<const D: usize>(outputs: &mut Outputs, name: String, t: Tensor<D>) -> Result<(), Box<dyn Error>> {
    outputs.insert(name, (t.dims().to_vec(), t.try_into_vec_as()?));
    Ok(())
}

struct Collector<'a> {
    path: Vec<String>,
    gradients: GradientsParams,
    outputs: &'a mut Outputs,
    error: Option<Box<dyn Error>>,
}

impl ModuleVisitor for Collector<'_> {
    fn enter_module(&mut self, name: &str, _container_type: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let name = self.path.join(".");
        let kept = match self.gradients.remove::<D>(param.id) {
            Some(gradient) => keep(self.outputs, format!("gradient {name}"), gradient),
            None => keep(self.outputs, format!("statistic {name}"), param.val()),
        };
        if let Err(error) = kept {
            self.error.get_or_insert(error);
        }
    }
}

fn write(outputs: &Outputs, path: &Path) -> Result<(), Box<dyn Error>> {
    let bytes: Vec<(&String, &Vec<usize>, Vec<u8>)> = outputs
        .iter()
        .map(|(name, (shape, values))| (name, shape, values.iter().flat_map(|v| v.to_le_bytes()).collect()))
        .collect();
    let mut views = Vec::new();
    for (name, shape, bytes) in &bytes {
        views.push((*name, TensorView::new(Dtype::F32, (*shape).clone(), bytes)?));
    }
    std::fs::write(path, safetensors::serialize(views, None)?)?;
    Ok(())
}
