"""COCO AP and AR of random detections: this crate against pycocotools, to 1e-6.

    python coco_vs_pycocotools.py EXAMPLE_BINARY [CASES]     compare on random files
    python coco_vs_pycocotools.py --freeze FOLDER            write the frozen cases of tests/coco.rs

EXAMPLE_BINARY is target/debug/examples/coco_scores (cargo build -p sixfold-bop --example coco_scores). Needs
pycocotools 2.0.11 and numpy.
"""

import contextlib
import io
import json
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
from pycocotools import mask as mask_utils
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

NAMES = ["ap", "ap50", "ap75", "ap_small", "ap_medium", "ap_large",
         "ar1", "ar10", "ar100", "ar_small", "ar_medium", "ar_large"]


def blob(rng, width, height, box):
    """A mask: an ellipse in the box, with some holes."""
    x, y, w, h = box
    ys, xs = np.mgrid[:height, :width]
    m = ((xs - x - w / 2) / (w / 2)) ** 2 + ((ys - y - h / 2) / (h / 2)) ** 2 <= 1
    return np.asfortranarray((m & (rng.random((height, width)) > 0.05)).astype(np.uint8))


def encode(m, compressed):
    rle = mask_utils.encode(m)
    if compressed:
        return {"size": rle["size"], "counts": rle["counts"].decode()}
    flat = m.flatten(order="F")
    edges = np.flatnonzero(np.diff(flat)) + 1
    runs = np.diff(np.concatenate([[0], edges, [flat.size]])).tolist()
    return {"size": list(m.shape), "counts": ([0] if flat[0] else []) + runs}


def case(seed, small):
    rng = np.random.default_rng(seed)
    width, height = (120, 96) if small else (200, 160)
    images = list(range(1, 6 if small else 9))
    categories = [1, 2] if small else [1, 4, 7]
    annotations, detections = [], []
    for image in images:
        for _ in range(int(rng.integers(1, 6 if small else 9))):
            w, h = rng.integers(4, width // 2), rng.integers(4, height // 2)
            box = [int(rng.integers(0, width - w)), int(rng.integers(0, height - h)), int(w), int(h)]
            category = int(rng.choice(categories))
            crowd = int(rng.random() < 0.15)
            m = blob(rng, width, height, box)
            annotations.append({
                "id": len(annotations) + 1, "image_id": image, "category_id": category, "iscrowd": crowd,
                "bbox": box, "area": float(m.sum()), "segmentation": encode(m, rng.random() < 0.5),
            })
            for _ in range(int(rng.integers(0, 4 if small else 6))):
                spread = rng.choice([0, 1, 3])
                near = [int(v + rng.integers(-spread, spread + 1)) for v in box]
                near = [max(near[0], 0), max(near[1], 0), max(near[2], 2), max(near[3], 2)]
                m = blob(rng, width, height, near)
                d = {
                    "image_id": image, "category_id": int(rng.choice([category, categories[0]])),
                    # Few different scores, so that many are equal.
                    "score": float(rng.integers(1, 8) / 8), "bbox": near, "segmentation": encode(m, rng.random() < 0.5),
                }
                detections.append(d)
    if not small:  # An image with more than a hundred detections.
        for _ in range(150):
            w, h = rng.integers(3, 60), rng.integers(3, 60)
            box = [int(rng.integers(0, width - w)), int(rng.integers(0, height - h)), int(w), int(h)]
            m = blob(rng, width, height, box)
            detections.append({"image_id": images[0], "category_id": categories[0],
                               "score": round(float(rng.random()), 2), "bbox": box, "segmentation": encode(m, True)})
    truth = {
        "images": [{"id": i, "width": width, "height": height} for i in images],
        "categories": [{"id": c, "name": str(c)} for c in categories],
        "annotations": annotations,
    }
    return truth, detections


def reference(truth_file, detections_file):
    scores = {}
    with contextlib.redirect_stdout(io.StringIO()):
        for kind, name in [("bbox", "box"), ("segm", "mask")]:
            truth = COCO(truth_file)
            for a in truth.dataset["annotations"]:
                if isinstance(a["segmentation"]["counts"], list):
                    a["segmentation"] = mask_utils.frPyObjects(a["segmentation"], *a["segmentation"]["size"])
            detections = json.load(open(detections_file))
            for d in detections:
                if isinstance(d["segmentation"]["counts"], list):
                    d["segmentation"] = mask_utils.frPyObjects(d["segmentation"], *d["segmentation"]["size"])
            evaluation = COCOeval(truth, truth.loadRes(detections), kind)
            evaluation.evaluate()
            evaluation.accumulate()
            evaluation.summarize()
            scores[name] = dict(zip(NAMES, map(float, evaluation.stats)))
    return scores


def write(folder, name, seed, small):
    truth, detections = case(seed, small)
    files = [str(pathlib.Path(folder) / f"{name}_{part}.json") for part in ("truth", "detections")]
    for path, content in zip(files, (truth, detections)):
        pathlib.Path(path).write_text(json.dumps(content) + "\n")
    return files


def main():
    if sys.argv[1] == "--freeze":
        for name, seed in [("coco_a", 3), ("coco_b", 11)]:
            files = write(sys.argv[2], name, seed, small=True)
            expected = pathlib.Path(sys.argv[2]) / f"{name}_expected.json"
            expected.write_text(json.dumps(reference(*files), indent=1) + "\n")
        return
    worst, cases = 0.0, int(sys.argv[2]) if len(sys.argv) > 2 else 40
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(cases):
            files = write(folder, "case", seed, small=seed % 2 == 0)
            if not json.load(open(files[1])):
                continue
            expected = reference(*files)
            found = json.loads(subprocess.run([sys.argv[1], *files], check=True, stdout=subprocess.PIPE).stdout)
            for kind in expected:
                for name, value in expected[kind].items():
                    mine = -1.0 if found[kind][name] is None else found[kind][name]
                    worst = max(worst, abs(mine - value))
                    if abs(mine - value) > 1e-6:
                        sys.exit(f"case {seed}, {kind} {name}: {mine}, pycocotools says {value}")
    print(f"{cases} cases, 24 numbers each: largest difference {worst:.1e}")


main()
