"""The compact detector against ONNX Runtime with the same weights, on two threads of the same processor.

    pip install onnx onnxruntime safetensors numpy
    cargo build --release -p sixfold-detect --example detect_times
    python benches/detector_vs_onnxruntime.py target/release/examples weights/detector-lmo.safetensors data/demo/test/000002/rgb/000003.png

The network is put together from the weight file as an ONNX graph, so the outputs are compared too. Rounds of both programs
alternate, so that both see the same state of the machine; medians of all calls are compared. The time of ONNX Runtime is the
network's alone; ours is given alone and with resizing, decoding, suppression and masks.
"""

import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time

import numpy as np
import onnxruntime
from onnx_graph import Graph
from safetensors import safe_open

THREADS = 2
ROUNDS = 4
CALLS = 10
# Blocks, kernel, stride of the first block, channels in, channels out (EfficientNet-Lite0, five stages).
STAGES = [(1, 3, 1, 32, 16), (2, 3, 2, 16, 24), (2, 5, 2, 24, 40), (3, 3, 2, 40, 80), (3, 5, 1, 80, 112)]


class Detector(Graph):
    """The layers of the compact detector."""

    def conv(self, name, x, stride=1, activation=None, depthwise=False, zeros=None):
        weight = self.tensor(f"{name}.weight")
        bias = self.tensor(f"{name}.bias")
        kernel = weight.shape[2]
        # SAME as TensorFlow has it for an even side: one zero more after than before where the stride is 2.
        total = kernel - stride if stride > 1 else kernel - 1
        before = total // 2
        pads = [before, before, total - before, total - before] if zeros is None else [zeros] * 4
        out = self.node(
            "Conv",
            [x, self.constant(weight), self.constant(bias)],
            strides=[stride, stride],
            pads=pads,
            group=weight.shape[0] if depthwise else 1,
        )
        if activation == "relu":
            return self.node("Relu", [out])
        if activation == "relu6":
            return self.node("Clip", [out, self.constant(np.float32(0)), self.constant(np.float32(6))])
        return out

    def twice(self, x):
        scales = self.constant(np.array([1, 1, 2, 2], np.float32))
        return self.node(
            "Resize", [x, "", scales], mode="nearest", coordinate_transformation_mode="asymmetric", nearest_mode="floor"
        )


def detector(weights, height, width):
    graph = Detector(weights)
    x = graph.conv("encoder.Lite0.stem", "image", 2, "relu6")
    maps, block = [], 0
    for blocks, kernel, first, inputs, outputs in STAGES:
        for repeat in range(blocks):
            stride, channels = (first, inputs) if repeat == 0 else (1, outputs)
            name = f"encoder.Lite0.blocks.{block}"
            inner = graph.conv(f"{name}.expand", x, 1, "relu6") if f"{name}.expand.weight" in weights.keys() else x
            inner = graph.conv(f"{name}.depthwise", inner, stride, "relu6", depthwise=True)
            inner = graph.conv(f"{name}.project", inner)
            x = graph.node("Add", [inner, x]) if stride == 1 and channels == outputs else inner
            block += 1
        maps.append(x)
    levels = [graph.conv("lateral.0", maps[2]), graph.conv("lateral.1", maps[4])]
    levels.append(graph.conv("extra.0", levels[1], 2, "relu", zeros=1))
    for level in (2, 1):
        levels[level - 1] = graph.node("Add", [levels[level - 1], graph.twice(levels[level])])
    mixed = graph.node("Add", [graph.twice(graph.conv("masks.coarse", levels[0])), graph.conv("masks.fine", maps[1])])
    prototypes = graph.conv("masks.out", graph.conv("masks.mix", mixed, 1, "relu"), 1, "relu")
    scores, boxes = [], []
    for level in levels:
        common = graph.conv("shared.0", level, 1, "relu")
        scores.append(graph.conv("scores", graph.conv("score_tower.0", common, 1, "relu")))
        boxes.append(graph.conv("boxes", graph.conv("box_tower.0", common, 1, "relu")))
    return graph.model([1, 3, height, width], [*scores, *boxes, prototypes])


def main():
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    program = pathlib.Path(sys.argv[1]) / "detect_times"
    weights = safe_open(sys.argv[2], "np")
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)

        def ours():
            command = [str(program), sys.argv[2], sys.argv[3], str(folder), str(CALLS)]
            environment = {**os.environ, "RAYON_NUM_THREADS": str(THREADS)}
            return json.loads(subprocess.run(command, check=True, capture_output=True, env=environment).stdout)

        first = ours()
        image = np.fromfile(folder / "input.f32", np.float32).reshape(1, 3, first["height"], first["width"])
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = THREADS
        model = detector(weights, first["height"], first["width"])
        session = onnxruntime.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
        outputs = session.run(None, {"image": image})
        theirs = np.concatenate([o.ravel() for o in outputs])
        mine = np.fromfile(folder / "output.f32", np.float32)
        assert mine.shape == theirs.shape, (mine.shape, theirs.shape)
        largest = np.abs(mine - theirs).max() / np.abs(theirs).max()
        print(f"largest difference of the outputs: {largest:.1e} of the largest number")
        assert largest < 1e-4
        times = {"network": [], "whole": [], "onnxruntime": []}
        for _ in range(ROUNDS):
            for _ in range(CALLS):
                start = time.perf_counter()
                session.run(None, {"image": image})
                times["onnxruntime"].append(1000 * (time.perf_counter() - start))
            run = ours()
            times["network"] += run["network"]
            times["whole"] += run["whole"]
    names = {
        "network": "Sixfold, the network alone",
        "whole": "Sixfold, image to boxes and masks",
        "onnxruntime": f"ONNX Runtime {onnxruntime.__version__}, the network alone",
    }
    for key, name in names.items():
        values = np.array(times[key])
        print(f"{name}: median {np.median(values):.1f} ms, best {values.min():.1f} ms of {len(values)} calls")


if __name__ == "__main__":
    main()
