//! The training of Faster R-CNN, Mask R-CNN and RetinaNet: image after image through the network, gradients summed over a batch,
//! AdamW. The constants are torchvision's, but for EfficientNet-Lite0's number of proposals; its normalisations are frozen, too.

use std::sync::Arc;

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use serde::Serialize;
use sixfold_geometry::random::{Random, stream};
use sixfold_nn::device;
use sixfold_nn::kernels::{Regions, roi_align_forward};
use sixfold_nn::learner::{Checkpointed, Learner};
use sixfold_nn::options::{OptionError, Pace};
use sixfold_nn::parameters::{GradientSum, gradients_of};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::{Batches, Losses, Plan, Training};

use super::anchors::{Scales, anchors};
use super::boxes::Corners;
use super::config::AnchoredConfig;
use super::faster::FasterRcnn;
use super::heads::Levels;
use super::loss::{Layout, LevelTargets, Term, classified, masked};
use super::masks::MASK_SIDE;
use super::matching::{Limits, Match, balanced, matches};
use super::network::{AnchoredNetwork, Layers, normalise, vector};
use super::retina::RetinaNet;
use super::rpn::{LevelOutput, Most, proposals};
use crate::network::EncoderKind;
use crate::samples::{TrainingImageOptions, TrainingImageSource};
use crate::targets::{Annotation, IGNORED};
use crate::training::DetectorTrainingOptions;

/// Overlaps of proposals' anchors (Ren et al. 2015, section 3.1.2), of RetinaNet's (Lin et al. 2017, section 4), and of proposals with
/// objects (Girshick 2015, section 2.3; torchvision).
const OF_PROPOSALS: Limits = Limits { object: 0.7, background: 0.3, best: true };
const OF_RETINA: Limits = Limits { object: 0.5, background: 0.4, best: true };
const OF_HEADS: Limits = Limits { object: 0.5, background: 0.5, best: false };
/// Anchors of an image that the proposal network learns from, and the most that stand for objects (Ren et al. 2015, section 3.1.3).
const ANCHORS: (usize, f64) = (256, 0.5);
/// Proposals of an image that the heads learn from, and the most that stand for objects (Lin et al. 2017, "Feature pyramid networks",
/// section 5.2; torchvision).
const PROPOSALS: (usize, f64) = (512, 0.25);
/// The same with EfficientNet-Lite0, as many as Fast R-CNN learns from in a step of two images (Girshick 2015, section 2.3): they
/// would cost more than all the rest.
const PROPOSALS_LITE0: (usize, f64) = (128, 0.25);
/// Images' random numbers, apart from those that make them.
const SAMPLING: u64 = 0xa4c4_0000;

/// An image as the network wants it, and the objects in it.
pub struct AnchoredImage {
    input: Vec<f32>,
    annotation: Annotation,
    /// Its number in the training.
    number: u64,
}

/// A network in training.
pub struct AnchoredTraining {
    learner: Learner<Layers>,
    config: AnchoredConfig,
    options: DetectorTrainingOptions,
    /// How often is logged and saved.
    pub pace: Pace,
    side: usize,
    device: Device,
}

/// Names of the losses, those of an image without masks or proposals 0.
const NAMES: [&str; 5] = ["scores", "boxes", "masks", "proposal_scores", "proposal_boxes"];

/// Losses of one image in the order of [`NAMES`], gradients of the encoder and of the rest.
struct ImageGradients {
    terms: [f64; 5],
    encoder: GradientsParams,
    rest: GradientsParams,
}

/// Raw output with its gradient, and the losses so far.
#[derive(Default)]
struct Sum {
    terms: [f64; 5],
    product: Option<Tensor<1>>,
}

impl Sum {
    fn add<const D: usize>(&mut self, number: usize, output: Tensor<D>, term: Term) {
        self.terms[number] += term.value;
        let gradient = Tensor::from_data(TensorData::new(term.gradient, output.dims()), &output.device());
        let product = (output * gradient).sum();
        self.product = Some(match self.product.take() {
            Some(sum) => sum + product,
            None => product,
        });
    }
}

/// Objects of an image: label and box of each, and its number among the pixels' labels. Those without an extent are left out.
fn objects(annotation: &Annotation, first_label: usize) -> (Vec<(usize, Corners)>, Vec<u8>) {
    let whole = annotation.instances.iter().zip(1u8..);
    whole
        .filter(|(i, _)| i.corners[2] > i.corners[0] && i.corners[3] > i.corners[1])
        .map(|(i, number)| ((i.class + first_label, i.corners), number))
        .unzip()
}

/// What boxes stand for; those on pixels that are not to be learnt are no background.
fn matched(annotation: &Annotation, objects: &[Corners], boxes: &[Corners], limits: Limits) -> Vec<Match> {
    let [width, height] = annotation.size;
    let ignored = |c: &Corners| {
        let at =
            |low: f32, high: f32, side: usize| (0.5 * (low + high)).clamp(0.0, (side - 1) as f32) as usize;
        annotation.labels[at(c[1], c[3], height) * width + at(c[0], c[2], width)] == IGNORED
    };
    let mut found = matches(objects, boxes, limits);
    for (of_box, corners) in found.iter_mut().zip(boxes) {
        if *of_box == Match::Background && ignored(corners) {
            *of_box = Match::Between;
        }
    }
    found
}

/// Maps of one level as numbers, with their layout.
fn layout(logits: &Tensor<4>, codes: &Tensor<4>) -> Layout {
    let [_, channels, rows, columns] = codes.dims();
    debug_assert_eq!(logits.dims()[2..], codes.dims()[2..]);
    Layout { pixels: rows * columns, per_pixel: channels / 4 }
}

fn retina(network: &RetinaNet, x: Tensor<4>, image: &AnchoredImage, labels: usize, sum: &mut Sum) {
    let raw = network.forward(x);
    let grids: Vec<[usize; 2]> = raw.iter().map(|[logits, _]| [logits.dims()[2], logits.dims()[3]]).collect();
    let [width, height] = image.annotation.size;
    let anchors = anchors(Scales::Three, &grids, [height, width]);
    let (objects, _) = objects(&image.annotation, 0);
    let boxes: Vec<Corners> = objects.iter().map(|o| o.1).collect();
    let all: Vec<Corners> = anchors.iter().flatten().copied().collect();
    let all = matched(&image.annotation, &boxes, &all, OF_RETINA);
    let count = all.iter().filter(|m| matches!(m, Match::Object(_))).count();
    let mut first = 0;
    for ([logits, codes], anchors) in raw.into_iter().zip(&anchors) {
        let matches = &all[first..first + anchors.len()];
        first += anchors.len();
        let (raw_logits, raw_codes) = (vector(logits.clone()), vector(codes.clone()));
        let layout = layout(&logits, &codes);
        let level = LevelTargets { layout, logits: &raw_logits, codes: &raw_codes, anchors, matches };
        let [of_labels, of_boxes] = level.focal(labels, &objects, count);
        sum.add(0, logits, of_labels);
        sum.add(1, codes, of_boxes);
    }
}

fn faster(
    network: &FasterRcnn,
    x: Tensor<4>,
    image: &AnchoredImage,
    labels: usize,
    random: &mut Random,
    sum: &mut Sum,
) {
    let maps = network.backbone.forward(x);
    let (objects, numbers) = objects(&image.annotation, 1);
    let boxes: Vec<Corners> = objects.iter().map(|o| o.1).collect();
    let mut proposed = propose(network, &maps, image, &boxes, random, sum);
    proposed.extend(&boxes);
    let found = matched(&image.annotation, &boxes, &proposed, OF_HEADS);
    let (most, of_objects) = if network.backbone.lite0.is_some() { PROPOSALS_LITE0 } else { PROPOSALS };
    let chosen = balanced(&found, most, of_objects, random);
    if chosen.is_empty() {
        return;
    }
    let proposals: Vec<Corners> = chosen.iter().map(|i| proposed[*i]).collect();
    let target = |i: &usize| match found[*i] {
        Match::Object(number) => objects[number],
        _ => (0, [0.0; 4]),
    };
    let targets: Vec<(usize, Corners)> = chosen.iter().map(target).collect();
    let [width, height] = image.annotation.size;
    let levels = Levels::new(&maps, [height, width]);
    let (logits, codes) = network.roi_heads.classify(&levels, &proposals);
    let (raw_logits, raw_codes) = (vector(logits.clone()), vector(codes.clone()));
    let [of_labels, of_boxes] = classified(&raw_logits, &raw_codes, &proposals, &targets, labels);
    sum.add(0, logits, of_labels);
    sum.add(1, codes, of_boxes);
    // Masks of what stands for an object.
    let of_objects = chosen.iter().zip(&proposals).filter_map(|(i, corners)| match found[*i] {
        Match::Object(number) => Some((number, *corners)),
        _ => None,
    });
    let (of, corners): (Vec<usize>, Vec<Corners>) = of_objects.unzip();
    if corners.is_empty() {
        return;
    }
    let Some(logits) = network.roi_heads.masks(&levels, &corners) else { return };
    let mask = |(object, corners): (&usize, &Corners)| {
        (objects[*object].0, mask_in(&image.annotation, numbers[*object], corners))
    };
    let targets: Vec<(usize, Vec<f32>)> = of.iter().zip(&corners).map(mask).collect();
    sum.add(2, logits.clone(), masked(&vector(logits), &targets, labels));
}

/// The mask of the object with this number in a box, as the mask head should give it.
fn mask_in(annotation: &Annotation, number: u8, corners: &Corners) -> Vec<f32> {
    let [width, height] = annotation.size;
    let plane: Vec<f32> =
        annotation.labels.iter().map(|label| f32::from(u8::from(*label == number))).collect();
    let regions = Regions { boxes: vec![*corners], scale: 1.0, side: MASK_SIDE, samples: None };
    roi_align_forward(&plane, 1, [height, width], &regions)
}

/// The proposals of an image; adds the losses of the proposal network.
fn propose(
    network: &FasterRcnn,
    maps: &[Tensor<4>],
    image: &AnchoredImage,
    boxes: &[Corners],
    random: &mut Random,
    sum: &mut Sum,
) -> Vec<Corners> {
    let raw = network.rpn.forward(maps);
    let grids: Vec<[usize; 2]> = maps.iter().map(|map| [map.dims()[2], map.dims()[3]]).collect();
    let [width, height] = image.annotation.size;
    let anchors = anchors(Scales::One, &grids, [height, width]);
    let all: Vec<Corners> = anchors.iter().flatten().copied().collect();
    let all = matched(&image.annotation, boxes, &all, OF_PROPOSALS);
    let chosen = balanced(&all, ANCHORS.0, ANCHORS.1, random);
    let mut output = vec![];
    let mut first = 0;
    for ((logits, codes), anchors) in raw.logits.into_iter().zip(raw.codes).zip(&anchors) {
        let layout = layout(&logits, &codes);
        let last = first + layout.anchors();
        let of_level: Vec<usize> =
            chosen.iter().filter(|i| (first..last).contains(i)).map(|i| i - first).collect();
        let (raw_logits, raw_codes) = (vector(logits.clone()), vector(codes.clone()));
        let matches = &all[first..last];
        first = last;
        let level = LevelTargets { layout, logits: &raw_logits, codes: &raw_codes, anchors, matches };
        let [of_objects, of_boxes] = level.proposals(&of_level, boxes, chosen.len());
        output.push(LevelOutput::new(&logits, &codes, Scales::One.anchors()));
        sum.add(3, logits, of_objects);
        sum.add(4, codes, of_boxes);
    }
    proposals(&output, &anchors, [height, width], Most::TRAINING)
}

impl AnchoredTraining {
    /// Of a network on an autodiff device, on images of `side` pixels.
    pub fn new(network: AnchoredNetwork, side: usize, options: DetectorTrainingOptions) -> Self {
        let AnchoredNetwork { layers, config, device, .. } = network;
        let learner =
            Learner::adam_w("network", layers.freeze_stages(options.frozen_stages), &options.common);
        let pace = Pace { sample_threads: 2, ..Pace::default() };
        AnchoredTraining { learner, config, options, pace, side, device }
    }

    /// The trained network.
    pub fn into_network(self) -> AnchoredNetwork {
        AnchoredNetwork::of_layers(self.learner.into_network(), self.config, device::chosen())
    }

    /// One image through the network and back. `network` is this thread's own copy, as graphs that share parameters are one to Burn.
    fn gradients(&self, network: &Layers, image: &AnchoredImage, images: usize) -> ImageGradients {
        let input = TensorData::new(image.input.clone(), [1, 3, self.side, self.side]);
        let x = Tensor::from_data(input, &self.device);
        let labels = self.config.labels;
        let random = &mut stream(self.options.common.seed ^ SAMPLING, image.number);
        let mut sum = Sum::default();
        match network {
            Layers::OneStage(network) => retina(network, x, image, labels, &mut sum),
            Layers::TwoStages(network) => faster(network, x, image, labels, random, &mut sum),
        }
        let Some(product) = sum.product else { unreachable!("a detector has levels") };
        let mut gradients = product.div_scalar(images as f64).backward();
        let encoder = gradients_of(&mut gradients, &network.backbone().encoder());
        let rest = gradients_of(&mut gradients, network);
        ImageGradients { terms: sum.terms.map(|term| term / images as f64), encoder, rest }
    }
}

/// All that decides about the result.
#[derive(Serialize)]
struct Settings<'a> {
    #[serde(flatten)]
    training: &'a DetectorTrainingOptions,
    network: &'a AnchoredConfig,
    samples: &'a TrainingImageOptions,
    photographs: usize,
}

impl Training for AnchoredTraining {
    type Samples = TrainingImageSource;
    type Batch = Vec<AnchoredImage>;

    fn plan(&self, source: &TrainingImageSource) -> Result<Plan, TrainError> {
        let options = &self.options;
        options.check()?;
        let side = source.options().size;
        let fits = side == self.side && side.is_multiple_of(32);
        OptionError::unless(fits, "size", side, "a multiple of 32 pixels")?;
        let settings = Settings {
            training: options,
            network: &self.config,
            samples: source.options(),
            photographs: source.photographs(),
        };
        Plan::new(&options.common, options.batch, self.pace, &settings)
    }

    fn batches<'a>(&self, source: &'a TrainingImageSource) -> Batches<'a, Self::Batch> {
        let (batch, seed) = (self.options.batch as u64, self.options.common.seed);
        let encoder = self.config.encoder;
        Box::new(move |step| {
            let image = |i: u64| {
                let number = step * batch + i;
                let sample = source.sample(seed, number);
                let mut input = sample.rgb;
                normalise(&mut input, encoder);
                AnchoredImage { input, annotation: sample.annotation, number }
            };
            (0..batch).map(image).collect()
        })
    }

    fn step(&mut self, batch: Self::Batch, rate: f64) -> Losses {
        // An image a thread, of their own: see `crate::training`.
        let threads = rayon::current_num_threads().clamp(1, batch.len().max(1));
        let (training, network, images) = (&*self, self.learner.network(), Arc::new(batch));
        let parts: Vec<Vec<ImageGradients>> = std::thread::scope(|scope| {
            let workers: Vec<_> = (0..threads)
                .map(|first| {
                    let network = network.clone().fork(&training.device);
                    let images = images.clone();
                    scope.spawn(move || {
                        let its = images.iter().skip(first).step_by(threads);
                        its.map(|image| training.gradients(&network, image, images.len())).collect()
                    })
                })
                .collect();
            let join = |worker: std::thread::ScopedJoinHandle<'_, _>| match worker.join() {
                Ok(parts) => parts,
                Err(panic) => std::panic::resume_unwind(panic),
            };
            workers.into_iter().map(join).collect()
        });
        // Summed in the order of the images, whichever thread had them.
        let (mut of_encoder, mut of_rest) = (GradientSum::new(), GradientSum::new());
        let encoder = network.backbone().encoder();
        let mut sums = [0.0; 5];
        let mut parts: Vec<_> = parts.into_iter().map(Vec::into_iter).collect();
        for image in 0..images.len() {
            let Some(part) = parts[image % threads].next() else { continue };
            sums.iter_mut().zip(part.terms).for_each(|(sum, term)| *sum += term);
            of_encoder.add(&encoder, part.encoder);
            of_rest.add(network, part.rest);
        }
        let (encoder_rate, gradients) = (rate * self.options.encoder_rate, of_encoder.into_gradients());
        match self.config.encoder {
            EncoderKind::ResNet50 => {
                self.learner.step_part(encoder_rate, gradients, |network| &mut network.backbone_mut().body);
            }
            EncoderKind::Lite0 => {
                self.learner.step_part(encoder_rate, gradients, |network| &mut network.backbone_mut().lite0);
            }
        }
        self.learner.step(rate, of_rest.into_gradients());
        NAMES.iter().zip(sums).map(|(name, value)| ((*name).to_string(), value)).collect()
    }

    fn learners(&mut self) -> Vec<&mut dyn Checkpointed> {
        vec![&mut self.learner]
    }

    fn restored(&mut self) {
        let stages = self.options.frozen_stages;
        self.learner.change(|network| network.freeze_stages(stages));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::anchored::AnchoredKind;
    use crate::targets::Instance;
    use sixfold_nn::pretrained::PretrainedFile;
    use std::path::Path;

    #[test]
    fn the_losses_of_retinanet_are_torchvisions() {
        // RetinaNet.compute_loss of the small network in tests/anchored (checks/anchored_vs_torchvision.py) on this image and these boxes.
        let kind = AnchoredKind::RetinaNet;
        let sizes = AnchoredConfig { blocks: [1; 4], width: 4, pyramid: 8, ..AnchoredConfig::new(kind, 4) };
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/anchored/retinanet-anchors.safetensors");
        let device = Device::flex().autodiff();
        let network =
            AnchoredNetwork::from_pytorch(&PretrainedFile::open(&file).unwrap(), &sizes, &device).unwrap();
        let Layers::OneStage(layers) = network.layers.freeze_stages(0) else {
            panic!("RetinaNet has one stage")
        };
        let value = |c: usize, x: usize, y: usize| ((3 * x + 5 * y * (c + 1)) ^ (x * y / 16)) % 256;
        let pixels = (0..3 * 96 * 96).map(|i| value(i / (96 * 96), i % 96, i / 96 % 96) as f32 / 255.0);
        let mut input: Vec<f32> = pixels.collect();
        normalise(&mut input, EncoderKind::ResNet50);
        let instance = |class, corners| Instance { class, corners };
        let instances = vec![instance(1, [10.0, 12.0, 49.0, 40.0]), instance(3, [60.0, 20.0, 90.0, 89.0])];
        let annotation = Annotation { size: [96, 96], labels: vec![0; 96 * 96], instances };
        let x = Tensor::from_data(TensorData::new(input.clone(), [1, 3, 96, 96]), &device);
        let mut sum = Sum::default();
        retina(&layers, x, &AnchoredImage { input, annotation, number: 0 }, 4, &mut sum);
        let [labels, boxes, ..] = sum.terms;
        assert!((labels - 0.775_797_5).abs() < 1e-5, "{labels}");
        assert!((boxes - 0.730_255_7).abs() < 1e-5, "{boxes}");
    }

    #[test]
    fn masks_are_cut_out_of_the_image_as_torchvision_does() {
        // project_masks_on_boxes of the same mask and box.
        let mut labels = vec![0u8; 96 * 96];
        for (y, row) in labels.chunks_exact_mut(96).enumerate().take(41).skip(12) {
            row[10..50].fill(2);
            if (20..25).contains(&y) {
                row[30..40].fill(1);
            }
        }
        let annotation = Annotation { size: [96, 96], labels, instances: vec![] };
        let mask = mask_in(&annotation, 2, &[8.0, 10.5, 53.0, 37.0]);
        assert!((mask.iter().sum::<f32>() - 637.522_34).abs() < 1e-2);
        let row = [14 * 28, 14 * 28 + 13, 14 * 28 + 14, 14 * 28 + 25].map(|i| mask[i]);
        let expected = [0.102_678_3, 0.497_171, 0.223_215_1, 0.808_036_8];
        assert!(row.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5), "{row:?}");
    }

    #[test]
    fn ignored_objects_are_no_background_and_flat_objects_are_left_out() {
        let mut labels = vec![0; 64 * 64];
        labels[20 * 64 + 20] = IGNORED;
        let flat = Instance { class: 1, corners: [5.0, 5.0, 5.0, 9.0] };
        let whole = Instance { class: 2, corners: [40.0, 40.0, 60.0, 60.0] };
        let annotation = Annotation { size: [64, 64], labels, instances: vec![flat, whole] };
        let (found, numbers) = objects(&annotation, 1);
        assert_eq!((found, numbers), (vec![(3, whole.corners)], vec![2]));
        let boxes = [[10.0, 10.0, 30.5, 30.5], [11.0, 10.0, 31.5, 30.5], [40.0, 40.0, 60.0, 60.0]];
        let found = matched(&annotation, &[whole.corners], &boxes, OF_PROPOSALS);
        assert_eq!(found, [Match::Between, Match::Background, Match::Object(0)]);
    }
}
