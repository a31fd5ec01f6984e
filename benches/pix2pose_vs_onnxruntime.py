"""The dissertation's Pix2Pose network with PnP against ONNX Runtime and OpenCV with the same weights, on two threads.

    pip install onnx onnxruntime opencv-python-headless safetensors numpy
    cargo build --release -p sixfold-pix2pose --example bench_paper
    python benches/pix2pose_vs_onnxruntime.py target/release/examples

A region is what the method computes for one box: the network on one crop (first stage), on a batch of three (second stage, three
outlier thresholds), and PnP with RANSAC three times. The weights are random, time does not depend on them; the network is put
together from the weight file as an ONNX graph, and the outputs are compared. PnP gets the 4569 correspondences of an ellipsoid that
fills much of the crop, with 3 mm of noise and three strangers of ten: OpenCV's as the author's code calls it (EPnP, 5 pixels, 100
iterations), ours as `sixfold estimate` does. Rounds of both programs alternate, so that both see the same state of the machine.
"""

import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time

import cv2
import numpy as np
import onnxruntime
from onnx_graph import Graph
from safetensors import safe_open

THREADS = 2
ROUNDS = 4
CALLS = 5
SIDE = 128
CROPS = 3


class Generator(Graph):
    """The layers of the dissertation's generator."""

    def norm(self, name, x):
        parts = [self.constant(self.tensor(f"{name}.{part}")) for part in ("weight", "bias", "running_mean", "running_var")]
        return self.node("LeakyRelu", [self.node("BatchNormalization", [x, *parts], epsilon=1e-5)], alpha=0.3)

    def stage(self, name, x, stride):
        # TensorFlow's SAME: with stride 2 one row and column more after than before.
        pads = [2, 2, 2, 2] if stride == 1 else [1, 1, 2, 2]
        weight = self.constant(self.tensor(f"{name}.conv.weight"))
        x = self.node("Conv", [x, weight], strides=[stride, stride], pads=pads)
        return self.norm(f"{name}.norm", x)

    def up(self, name, x, bias=False):
        inputs = [x, self.constant(self.tensor(f"{name}.weight"))]
        if bias:
            inputs.append(self.constant(self.tensor(f"{name}.bias")))
        return self.node("ConvTranspose", inputs, strides=[2, 2], pads=[1, 1, 2, 2])

    def dense(self, name, x):
        weight, bias = self.constant(self.tensor(f"{name}.weight")), self.constant(self.tensor(f"{name}.bias"))
        return self.node("Gemm", [x, weight, bias])

    def second_half(self, x, channels):
        bounds = [self.constant(np.array([v], np.int64)) for v in (channels // 2, channels, 1)]
        return self.node("Slice", [x, *bounds])

    def reshape(self, x, shape):
        return self.node("Reshape", [x, self.constant(np.array(shape, np.int64))])


def generator(weights):
    graph = Generator(weights)
    e1 = graph.stage("e1", "image", 2)
    e2 = graph.stage("e2", e1, 2)
    e3 = graph.stage("e3", e2, 2)
    e4 = graph.stage("e4", e3, 2)
    code = graph.dense("decoder.code", graph.reshape(e4, [-1, 512 * 8 * 8]))
    x = graph.reshape(graph.dense("decoder.uncode", code), [-1, 256, 8, 8])
    for name, skip, channels in (("d1", e3, 256), ("d2", e2, 256), ("d3", e1, 128)):
        x = graph.norm(f"decoder.{name}.norm", graph.up(f"decoder.{name}.up", x))
        x = graph.node("Concat", [x, graph.second_half(skip, channels)], axis=1)
        x = graph.stage(f"decoder.{name}.conv", x, 1)
    coordinates = graph.node("Tanh", [graph.up("decoder.coordinates", x, bias=True)])
    error = graph.node("Sigmoid", [graph.up("decoder.error", x, bias=True)])
    joined = graph.node("Concat", [coordinates, error], axis=1)
    return graph.model(["batch", 3, SIDE, SIDE], [joined])


def opencv_pose(numbers):
    fx, fy, cx, cy = numbers[:4]
    truth = numbers[4:20].reshape(4, 4)
    rows = numbers[20:].reshape(-1, 5)
    points, pixels = np.ascontiguousarray(rows[:, :3]), np.ascontiguousarray(rows[:, 3:])
    camera = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])

    def solve():
        return cv2.solvePnPRansac(
            points, pixels, camera, None, flags=cv2.SOLVEPNP_EPNP, reprojectionError=5, iterationsCount=100
        )

    _, rotation, translation, _ = solve()
    turn = cv2.Rodrigues(rotation)[0].T @ truth[:3, :3]
    degrees = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    return solve, degrees, 1000 * np.linalg.norm(translation[:, 0] - truth[:3, 3])


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    program = pathlib.Path(sys.argv[1]) / "bench_paper"
    cv2.setNumThreads(THREADS)
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)

        def ours():
            environment = {**os.environ, "RAYON_NUM_THREADS": str(THREADS)}
            run = subprocess.run([str(program), str(folder), str(CALLS)], check=True, capture_output=True, env=environment)
            return json.loads(run.stdout)

        first = ours()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = THREADS
        model = generator(safe_open(folder / "paper.safetensors", "np"))
        session = onnxruntime.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
        images = np.fromfile(folder / "input.f32", np.float32).reshape(CROPS, 3, SIDE, SIDE)
        theirs = session.run(None, {"image": images})[0]
        mine = np.fromfile(folder / "output.f32", np.float32).reshape(theirs.shape)
        largest = np.abs(mine - theirs).max()
        print(f"largest difference of the outputs, which lie in -1 to 1: {largest:.1e}")
        assert largest < 1e-4
        assert theirs.std() > 0.01, "the outputs say nothing"
        solve, degrees, millimetres = opencv_pose(np.fromfile(folder / "correspondences.f64", np.float64))
        print(f"{first['correspondences']} correspondences, error of the pose:")
        print(f"  Sixfold {first['degrees']:.2f} degrees {first['millimetres']:.1f} mm, OpenCV {degrees:.2f} degrees {millimetres:.1f} mm")
        parts = ("first", "second", "pnp")
        times = {who: {part: [] for part in parts} for who in ("sixfold", "theirs")}
        calls = {
            "first": lambda: session.run(None, {"image": images[:1]}),
            "second": lambda: session.run(None, {"image": images}),
            "pnp": solve,
        }
        for _ in range(ROUNDS):
            for _ in range(CALLS):
                for part in parts:
                    start = time.perf_counter()
                    calls[part]()
                    times["theirs"][part].append(1000 * (time.perf_counter() - start))
            run = ours()
            for part in parts:
                times["sixfold"][part] += run[part]
    names = {"sixfold": "Sixfold", "theirs": f"ONNX Runtime {onnxruntime.__version__} and OpenCV {cv2.__version__}"}
    for who, name in names.items():
        one, three, pnp = (np.array(times[who][part]) for part in parts)
        region = np.median(one) + np.median(three) + 3 * np.median(pnp)
        print(
            f"{name}, medians: one crop {np.median(one):.0f} ms (best {one.min():.0f}), three crops {np.median(three):.0f} ms "
            f"(best {three.min():.0f}), PnP {np.median(pnp):.1f} ms; a region {region:.0f} ms"
        )


if __name__ == "__main__":
    main()
