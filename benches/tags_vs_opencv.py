#!/usr/bin/env python3
"""Corners of tags in real photographs beside the original AprilTag detector's and OpenCV's.

    cargo build --release -p sixfold-board --example tags
    python benches/tags_vs_opencv.py target/release/examples/tags PHOTOGRAPH...

Measured on the three photographs in `test/data` of the public repository AprilRobotics/apriltag (BSD 2-Clause). There is no truth for
them: what is printed is how far apart the corners of two detectors are, median and 90th percentile in pixels, over the tags that both
find. Needs numpy, opencv-python-headless and pupil-apriltags."""

import json
import pathlib
import subprocess
import sys

import cv2
import numpy as np
import pupil_apriltags


def between(a, b):
    """Distances of the corners of one tag by two detectors, whichever corner they start with and way they count."""
    orders = [np.linalg.norm(np.roll(c, k, axis=0) - b, axis=1) for c in (a, a[::-1]) for k in range(4)]
    return min(orders, key=lambda d: d.sum())


def compared(first, second):
    distances = []
    for tag, a in first:
        near = [between(a, b) for other, b in second if tag == other and np.linalg.norm(a.mean(0) - b.mean(0)) < 4]
        if near:
            distances.append(min(near, key=lambda d: d.sum()))
    if not distances:
        return "no tag in common"
    off = np.concatenate(distances)
    return f"{len(distances):3} tags, {np.median(off):.3f}, {np.quantile(off, 0.9):.3f}"


def main():
    program, *files = sys.argv[1:] or [None]
    if program in (None, "-h", "--help") or not files:
        sys.exit(__doc__)
    ours = json.loads(subprocess.run([program, *files], check=True, capture_output=True, text=True).stdout)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    markers = cv2.aruco.ArucoDetector(dictionary, parameters)
    original = pupil_apriltags.Detector("tag36h11", nthreads=1, quad_decimate=1.0)
    for file in files:
        grey = cv2.imread(file, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        corners, ids, _ = markers.detectMarkers(grey)
        found = {
            "sixfold": [(t["id"], np.array(t["corners"])) for t in ours[file]],
            # Its corners count from the image's corner, not from the first pixel's centre.
            "apriltag": [(d.tag_id, d.corners - 0.5) for d in original.detect(grey)],
            "opencv": [] if ids is None else [(int(i), c.reshape(4, 2).astype(float)) for i, c in zip(ids.ravel(), corners)],
        }
        print(pathlib.Path(file).name, ", ".join(f"{name} {len(tags)} tags" for name, tags in found.items()))
        for a, b in [("sixfold", "apriltag"), ("sixfold", "opencv"), ("opencv", "apriltag")]:
            print(f"  {a} - {b}: {compared(found[a], found[b])}")


if __name__ == "__main__":
    main()
