#!/usr/bin/env python3
"""Tags and calibration of `sixfold calibrate` beside OpenCV's and the original AprilTag detector's, on the same photographs.

    python benches/board_vs_opencv.py PROGRAM PHOTOGRAPHS... [--json FILE] [--keep DIR]

PROGRAM is target/release/sixfold, PHOTOGRAPHS are folders or files; without any, photographs are simulated with exact truth: the
printed sheet (`sixfold board --out board.png`) through a lens, with blur, noise, uneven light and JPEG, something in its middle.
Needs numpy, opencv-python-headless and pupil-apriltags. Times are of one thread, the image in memory for the peers; for the program
they are of the whole process, images read and pictures written.
"""

import argparse
import json
import pathlib
import shutil
import subprocess
import tempfile
import time

import cv2
import numpy as np
import pupil_apriltags

TAG, GAP, COLUMNS, ROWS = 0.024, 0.012, 5, 7
WIDTH, HEIGHT = 1280, 960
K = np.array([[1190.0, 0.0, 645.0], [0.0, 1186.0, 472.0], [0.0, 0.0, 1.0]])
LENS = np.array([-0.15, 0.06, 0.0007, -0.0004, 0.0])


def board_corners(tag):
    x = (tag % COLUMNS) * (TAG + GAP) - 0.5 * (COLUMNS * (TAG + GAP) - GAP)
    y = 0.5 * (ROWS * (TAG + GAP) - GAP) - (tag // COLUMNS) * (TAG + GAP)
    return np.array([[x, y, 0], [x + TAG, y, 0], [x + TAG, y - TAG, 0], [x, y - TAG, 0]])


def distorted(p):
    k1, k2, p1, p2, k3 = LENS
    x, y = p.T
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack([x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=-1)


def simulated(program, folder, count, seed=7):
    """Photographs and, for each, rotation vector and translation of camera_from_board."""
    sheet = folder / "board.png"
    subprocess.run([program, "board", "--out", sheet], check=True, capture_output=True)
    sheet = cv2.imread(str(sheet), cv2.IMREAD_GRAYSCALE).astype(np.float32)
    rng = np.random.default_rng(seed)
    # Millimetres of the sheet's PNG are 8 pixels; the tags' middle lies 8 mm above the sheet's.
    dots = 8000.0
    middle = np.array([0.5 * sheet.shape[1] - 0.5, 0.5 * sheet.shape[0] - 0.008 * dots - 0.5])
    factor = 3
    v, u = np.mgrid[0 : HEIGHT * factor, 0 : WIDTH * factor].astype(np.float64)
    pixels = np.stack([(u + 0.5) / factor - 0.5, (v + 0.5) / factor - 0.5], axis=-1).reshape(-1, 2)
    seen = (pixels - K[:2, 2]) / np.array([K[0, 0], K[1, 1]])
    # Where a pinhole would see it: the lens undone by repetition, which converges for a lens this weak.
    rays = seen
    for _ in range(25):
        rays = rays + seen - distorted(rays)
    rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    truth = []
    for i in range(count):
        azimuth, tilt = 2.4 * i, np.radians(15 + 45 * (i % 5) / 4)
        facing = cv2.Rodrigues(np.array([np.pi, 0, 0]))[0]
        spin = cv2.Rodrigues(np.array([0, 0, 1.3 * i]))[0]
        lean = cv2.Rodrigues(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0]))[0]
        rotation = lean @ facing @ spin
        translation = np.array([*rng.uniform(-0.02, 0.02, 2), rng.uniform(0.32, 0.5)])
        origin = -rotation.T @ translation
        ways = rays @ rotation
        hits = origin[:2] - ways[:, :2] * (origin[2] / ways[:, 2])[:, None]
        at = np.stack([middle[0] + dots * hits[:, 0], middle[1] - dots * hits[:, 1]], axis=-1).astype(np.float32)
        at = at.reshape(HEIGHT * factor, WIDTH * factor, 2)
        image = cv2.remap(sheet, at[..., 0], at[..., 1], cv2.INTER_AREA, borderMode=cv2.BORDER_CONSTANT, borderValue=110)
        image = 25 + 0.82 * image
        hidden = (np.hypot(*hits.T) < 0.04).reshape(image.shape)
        image[hidden] = 70
        image = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
        image = cv2.GaussianBlur(image, (0, 0), 0.7)
        image *= np.linspace(0.7, 1.0, WIDTH, dtype=np.float32)
        image += rng.normal(0, 2.5, image.shape)
        file = folder / f"{i:02}.jpg"
        cv2.imwrite(str(file), np.clip(np.round(image), 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 90])
        truth.append((cv2.Rodrigues(rotation)[0], translation))
    return truth


def opencv_detector():
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)

    def detect(grey):
        corners, ids, _ = detector.detectMarkers(grey)
        return {} if ids is None else {int(i): c.reshape(4, 2).astype(float) for i, c in zip(ids.ravel(), corners)}

    return detect


def original_detector():
    detector = pupil_apriltags.Detector("tag36h11", nthreads=1, quad_decimate=1.0)

    def detect(grey):
        # Its corners count from the image's corner, not from the first pixel's centre, and run the other way round.
        return {d.tag_id: d.corners[::-1][[0, 1, 2, 3]] - 0.5 for d in detector.detect(grey)}

    return detect


def aligned(tags, to):
    """The corners of each tag in the order of `to`, whichever they start with."""
    out = {}
    for tag, corners in tags.items():
        if tag in to:
            orders = [np.roll(c, k, axis=0) for c in (corners, corners[::-1]) for k in range(4)]
            out[tag] = min(orders, key=lambda c: np.abs(c - to[tag]).sum())
    return out


def calibration_error(corners_of, truth):
    """Focal length off by per cent, positions by millimetres and rotations by degrees (medians), by cv2.calibrateCamera."""
    objects, images, used = [], [], []
    for i, tags in enumerate(corners_of):
        if len(tags) >= 4:
            objects.append(np.concatenate([board_corners(t) for t in tags]).astype(np.float32))
            images.append(np.concatenate(list(tags.values())).astype(np.float32))
            used.append(i)
    flags = cv2.CALIB_FIX_K3
    _, matrix, _, rotations, translations = cv2.calibrateCamera(objects, images, (WIDTH, HEIGHT), None, None, flags=flags)
    return pose_errors(matrix[0, 0], [(rotations[k], translations[k].ravel(), truth[i]) for k, i in enumerate(used)])


def pose_errors(focal, poses):
    away = [1000 * np.linalg.norm(t - truth[1]) for _, t, truth in poses]
    turned = []
    for r, _, truth in poses:
        between = cv2.Rodrigues(r)[0] @ cv2.Rodrigues(truth[0])[0].T
        turned.append(np.degrees(np.linalg.norm(cv2.Rodrigues(between)[0])))
    return {
        "focal_off_percent": 100 * abs(focal / K[0, 0] - 1),
        "position_off_mm": float(np.median(away)),
        "rotation_off_degrees": float(np.median(turned)),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program")
    parser.add_argument("photographs", nargs="*", type=pathlib.Path)
    parser.add_argument("--json", type=pathlib.Path)
    parser.add_argument("--keep", type=pathlib.Path, help="folder to keep simulated photographs in")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    result = {}
    with tempfile.TemporaryDirectory() as scratch:
        scratch = pathlib.Path(scratch)
        truth = None
        given = arguments.photographs
        if not given:
            (scratch / "photographs").mkdir()
            truth = simulated(arguments.program, scratch / "photographs", 12)
            (scratch / "photographs" / "board.png").unlink()
            if arguments.keep:
                shutil.copytree(scratch / "photographs", arguments.keep, dirs_exist_ok=True)
            given = [scratch / "photographs"]
        start = time.perf_counter()
        command = [arguments.program, "calibrate", *given, "--out", scratch / "out", "--threads", "1"]
        subprocess.run(command, check=True, capture_output=True)
        seconds = time.perf_counter() - start
        ours = json.loads((scratch / "out" / "photographs.json").read_text())
        tables = {"sixfold": [], "opencv": [], "apriltag": []}
        times = {"sixfold": [1000 * seconds / len(ours["photographs"])], "opencv": [], "apriltag": []}
        detectors = {"opencv": opencv_detector(), "apriltag": original_detector()}
        for photograph in ours["photographs"]:
            tags = {}
            for corner in photograph.get("corners", []):
                tags.setdefault(corner["tag"], []).append(corner["pixel"])
            tables["sixfold"].append({tag: np.array(c) for tag, c in tags.items()})
            path = pathlib.Path(photograph["file"])
            grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
            for name, detect in detectors.items():
                start = time.perf_counter()
                found = detect(grey)
                times[name].append(1000 * (time.perf_counter() - start))
                tables[name].append(found)
        for name, table in tables.items():
            row = {"tags": sum(map(len, table)), "ms": float(np.median(times[name]))}
            if truth is not None:
                right, off = [], []
                for tags, (r, t) in zip(table, truth):
                    known = {k: cv2.projectPoints(board_corners(k), r, t, K, LENS)[0].reshape(4, 2) for k in tags if k < 35}
                    tags = aligned(tags, known)
                    right.append(tags)
                    off += [np.linalg.norm(tags[k] - known[k], axis=1) for k in tags]
                off = np.concatenate(off)
                row |= {"corner_off_median_px": float(np.median(off)), "corner_off_95_px": float(np.quantile(off, 0.95))}
                row |= {"by_opencv_" + k: v for k, v in calibration_error(right, truth).items()}
            else:
                off = []
                for tags, reference in zip(table, tables["sixfold"]):
                    tags = aligned(tags, reference)
                    off += [np.linalg.norm(tags[k] - reference[k], axis=1) for k in tags]
                row["from_sixfold_median_px"] = float(np.median(np.concatenate(off))) if off else None
            result[name] = row
        if truth is not None:
            poses = []
            for photograph, pose in zip(ours["photographs"], truth):
                if "camera_from_board" in photograph:
                    m = np.array(photograph["camera_from_board"])
                    poses.append((cv2.Rodrigues(m[:3, :3])[0], m[:3, 3], pose))
            result["sixfold"] |= pose_errors(ours["camera"]["fx"], poses)
        result["sixfold"]["rms_px"] = ours["rms_px"]
    for name, row in result.items():
        print(name)
        for key, value in row.items():
            print(f"  {key:<34} {value:.4f}" if isinstance(value, float) else f"  {key:<34} {value}")
    if arguments.json:
        # Without times, which differ from run to run.
        kept = {n: {k: v for k, v in row.items() if k != "ms"} for n, row in result.items()}
        arguments.json.write_text(json.dumps(kept, indent=2) + "\n")


if __name__ == "__main__":
    main()
