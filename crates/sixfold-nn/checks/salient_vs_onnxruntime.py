"""Compares U2-Net-p of sixfold-nn with onnxruntime running the published `u2netp.onnx` on the same images.

    pip install onnx onnxruntime numpy pillow safetensors
    python crates/sixfold-nn/checks/convert_u2netp.py --full u2netp.onnx full.safetensors
    cargo build --release -p sixfold-nn --example backbone_outputs
    python crates/sixfold-nn/checks/salient_vs_onnxruntime.py target/release/examples/backbone_outputs u2netp.onnx full.safetensors IMAGE...

Images may end in `:x,y,width,height` for a crop. The map with weights in full precision differs anywhere by at most 1e-4, or by twice what
onnxruntime itself differs by with its optimisations off: where the map is steep, the order of the sums already counts. With the shipped
weights, in half precision, the differences are printed, and the share of the mask's pixels (above 0.5) that change.
`--scores FILE.json` before the images adds them to a file for `convert_u2netp.py --scores`. The exit status is 1 otherwise."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import onnxruntime
from PIL import Image
from safetensors.numpy import load_file, save_file

BOUND = 1e-4
MEAN, DEVIATION = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])


def prepared(name):
    path, _, crop = name.partition(":")
    image = Image.open(path).convert("RGB")
    if crop:
        x, y, width, height = map(int, crop.split(","))
        image = image.crop((x, y, x + width, y + height))
    x = np.asarray(image.resize((320, 320), Image.BILINEAR), dtype=np.float64)
    # safetensors writes the memory as it lies.
    return np.ascontiguousarray(((x / x.max() - MEAN) / DEVIATION).transpose(2, 0, 1)[None], dtype=np.float32)


def ours(program, weights, x, folder):
    save_file({"x": x, "factor": np.zeros((1, 1, 1, 1), np.float32)}, folder / "x.safetensors")
    subprocess.run([program, "u2netp", weights, folder / "x.safetensors", folder / "out.safetensors"], check=True)
    return load_file(folder / "out.safetensors")["salience"]


def session(source, level):
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = level
    found = onnxruntime.InferenceSession(source, options)
    return lambda x: found.run(None, {found.get_inputs()[0].name: x})[0]


def main():
    if len(sys.argv) < 5:
        sys.exit(__doc__)
    program, source, full, *images = sys.argv[1:]
    scores = Path(images[1]) if images[0] == "--scores" else None
    images = images[2:] if scores else images
    levels = onnxruntime.GraphOptimizationLevel
    optimised, plain = session(source, levels.ORT_ENABLE_ALL), session(source, levels.ORT_DISABLE_ALL)
    good, worst = True, np.zeros(5)
    print("| image | f32: largest, mean difference | f16: largest, mean difference | mask changed | onnxruntime without optimisation |")
    print("|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name in images:
            x = prepared(name)
            expected = optimised(x)
            exact, half = (ours(program, w, x, Path(folder)) for w in (full, "shipped"))
            own = np.abs(plain(x) - expected).max()
            d, h = np.abs(exact - expected), np.abs(half - expected)
            changed = ((half > 0.5) != (expected > 0.5)).mean()
            label = "/".join(Path(name).parts[-2:])
            print(f"| {label} | {d.max():.1e}, {d.mean():.1e} | {h.max():.1e}, {h.mean():.1e} | {changed:.3%} | {own:.1e} |")
            good &= bool(d.max() <= max(BOUND, 2 * own))
            worst = np.maximum(worst, [d.max(), d.mean(), h.max(), h.mean(), changed])
    if scores:
        names = ["f32, largest", "f32, mean", "largest", "mean", "share of the mask's pixels"]
        found = {f"difference from onnxruntime, {n}, worst of {len(images)} images": float(v) for n, v in zip(names, worst)}
        known = json.loads(scores.read_text()) if scores.exists() else {}
        scores.write_text(json.dumps(known | {k: v for k, v in found.items() if "f32" not in k}, indent=2))
    print("good" if good else f"TOO LARGE: at most {BOUND:.0e}, or twice onnxruntime's own")
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
