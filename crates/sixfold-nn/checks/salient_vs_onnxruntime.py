"""Compares U2-Net-p of sixfold-nn with onnxruntime running the published `u2netp.onnx` on the same images.

    pip install onnx onnxruntime numpy pillow safetensors
    python crates/sixfold-nn/checks/convert_u2netp.py --full u2netp.onnx full.safetensors
    cargo build --release -p sixfold-nn --example backbone_outputs
    python crates/sixfold-nn/checks/salient_vs_onnxruntime.py target/release/examples/backbone_outputs u2netp.onnx full.safetensors IMAGE...

Images may end in `:x,y,width,height` for a crop. The map with weights in full precision differs by at most 1e-4 anywhere; with the
shipped ones, in half precision, the differences are printed, and how many pixels of the mask above 0.5 change. The exit status is 1 otherwise.
"""

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
    return ((x / x.max() - MEAN) / DEVIATION).transpose(2, 0, 1)[None].astype(np.float32)


def ours(program, weights, x, folder):
    save_file({"x": x, "factor": np.zeros((1, 1, 1, 1), np.float32)}, folder / "x.safetensors")
    subprocess.run([program, "u2netp", weights, folder / "x.safetensors", folder / "out.safetensors"], check=True)
    return load_file(folder / "out.safetensors")["salience"]


def main():
    if len(sys.argv) < 5:
        sys.exit(__doc__)
    program, source, full, *images = sys.argv[1:]
    session = onnxruntime.InferenceSession(source)
    good = True
    print("| image | largest, mean difference, f32 | largest, mean difference, f16 | pixels of the mask changed |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name in images:
            x = prepared(name)
            expected = session.run(None, {session.get_inputs()[0].name: x})[0]
            exact, half = (ours(program, w, x, Path(folder)) for w in (full, "shipped"))
            d, h = np.abs(exact - expected), np.abs(half - expected)
            changed = ((half > 0.5) != (expected > 0.5)).mean()
            print(f"| {Path(name).parent.name}/{Path(name).name} | {d.max():.1e}, {d.mean():.1e} | {h.max():.1e}, {h.mean():.1e} | {changed:.3%} |")
            good &= bool(d.max() <= BOUND)
    print("good" if good else f"TOO LARGE: at most {BOUND:.0e}")
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
