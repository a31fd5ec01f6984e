"""Convolutions of sixfold-nn against PyTorch's, forward with bias and rectifier, on two threads of the same processor.

    pip install torch
    cargo build --release -p sixfold-nn --example bench_conv
    python benches/conv_vs_pytorch.py target/release/examples/bench_conv [OUT.json]

The sizes are those of the networks of `--method views` (a crop of 160 pixels, 12 poses), and a few larger ones. Rounds of both programs
alternate, so that both see the same state of the machine; the medians of the rounds' medians are compared."""

import json
import os
import statistics
import subprocess
import sys
import time

THREADS = 2
ROUNDS = 5
RUNS = 25
# Batch, input channels, output channels, side, kernel, stride.
SIZES = [
    [12, 112, 80, 20, 3, 1],
    [12, 80, 80, 20, 3, 1],
    [1, 80, 80, 28, 3, 1],
    [12, 24, 32, 40, 3, 1],
    [12, 32, 48, 40, 3, 2],
    [12, 4, 8, 160, 3, 2],
    [12, 8, 8, 80, 3, 1],
    [12, 24, 24, 40, 3, 1],
    [12, 64, 64, 20, 3, 1],
    [12, 64, 128, 10, 3, 2],
    [12, 128, 128, 5, 3, 1],
    [4, 256, 256, 16, 3, 1],
    [8, 128, 128, 32, 5, 1],
    [8, 3, 64, 128, 5, 2],
    [1, 64, 64, 160, 3, 1],
    [1, 3, 64, 640, 7, 2],
]


def pytorch():
    """Medians in milliseconds."""
    import torch
    from torch import nn

    torch.set_num_threads(THREADS)
    out = []
    with torch.inference_mode():
        for batch, inputs, outputs, side, kernel, stride in SIZES:
            layer = nn.Sequential(nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2), nn.ReLU(inplace=True))
            x = torch.ones(batch, inputs, side, side)
            times = []
            for _ in range(RUNS):
                start = time.perf_counter()
                layer(x)
                times.append(1e3 * (time.perf_counter() - start))
            out.append(statistics.median(times))
    return out


def main():
    program = sys.argv[1]
    environment = dict(os.environ, RAYON_NUM_THREADS=str(THREADS), OMP_NUM_THREADS=str(THREADS))
    rounds = {"sixfold": [], "PyTorch": []}
    for _ in range(ROUNDS):
        own = subprocess.run([program, json.dumps(SIZES)], env=environment, check=True, capture_output=True)
        rounds["sixfold"].append(json.loads(own.stdout))
        rounds["PyTorch"].append(pytorch())
    rows = []
    print("batch x inputs -> outputs, side, kernel, stride      sixfold    PyTorch   (ms)")
    for number, size in enumerate(SIZES):
        times = {name: statistics.median(run[number] for run in runs) for name, runs in rounds.items()}
        rows.append({"size": size, "ms": times})
        batch, inputs, outputs, side, kernel, stride = size
        name = f"{batch} x {inputs} -> {outputs}, {side}, {kernel}, {stride}"
        print(f"{name:48} {times['sixfold']:10.3f} {times['PyTorch']:10.3f}")
    if len(sys.argv) > 2:
        with open(sys.argv[2], "w") as out:
            json.dump(rows, out, indent=1)


if __name__ == "__main__":
    main()
