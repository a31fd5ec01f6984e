#!/usr/bin/env python3
"""An object taught from simulated photographs, with a network of its own, in other simulated photographs on a cloth, with exact boxes.

    cargo run --release -p sixfold-teach --example photographs -- data/demo/models/obj_000009.ply mm TAUGHT
    cargo run --release -p sixfold-teach --example photographs -- data/demo/models/obj_000009.ply mm CLOTH 16 cloth
    python benches/teach_own_network.py SIXFOLD data/demo/models/obj_000009.ply TAUGHT CLOTH DIR

Teaches and trains in DIR (a stopped run resumes), then prints for each method how many poses are right (ADD within 10 % of the
diameter) and the median errors. Needs numpy and trimesh.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import trimesh

METHODS = {"pix2pose": [], "pix2pose, 3 starts, 2 passes": ["--starts", "3", "--passes", "2"], "views": []}


def read(path):
    return json.loads(Path(path).read_text())


def box_of(points, camera):
    """The box of points in the camera's frame, metres, in an image without lens distortion."""
    u = camera["fx"] * points[:, 0] / points[:, 2] + camera["cx"]
    v = camera["fy"] * points[:, 1] / points[:, 2] + camera["cy"]
    return f"{u.min():.1f},{v.min():.1f},{np.ptp(u):.1f},{np.ptp(v):.1f}"


def main():
    program, mesh, taught, cloth, folder = sys.argv[1], sys.argv[2], *(Path(p) for p in sys.argv[3:6])
    store, out = folder / "store", folder / "out"
    teach = [program, "teach", "object", "--photographs", taught / "photographs", "--camera", taught / "camera.json"]
    subprocess.run([*teach, "--store", store, "--out", out, "--train"], check=True)
    points = trimesh.load(mesh, process=False).vertices * 1e-3
    diameter = np.linalg.norm(points[:, None, :][::7] - points[None, :, :][:, ::7], axis=2).max()
    points = np.c_[points, np.ones(len(points))]
    board_from_taught = np.array(read(out / "teaching.json")["shape"]["board_from_object"])
    taught_from_true = np.linalg.inv(board_from_taught) @ np.array(read(taught / "truth.json")["board_from_object"])
    truth, camera = read(cloth / "truth.json"), read(cloth / "camera.json")
    assert not camera.get("distortion"), "boxes are computed without lens distortion"
    files = sorted((cloth / "photographs").iterdir())
    for name, options in METHODS.items():
        errors, angles = [], []
        for file, camera_from_board in zip(files, truth["camera_from_board"]):
            true_pose = np.array(camera_from_board) @ np.array(truth["board_from_object"])
            seen = (points @ true_pose.T)[:, :3]
            command = [program, "estimate", "--method", name.split(",")[0], *options, "--rgb", file]
            command += ["--camera", cloth / "camera.json", "--object", "object", "--store", store]
            command += ["--box", box_of(seen, camera), "--out", folder / "pose", "--json"]
            answer = subprocess.run(command, capture_output=True, text=True)
            assert answer.returncode in (0, 1), answer.stderr
            poses = json.loads(answer.stdout)["poses"]
            if not poses:
                errors.append(np.inf)
                continue
            pose = np.array(poses[0]["camera_from_object"]) @ taught_from_true
            errors.append(np.linalg.norm((points @ pose.T)[:, :3] - seen, axis=1).mean())
            cosine = (np.trace(pose[:3, :3] @ true_pose[:3, :3].T) - 1) / 2
            angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        right = sum(error < 0.1 * diameter for error in errors)
        medians = f"median {1000 * np.median(errors):.1f} mm, {np.median(angles):.1f} degrees"
        print(f"{name}: {right} of {len(errors)} right, {medians}")


if __name__ == "__main__":
    main()
