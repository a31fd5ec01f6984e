"""Scores of a detector's file: `sixfold eval --detections` against pycocotools on the same two files, to 1e-6.

    sixfold detect --weights DETECTOR --dataset DIR/lmo --except FRAMES --out detections.json
    sixfold eval --dataset DIR/lmo --detections detections.json --except FRAMES --write-truth truth.json --json scores.json
    python detections_vs_pycocotools.py truth.json detections.json scores.json

Needs pycocotools 2.0.11.
"""

import contextlib
import io
import json
import sys

from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

NAMES = ["ap", "ap50", "ap75", "ap_small", "ap_medium", "ap_large",
         "ar1", "ar10", "ar100", "ar_small", "ar_medium", "ar_large"]


def main():
    truth_file, detections_file, scores_file = sys.argv[1:]
    found = json.load(open(scores_file))
    images = {image["id"] for image in json.load(open(truth_file))["images"]}
    detections = [d for d in json.load(open(detections_file)) if d["image_id"] in images]
    worst = 0.0
    for kind, name in [("bbox", "box"), ("segm", "mask")]:
        if found[name] is None:
            continue
        with contextlib.redirect_stdout(io.StringIO()):
            truth = COCO(truth_file)
            # loadRes takes area and box from one kind: give it what that kind needs.
            evaluation = COCOeval(truth, truth.loadRes([dict(d) for d in detections]), kind)
            evaluation.evaluate()
            evaluation.accumulate()
            evaluation.summarize()
        for key, expected in zip(NAMES, map(float, evaluation.stats)):
            mine = -1.0 if found[name][key] is None else found[name][key]
            worst = max(worst, abs(mine - expected))
            print(f"{name:>4} {key:>10} {mine:.9f} {expected:.9f}")
    print(f"largest difference {worst:.1e}")
    sys.exit(worst > 1e-6)


main()
