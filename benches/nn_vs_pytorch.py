"""Training steps of sixfold-nn against PyTorch with the same networks, on two threads of the same processor.

    pip install torch torchvision
    cargo build --release -p sixfold-nn --example bench_nn
    cargo build --release -p sixfold-pix2pose --example bench_generator
    python benches/nn_vs_pytorch.py target/release/examples

ResNet-50 from conv1 to layer3 (4 images of 128 x 128) and the dissertation's Pix2Pose generator (8 images of 128 x 128):
forward, loss and backward. Rounds of both programs alternate, so that both see the same state of the machine; the medians of
all steps are compared.

On a machine that has other work to do, the times of two threads that wait for each other say little. With `--processor-time`
at the end both run on one thread, and the processor's time of a step is compared."""

import json
import os
import resource
import subprocess
import sys
import time

import torch
import torch.nn.functional as F
from torch import nn
from torchvision.models import resnet50

THREADS = 2
ROUNDS = 3


class Stage(nn.Module):
    """5x5 convolution, batch normalisation, leaky rectifier."""

    def __init__(self, inputs, outputs, stride):
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 5, stride, 2, bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, x):
        return F.leaky_relu(self.norm(self.conv(x)), 0.3)


class Up(nn.Module):
    """Transposed convolution, and a convolution over it and the encoder's map."""

    def __init__(self, inputs, up, skip, outputs):
        super().__init__()
        self.up = nn.ConvTranspose2d(inputs, up, 5, 2, 2, 1, bias=False)
        self.norm = nn.BatchNorm2d(up)
        self.conv = Stage(up + skip, outputs, 1)

    def forward(self, x, skip):
        return self.conv(torch.cat([F.leaky_relu(self.norm(self.up(x)), 0.3), skip], 1))


class Generator(nn.Module):
    """As crates/sixfold-pix2pose/src/networks/paper.rs."""

    def __init__(self):
        super().__init__()
        self.e = nn.ModuleList([Stage(3, 128, 2), Stage(128, 256, 2), Stage(256, 256, 2), Stage(256, 512, 2)])
        self.code = nn.Linear(512 * 64, 256)
        self.uncode = nn.Linear(256, 256 * 64)
        self.d = nn.ModuleList([Up(256, 256, 128, 256), Up(256, 128, 128, 256), Up(256, 64, 64, 128)])
        self.coordinates = nn.ConvTranspose2d(128, 3, 5, 2, 2, 1)
        self.error = nn.ConvTranspose2d(128, 1, 5, 2, 2, 1)

    def forward(self, x):
        maps = [x]
        for stage in self.e:
            maps.append(stage(maps[-1]))
        x = self.uncode(self.code(maps[4].flatten(1))).reshape(-1, 256, 8, 8)
        for stage, skip in zip(self.d, (maps[3], maps[2], maps[1])):
            x = stage(x, skip[:, skip.shape[1] // 2 :])
        return torch.tanh(self.coordinates(x)), torch.sigmoid(self.error(x))


def resnet_step(network, x):
    x = network.maxpool(network.relu(network.bn1(network.conv1(x))))
    return network.layer3(network.layer2(network.layer1(x))).square().mean()


def generator_step(network, x):
    coordinates, error = network(x)
    return coordinates.square().mean() + error.square().mean()


def torch_times(network, step, batch, repeats, clock=time.perf_counter):
    x = torch.randn(batch, 3, 128, 128)
    times = []
    for _ in range(repeats + 2):
        start = clock()
        network.zero_grad(set_to_none=True)
        step(network, x).backward()
        times.append(clock() - start)
    return times[2:]


def our_times(command):
    environment = dict(os.environ, RAYON_NUM_THREADS=str(THREADS))
    out = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    return json.loads(out.stdout)["times"]


def processor_time(command):
    """Of one step: the difference between a long and a short run, by the steps between them."""
    repeats = int(command[-1])

    def run(count):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        environment = dict(os.environ, RAYON_NUM_THREADS="1")
        subprocess.run([*command[:-1], str(count)], check=True, stdout=subprocess.DEVNULL, env=environment)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    return (run(1 + repeats) - run(1)) / repeats


def median(values):
    return sorted(values)[len(values) // 2]


def main():
    options = sys.argv[2:]
    if len(sys.argv) < 2 or options not in ([], ["--processor-time"]):
        sys.exit(__doc__)
    examples = sys.argv[1]
    threads = 1 if options else THREADS
    torch.set_num_threads(threads)
    cases = [
        ("ResNet-50 to layer3, batch 4", resnet50(weights=None), resnet_step, 4, 10,
         [f"{examples}/bench_nn", "4", "128", "10"]),
        ("Pix2Pose generator, batch 8", Generator(), generator_step, 8, 4,
         [f"{examples}/bench_generator", "8", "4"]),
    ]
    what = "processor time" if options else "time"
    print(f"torch {torch.__version__}, threads: {threads}, median {what} of a training step")
    for name, network, step, batch, repeats, command in cases:
        network.train()
        ours, theirs = [], []
        for _ in range(ROUNDS):
            ours += [processor_time(command)] if options else our_times(command)
            clock = time.process_time if options else time.perf_counter
            theirs += torch_times(network, step, batch, repeats, clock)
        a, b = median(ours), median(theirs)
        print(f"{name}: ours {1000 * a:.0f} ms, PyTorch {1000 * b:.0f} ms, ratio {a / b:.2f}")


if __name__ == "__main__":
    main()
