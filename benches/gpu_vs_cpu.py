"""Compares networks on a GPU with networks on the CPU: losses of the first steps of every training, and results of trained networks.

    cargo build --release -p sixfold-cli --features gpu
    python benches/gpu_vs_cpu.py target/release/sixfold OUT [--only NAME ...]

Each training runs on both processors with the same seed in small batches, on the sample images or on synthetic objects. Prints a
table as JSON: name, command, and after the first and the last step the largest relative difference of any loss; for poses the
largest difference of an element of the matrix; then the seconds of both runs. It shows whether the GPU backend computes the same;
the batches are far too small to compare speed.
"""

import argparse
import json
import pathlib
import shutil
import subprocess
import time

DEMO = "--dataset data/demo --ids 8"
ONE = "--rgb data/demo/test/000002/rgb/000003.png --camera data/demo/camera.json --unit mm"
SMALL = "--size 128 --longest-side 128 --batch 1"
# Command, and the number of steps.
TRAININGS = {
    "Pix2Pose": (f"train pix2pose {DEMO} --renders-only --size 64 --per-object 4", 5),
    "Pix2Pose, with discriminator": (f"train pix2pose {DEMO} --renders-only --size 64 --per-object 4 --adversarial", 3),
    "Pix2Pose, as published": (f"train pix2pose {DEMO} --preset published --per-object 2", 1),
    "Pix2Pose, ResNet-50": (
        f"train pix2pose {DEMO} --preset published --network resnet50 --no-adversarial --per-object 2", 1),
    "detector": (f"train detector {DEMO} --size 128 --batch 2", 3),
    "detector, Mask R-CNN": (f"train detector {DEMO} --network mask-rcnn --backbone lite0 {SMALL}", 2),
    "detector, RetinaNet": (f"train detector {DEMO} --network retinanet-anchors --backbone lite0 {SMALL}", 2),
    "MTTM": ("train mttm --objects 16 --scenes 4 --anchors 2", 3),
    "MTTM, as published": ("train mttm --preset published --objects 16 --scenes 4 --anchors 2", 1),
    "DGCM-Net": ("train dgcm --views 64 --pairs 4", 3),
    "DGCM-Net, as published": ("train dgcm --preset published --views 64 --pairs 2", 1),
    "NOL": ("train nol", 1),
    "features of views": ("train views --batch 2", 2),
    "refiner": ("train refiner --batch 2", 2),
    "proposals": ("train proposals --objects 8 --size 160 --batch 2", 2),
}
DUCK = "--object data/demo/models/obj_000009.ply --object-id 9 --box 335,285,62,68"
DRILLER = "--object data/demo/models/obj_000008.ply --box 310,115,150,160 --min-score 0"
ANSWERS = {
    "poses from colour": f"estimate --method pix2pose --weights weights/pix2pose-lmo.safetensors {ONE} {DUCK}",
    "poses from views": f"estimate --method views {ONE} {DRILLER} --no-cache",
    "detections": "detect --weights weights/detector-lmo.safetensors --rgb data/demo/test/000002/rgb/000003.png",
}


def numbers(answer):
    """All numbers of a JSON value but those of time, in order."""
    if isinstance(answer, dict):
        return [n for key, value in answer.items() if "second" not in key for n in numbers(value)]
    if isinstance(answer, list):
        return [n for value in answer for n in numbers(value)]
    return [float(answer)] if isinstance(answer, (int, float)) and not isinstance(answer, bool) else []


def run(program, arguments, out, processor):
    """The losses, matrices or numbers of the answer, and the seconds."""
    shutil.rmtree(out, ignore_errors=True)
    began = time.monotonic()
    command = [program, *arguments.split(), "--device", processor, "--out", str(out), "--json"]
    done = subprocess.run(command, capture_output=True, text=True)
    seconds = time.monotonic() - began
    if done.returncode == 2:
        raise SystemExit(f"{' '.join(command)}\n{done.stderr}")
    if arguments.startswith("train"):
        log = (out / "training" / "log.jsonl").read_text().splitlines()
        return numbers(json.loads(log[-1])["losses"]), seconds
    answer = json.loads(done.stdout)
    if arguments.startswith("estimate"):
        return [n for pose in answer["poses"] for n in numbers(pose["camera_from_object"])], seconds
    return numbers(answer), seconds


def difference(cpu, gpu, absolute):
    """The largest difference; an error if one processor gives more numbers, or none."""
    if not cpu or len(cpu) != len(gpu):
        raise SystemExit(f"{len(cpu)} numbers on the CPU, {len(gpu)} on the GPU")
    return max(abs(a - b) / (1.0 if absolute else max(abs(a), 1e-3)) for a, b in zip(cpu, gpu))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program")
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--only", nargs="+", default=[])
    arguments = parser.parse_args()
    for name, what in {**TRAININGS, **ANSWERS}.items():
        if arguments.only and name not in arguments.only:
            continue
        runs = [what] if isinstance(what, str) else [f"{what[0]} --steps {n}" for n in sorted({1, what[1]})]
        off, seconds = [], []
        for command in runs:
            results = [run(arguments.program, command, arguments.out / p, p) for p in ("cpu", "gpu")]
            off.append(difference(results[0][0], results[1][0], command.startswith("estimate")))
            seconds = [round(r[1], 1) for r in results]
        row = [name, runs[-1], float(f"{off[0]:.1e}"), float(f"{off[-1]:.1e}") if len(off) > 1 else None, *seconds]
        print(json.dumps(row), flush=True)


main()
