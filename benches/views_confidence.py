"""How far the confidence of `sixfold estimate --method views` tells right poses from wrong ones.

    sixfold estimate --method views --dataset DIR/lmo --boxes gt --out views.csv
    python benches/views_confidence.py DIR/lmo views.csv

For several thresholds: the part of all poses that is kept, the part of the right ones (MSSD below a fifth of the diameter), and of the
kept ones the part below a fifth and below a half. Needs numpy; models as binary or ASCII PLY."""

import csv
import json
import sys
from pathlib import Path

import numpy as np

EVERY = 20  # Vertices; the largest distance hardly depends on it.
NUMBER = {"float": "<f4", "float32": "<f4", "double": "<f8", "uchar": "u1", "uint8": "u1"}


def vertices(path):
    with open(path, "rb") as file:
        header = b""
        while not header.endswith(b"end_header\n"):
            header += file.readline()
        text = header.decode()
        count = int(text.split("element vertex ")[1].split()[0])
        if "format ascii" in text:
            points = np.array([file.readline().split()[:3] for _ in range(count)], float)
        else:
            fields = [line.split()[1:] for line in text.split("element face")[0].splitlines() if line.startswith("property")]
            kind = np.dtype([(name, NUMBER[number]) for number, name in fields])
            data = np.frombuffer(file.read(kind.itemsize * count), kind)
            points = np.stack([data["x"], data["y"], data["z"]], 1).astype(float)
    return points[::EVERY]


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    dataset, results = Path(sys.argv[1]), sys.argv[2]
    infos = json.loads((dataset / "models" / "models_info.json").read_text())
    models, truths, found = {}, {}, []
    for row in csv.DictReader(open(results)):
        object_id, scene = row["obj_id"], int(row["scene_id"])
        if object_id not in models:
            models[object_id] = vertices(dataset / "models" / f"obj_{int(object_id):06}.ply")
        if scene not in truths:
            truths[scene] = json.loads((dataset / "test" / f"{scene:06}" / "scene_gt.json").read_text())
        info, points = infos[object_id], models[object_id]
        rotation = np.array(row["R"].split(), float).reshape(3, 3)
        posed = points @ rotation.T + np.array(row["t"].split(), float)
        symmetries = [np.eye(4)] + [np.array(s).reshape(4, 4) for s in info.get("symmetries_discrete", [])]
        errors = [np.inf]
        for truth in truths[scene][row["im_id"]]:
            if str(truth["obj_id"]) == object_id:
                true_rotation = np.array(truth["cam_R_m2c"]).reshape(3, 3)
                for s in symmetries:
                    there = (points @ s[:3, :3].T + s[:3, 3]) @ true_rotation.T + np.array(truth["cam_t_m2c"])
                    errors.append(np.linalg.norm(posed - there, axis=1).max())
        found.append((float(row["score"]), min(errors) / info["diameter"]))
    score, error = np.array(found).T
    right = error < 0.2
    print("threshold  kept  right ones kept  of these < 0.2 d  < 0.5 d")
    for threshold in (0.0, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5):
        kept = score >= threshold
        fifth, half = right[kept].mean(), (error[kept] < 0.5).mean()
        print(f"{threshold:9.2f} {kept.mean():5.2f} {(kept & right).sum() / right.sum():16.2f} {fifth:17.2f} {half:8.2f}")


if __name__ == "__main__":
    main()
