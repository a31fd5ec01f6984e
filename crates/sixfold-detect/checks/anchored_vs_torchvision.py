"""Compares Faster R-CNN, Mask R-CNN and RetinaNet of sixfold-detect with torchvision's, with the same random weights and images.

    pip install torch torchvision safetensors pillow
    cargo build --release -p sixfold-detect --example anchored_outputs
    python crates/sixfold-detect/checks/anchored_vs_torchvision.py target/release/examples/anchored_outputs

The networks are torchvision's `fasterrcnn_resnet50_fpn`, `maskrcnn_resnet50_fpn` and `retinanet_resnet50_fpn` in full size. Their
normalisations are fitted to an image and their heads are scaled, so that scores differ and hundreds of boxes compete; the
thresholds are torchvision's. The weights are written as .pth and .safetensors, under the names of today and of older
versions. Each network is also compared with frozen normalisations of epsilon 0, as torchvision sets it for its COCO_V1 weights.

Every detection of torchvision is paired with one of the same label and nearly the same box. What rounding alone does is
measured too: torchvision in single precision against torchvision in double precision. It may exchange detections of nearly equal
score, and keep another of two boxes that overlap by nearly the threshold. Scores and probabilities of masks may differ by
1e-4, boxes by 1e-4 of the image's longer side, or by three times torchvision's own rounding where that is more; and at most
1 of 100 detections, or three times as many as in torchvision itself, may have no partner. Masks laid into the image are compared
where the whole box, to which torchvision cuts them, is the same. `--fixtures FOLDER` writes the small networks of the unit tests
instead. The exit status is 1 if more differs."""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
import torchvision
from PIL import Image
from safetensors.torch import load_file, save_file
from torchvision.models.detection import FasterRCNN, MaskRCNN, RetinaNet
from torchvision.models.detection._utils import overwrite_eps
from torchvision.models.detection.backbone_utils import BackboneWithFPN
from torchvision.models.resnet import Bottleneck
from torchvision.ops import FrozenBatchNorm2d
from torchvision.ops.feature_pyramid_network import LastLevelMaxPool, LastLevelP6P7

BOUND = 1e-4
SIZES = [(640, 480), (301, 217), (200, 520)]
NAMES = ["fasterrcnn_resnet50_fpn", "maskrcnn_resnet50_fpn", "retinanet_resnet50_fpn"]


def make_image(size, seed):
    """Blurred noise with a few rectangles, as 8-bit numbers."""
    random = np.random.default_rng(seed)
    image = random.integers(0, 256, (6, 8, 3), dtype=np.uint8)
    image = np.array(Image.fromarray(image).resize(size, Image.BICUBIC)).astype(np.int64)
    for _ in range(12):
        x, y = random.integers(0, size[0]), random.integers(0, size[1])
        w, h = random.integers(8, size[0] // 2), random.integers(8, size[1] // 2)
        image[y : y + h, x : x + w] = random.integers(0, 256, 3) // 2 + image[y : y + h, x : x + w] // 2
    image += random.integers(-12, 13, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8)


def tensor(image):
    return torch.from_numpy(image).permute(2, 0, 1).float() / 255


def fit_norms(network, image):
    """Running statistics of the normalisations from an image, then a little uneven."""
    norms = [m for m in network.modules() if isinstance(m, torch.nn.BatchNorm2d)]
    for norm in norms:
        norm.momentum = None
    network.backbone.train()
    with torch.no_grad():
        network.backbone(torch.nn.functional.interpolate((image[None] - 0.45) / 0.23, size=(256, 256)))
    network.eval()
    for norm in norms:
        norm.weight.data.uniform_(0.6, 1.2)
        norm.bias.data.normal_(0, 0.2)


def fit_layer(network, layer, image, mean, deviation):
    """Scales a layer so that every channel of its output has this mean and deviation on an image."""
    outputs = []
    hook = layer.register_forward_hook(lambda _, __, out: outputs.append(out.transpose(0, 1).flatten(1)))
    with torch.no_grad():
        network([image])
    hook.remove()
    outputs = torch.cat(outputs, 1)
    factor = deviation / outputs.std(1).clamp_min(1e-6)
    layer.weight.data *= factor.reshape([-1] + [1] * (layer.weight.dim() - 1))
    layer.bias.data = (layer.bias.data - outputs.mean(1)) * factor + mean


def fit_heads(network, image, sure=-5.0):
    """Scores and boxes that differ from place to place; RetinaNet's logits have the mean `sure`."""
    if hasattr(network, "rpn"):
        fit_layer(network, network.rpn.head.cls_logits, image, 0.0, 2.0)
        fit_layer(network, network.rpn.head.bbox_pred, image, 0.0, 0.2)
        fit_layer(network, network.roi_heads.box_predictor.cls_score, image, 0.0, 1.5)
        fit_layer(network, network.roi_heads.box_predictor.bbox_pred, image, 0.0, 1.0)
        network.roi_heads.box_predictor.cls_score.bias.data[0] += 2.0
        if network.roi_heads.has_mask():
            fit_layer(network, network.roi_heads.mask_predictor.mask_fcn_logits, image, 0.0, 2.0)
    else:
        fit_layer(network, network.head.classification_head.cls_logits, image, sure, 1.0)
        fit_layer(network, network.head.regression_head.bbox_reg, image, 0.0, 0.2)


def freeze_norms(module):
    """torchvision's frozen normalisations instead of those in training."""
    for name, child in module.named_children():
        if isinstance(child, torch.nn.BatchNorm2d):
            frozen = FrozenBatchNorm2d(child.num_features)
            frozen.load_state_dict({k: v for k, v in child.state_dict().items() if k != "num_batches_tracked"})
            setattr(module, name, frozen)
        else:
            freeze_norms(child)


def old_name(name):
    """The name that older versions of torchvision gave a tensor."""
    name = re.sub(r"(inner_blocks|layer_blocks)\.(\d+)\.0\.", r"\1.\2.", name)
    name = name.replace("rpn.head.conv.0.0.", "rpn.head.conv.")
    name = re.sub(r"mask_head\.(\d)\.0\.", lambda m: f"mask_head.mask_fcn{int(m[1]) + 1}.", name)
    return re.sub(r"(_head\.conv)\.(\d)\.0\.", lambda m: f"{m[1]}.{2 * int(m[2])}.", name)


def theirs(network, image):
    """Detections of torchvision, and the masks before they are laid into the image."""
    small = []
    if hasattr(network, "roi_heads"):
        # Pooling keeps the scales of the first image that it ever saw.
        for pool in (network.roi_heads.box_roi_pool, network.roi_heads.mask_roi_pool):
            if pool is not None:
                pool.scales = pool.map_levels = None
    paste = torchvision.models.detection.transform.paste_masks_in_image

    def keep(masks, *more):
        small.append(masks[:, 0])
        return paste(masks, *more)

    torchvision.models.detection.transform.paste_masks_in_image = keep
    try:
        with torch.no_grad():
            found = network([tensor(image).to(next(network.parameters()).dtype)])[0]
    finally:
        torchvision.models.detection.transform.paste_masks_in_image = paste
    if small:
        found["pasted"] = found.pop("masks")[:, 0]
        found["masks"] = small[0]
    return found


def whole(boxes):
    """Boxes of masks as torchvision cuts them to whole pixels."""
    return torchvision.models.detection.roi_heads.expand_boxes(boxes, 30 / 28).to(torch.int64)


def pairs(expected, found):
    """Numbers of detections of the same label and nearly the same box and score."""
    free = torch.ones(len(found["labels"]), dtype=torch.bool)
    both = []
    for i, (label, box, score) in enumerate(zip(expected["labels"], expected["boxes"], expected["scores"])):
        distance = (found["boxes"] - box).abs().amax(1) + (found["scores"] - score).abs()
        distance[~free | (found["labels"] != label)] = torch.inf
        best = int(distance.argmin()) if len(distance) else -1
        if best >= 0 and distance[best] < 0.1:
            free[best] = False
            both.append((i, best))
    return torch.tensor(both, dtype=torch.int64).reshape(-1, 2).T


def differences(expected, found):
    """Largest differences of detections that have a partner, and the number of those without one."""
    a, b = pairs(expected, found)
    out = {"alone": len(expected["labels"]) - len(a)}
    for name in ("boxes", "scores", "masks"):
        if name in expected and len(a):
            out[name] = (expected[name][a] - found[name][b]).abs().max().item()
    if "pasted" in expected and len(a):
        same = (whole(expected["boxes"][a]) == whole(found["boxes"][b])).all(1)
        if same.any():
            out["pasted"] = (expected["pasted"][a] - found["pasted"][b])[same].abs().max().item()
    return out


def text(found):
    return ", ".join(f"{k} {v:.1e}" if isinstance(v, float) else f"{k} {v}" for k, v in found.items())


def compare(expected, exact, found, size):
    """Whether the detections of an image are those of torchvision, up to rounding."""
    ours, rounding = differences(expected, found), differences(exact, expected)
    seconds = found["seconds"].item()
    print(f"    {size[0]}x{size[1]}, {len(expected['labels'])} detections, {seconds:.1f} s")
    print(f"      against torchvision: {text(ours)}")
    print(f"      torchvision against itself in double precision: {text(rounding)}")
    bounds = {"alone": len(expected["labels"]) // 100, "boxes": BOUND * max(size)}
    return all(
        value <= max(bounds.get(name, BOUND), 3 * rounding.get(name, 0)) for name, value in ours.items()
    ) and len(found["labels"]) == len(expected["labels"])


def run(program, weights, epsilon, images, folder):
    """Detections of every image."""
    out = folder / "out.safetensors"
    subprocess.run([program, weights, str(epsilon), out, *images], check=True)
    found = [{} for _ in images]
    for key, value in load_file(out).items():
        number, name = key.split()
        found[int(number)][name] = value.long() if name == "labels" else value
    return found


def check(name, program, folder):
    torch.manual_seed(2)
    network = getattr(torchvision.models.detection, name)(weights=None, weights_backbone=None, num_classes=21)
    pictures = [make_image(size, i) for i, size in enumerate(SIZES)]
    images = []
    for i, picture in enumerate(pictures):
        images.append(folder / f"{i}.png")
        Image.fromarray(picture).save(images[-1])
    fit_norms(network, tensor(pictures[0]))
    fit_heads(network, tensor(pictures[0]))
    state = network.state_dict()
    old = {old_name(k): v.clone() for k, v in state.items()}
    assert set(old) != set(state)
    torch.save(state, folder / "new.pth")
    save_file(old, folder / "old.safetensors")
    expected = [theirs(network, picture) for picture in pictures]
    network.double()
    exact = [theirs(network, picture) for picture in pictures]
    network.float()
    good = []
    for file, count in (("new.pth", len(SIZES)), ("old.safetensors", 1)):
        print(f"  {file}, epsilon 1e-5 as the file tells")
        ours = run(program, folder / file, "-", images[:count], folder)
        good += [compare(*of_image) for of_image in zip(expected, exact, ours, SIZES)]
    freeze_norms(network)
    overwrite_eps(network, 0.0)
    torch.save({"model": {f"module.{k}": v for k, v in network.state_dict().items()}}, folder / "frozen.pth")
    print("  frozen.pth, epsilon 0, as for the COCO_V1 weights")
    expected = theirs(network, pictures[0])
    exact = theirs(network.double(), pictures[0])
    ours = run(program, folder / "frozen.pth", "-", images[:1], folder)[0]
    good.append(compare(expected, exact, ours, SIZES[0]))
    return all(good)


class SmallResNet(torch.nn.Module):
    """A ResNet of four bottlenecks with torchvision's names, 4 channels after the first convolution."""

    def __init__(self):
        super().__init__()
        self.conv1 = torch.nn.Conv2d(3, 4, 7, 2, 3, bias=False)
        self.bn1 = torch.nn.BatchNorm2d(4)
        self.relu = torch.nn.ReLU()
        self.maxpool = torch.nn.MaxPool2d(3, 2, 1)
        for i, inputs in enumerate([4, 16, 32, 64]):
            inner, stride = 4 << i, 1 if i == 0 else 2
            shortcut = torch.nn.Conv2d(inputs, 4 * inner, 1, stride, bias=False)
            shortcut = torch.nn.Sequential(shortcut, torch.nn.BatchNorm2d(4 * inner))
            self.add_module(f"layer{i + 1}", torch.nn.Sequential(Bottleneck(inputs, inner, stride, shortcut)))


def small_network(name):
    """The network in miniature: 8 channels in its pyramid, 4 labels, images of 96 pixels."""
    channels, labels, sides = 8, 4, {"min_size": 96, "max_size": 160}
    first = 1 if name == "retinanet-anchors" else 0
    layers = {f"layer{i + 1}": str(i) for i in range(first, 4)}
    more = LastLevelP6P7(channels, channels) if first else LastLevelMaxPool()
    backbone = BackboneWithFPN(SmallResNet(), layers, [16, 32, 64, 128][first:], channels, extra_blocks=more)
    if first:
        return RetinaNet(backbone, labels, detections_per_img=30, **sides)
    head = torchvision.models.detection.faster_rcnn.TwoMLPHead(channels * 49, 16)
    predictor = torchvision.models.detection.faster_rcnn.FastRCNNPredictor(16, labels)
    anchors = torchvision.models.detection.faster_rcnn._default_anchorgen()
    more = {"rpn_anchor_generator": anchors, "box_head": head, "box_predictor": predictor} | sides
    if name == "faster-rcnn":
        return FasterRCNN(backbone, box_detections_per_img=30, **more)
    masks = torchvision.models.detection.mask_rcnn
    more["mask_head"] = masks.MaskRCNNHeads(channels, [channels] * 4, 1)
    more["mask_predictor"] = masks.MaskRCNNPredictor(channels, channels, labels)
    return MaskRCNN(backbone, box_detections_per_img=8, **more)


def pattern(columns, rows):
    """The image of the unit test, which makes it by the same rule."""
    y, x, c = np.meshgrid(np.arange(rows), np.arange(columns), np.arange(3), indexing="ij")
    return ((((3 * x + 5 * y * (c + 1)) ^ (x * y // 16)) % 256)).astype(np.uint8)


def write_fixtures(folder):
    """Weights, rounded to 16 bits, and detections of the small networks."""
    for name in ("faster-rcnn", "mask-rcnn", "retinanet-anchors"):
        torch.manual_seed(5)
        network = small_network(name).eval()
        images = [pattern(90, 70), pattern(61, 110)]
        fit_norms(network, tensor(images[0]))
        fit_heads(network, tensor(images[0]), -3.0)
        state = {k: v.half() for k, v in network.state_dict().items() if "num_batches" not in k}
        save_file(state, folder / f"{name}.safetensors")
        if name == "faster-rcnn":
            torch.save({"epoch": 3, "model": state}, folder / f"{name}.pth")
        network.load_state_dict({k: v.float() for k, v in state.items()}, strict=False)
        outputs = {}
        for i, image in enumerate(images):
            found = theirs(network, image)
            if "pasted" in found:
                found["pasted"] = found["pasted"][:1].contiguous()
            outputs |= {f"{i} {k}": v.float().contiguous() for k, v in found.items()}
            scores = found["scores"]
            print(f"{name}, image {i}: {len(scores)} detections, scores {scores[-1]:.3f} to {scores[0]:.3f}")
        save_file(outputs, folder / f"{name}-detections.safetensors")


def main():
    torch.set_num_threads(2)
    if len(sys.argv) == 3 and sys.argv[1] == "--fixtures":
        write_fixtures(Path(sys.argv[2]))
        return
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    good = []
    print(f"torch {torch.__version__}, torchvision {torchvision.__version__}")
    for name in NAMES:
        print(name)
        with tempfile.TemporaryDirectory() as folder:
            good.append(check(name, sys.argv[1], Path(folder)))
    sys.exit(0 if all(good) else 1)


if __name__ == "__main__":
    main()
