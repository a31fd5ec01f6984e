"""Compares networks on a GPU with networks on the CPU: losses of the first steps of every training, and results of trained networks.

    cargo build --release -p sixfold-cli --features gpu
    python benches/gpu_vs_cpu.py target/release/sixfold OUT [--only NAME ...]

Each training runs on both processors with the same seed in small batches, on the sample images or on synthetic objects. Prints a
table as JSON: the losses of the last recorded step, the largest relative difference of any of them, and the seconds of both runs. It
shows whether the GPU backend computes the same; the batches are far too small to compare speed.
"""

import argparse
import json
import pathlib
import subprocess
import time

DEMO = "--dataset data/demo --ids 8"
ONE = "--rgb data/demo/test/000002/rgb/000003.png --camera data/demo/camera.json"
DRILL = "--object data/demo/models/obj_000008.ply --unit mm"
CAN = "--object data/demo/models/obj_000005.ply --unit mm --object-id 5"
TRAININGS = {
    "Pix2Pose": f"train pix2pose {DEMO} --renders-only --size 64 --per-object 4 --steps 5",
    "Pix2Pose, with discriminator": f"train pix2pose {DEMO} --renders-only --size 64 --per-object 4 --adversarial --steps 3",
    "Pix2Pose, as published": f"train pix2pose {DEMO} --preset published --per-object 2 --steps 2",
    "Pix2Pose, ResNet-50": f"train pix2pose {DEMO} --preset published --network resnet50 --no-adversarial --per-object 2 --steps 2",
    "detector": f"train detector {DEMO} --size 128 --batch 2 --steps 3",
    "detector, Mask R-CNN": f"train detector {DEMO} --network mask-rcnn --backbone lite0 --size 128 --longest-side 128 --batch 1 --steps 2",
    "detector, RetinaNet": f"train detector {DEMO} --network retinanet-anchors --backbone lite0 --size 128 --longest-side 128 --batch 1 --steps 2",
    "MTTM": "train mttm --objects 16 --scenes 4 --anchors 2 --steps 3",
    "MTTM, as published": "train mttm --preset published --objects 16 --scenes 4 --anchors 2 --steps 1",
    "DGCM-Net": "train dgcm --views 64 --pairs 4 --steps 3",
    "DGCM-Net, as published": "train dgcm --preset published --views 64 --pairs 2 --steps 1",
    "NOL": "train nol --steps 3",
    "NOL, as published": "train nol --preset published --steps 1",
    "features of views": "train views --batch 2 --steps 2",
    "refiner": "train refiner --batch 2 --steps 2",
    "proposals": "train proposals --objects 8 --size 160 --batch 2 --steps 2",
}
ANSWERS = {
    "poses from colour": f"estimate --method pix2pose --weights weights/pix2pose-lmo.safetensors {ONE} {CAN} --box 310,120,120,150",
    "poses from views": f"estimate --method views {ONE} {CAN} --box 310,120,120,150 --no-cache",
    "detections": f"detect --weights weights/detector-lmo.safetensors --rgb data/demo/test/000002/rgb/000003.png",
}


def numbers(answer):
    """All numbers of a JSON value but those of time, in order."""
    if isinstance(answer, dict):
        return [n for key, value in answer.items() if "second" not in key for n in numbers(value)]
    if isinstance(answer, list):
        return [n for value in answer for n in numbers(value)]
    return [float(answer)] if isinstance(answer, (int, float)) and not isinstance(answer, bool) else []


def run(program, arguments, out, processor):
    """The losses or the numbers of the answer, and the seconds."""
    out.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    command = [program, *arguments.split(), "--device", processor, "--out", str(out), "--json"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode == 2:
        return done.stderr.strip().splitlines()[-1:], time.monotonic() - began
    if not arguments.startswith("train"):
        return json.loads(done.stdout), time.monotonic() - began
    log = (out / "training" / "log.jsonl").read_text().splitlines()
    return json.loads(log[-1])["losses"], time.monotonic() - began


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program")
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--only", nargs="+", default=[])
    arguments = parser.parse_args()
    rows = []
    for name, command in {**TRAININGS, **ANSWERS}.items():
        if arguments.only and name not in arguments.only:
            continue
        results = {
            p: run(arguments.program, command, arguments.out / p / name.replace(" ", "-").replace(",", ""), p)
            for p in ("cpu", "gpu")
        }
        (cpu, cpu_seconds), (gpu, gpu_seconds) = results["cpu"], results["gpu"]
        if isinstance(cpu, list) or isinstance(gpu, list):
            row = [name, command, f"failed: {cpu if isinstance(cpu, list) else gpu}", None, None, None]
        else:
            pairs = list(zip(numbers(cpu), numbers(gpu), strict=False))
            same_count = len(numbers(cpu)) == len(numbers(gpu))
            off = max((abs(a - b) / max(abs(a), 1e-3) for a, b in pairs), default=0.0)
            row = [name, command, len(pairs) if same_count else "another count", round(off, 7), round(cpu_seconds, 1), round(gpu_seconds, 1)]
        print(json.dumps(row), flush=True)
        rows.append(row)
    (arguments.out / "gpu_vs_cpu.json").write_text(json.dumps(rows, indent=1))


main()
