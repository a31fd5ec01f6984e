"""PnP with outliers: `bench_pnp` against PoseLib and OpenCV, on the same correspondences, in the same run.

    pip install numpy poselib==2.0.5 opencv-python-headless
    python benches/pnp_vs_poselib.py [--cases 200] [--seed 1] [--no-opencv] [-- options of bench_pnp]

800 correspondences on a 5 cm object 0.6 to 1.4 m away, focal length 572, 3 mm of noise on each object coordinate, threshold 3 pixels;
outliers are other points of the object, as a network that predicts object coordinates gives them. One thread each; the time of a case
is the median of three calls after a first one, without file reading.
"""

import argparse
import os
import pathlib
import subprocess
import tempfile
import time

os.environ["OMP_NUM_THREADS"] = "1"
import numpy as np  # noqa: E402

ROOT = pathlib.Path(__file__).resolve().parent.parent
FX, FY, CX, CY = 572.4114, 573.57043, 325.2611, 242.04899
COUNT = 800


def random_rotation(rng):
    q = rng.normal(size=4)
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def on_the_object(rng, n):
    """Points on an ellipsoid 10 x 8 x 6 cm wide (about 5 cm in radius)."""
    p = rng.normal(size=(n, 3))
    return p / np.linalg.norm(p, axis=1, keepdims=True) * [0.05, 0.04, 0.03]


def in_the_object(rng, n):
    """Points in a cube of 10 cm (5 cm to each side)."""
    return rng.uniform(-0.05, 0.05, size=(n, 3))


def make_case(rng, outliers, shape):
    draw = in_the_object if shape == "volume" else on_the_object
    rotation = random_rotation(rng)
    translation = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.15, 0.15), rng.uniform(0.6, 1.4)])
    # Only the half that faces the camera is seen.
    points = draw(rng, 4 * COUNT)
    normals = points / np.square([0.05, 0.04, 0.03])
    seen = np.einsum("ij,ij->i", points @ rotation.T + translation, normals @ rotation.T) < 0
    points = points[seen if shape == "surface" else slice(None)][:COUNT]
    camera = points @ rotation.T + translation
    pixels = camera[:, :2] / camera[:, 2:] * [FX, FY] + [CX, CY]
    points = points + rng.normal(scale=0.003, size=points.shape)
    wrong = rng.permutation(COUNT)[: int(outliers * COUNT)]
    points[wrong] = draw(rng, len(wrong))
    return points, pixels, rotation, translation


def timed(solve):
    solve()
    times = []
    for _ in range(3):
        start = time.perf_counter()
        pose = solve()
        times.append(time.perf_counter() - start)
    return pose, 1e3 * sorted(times)[1]


def run_poselib(cases):
    import poselib

    camera = {"model": "PINHOLE", "width": 640, "height": 480, "params": [FX, FY, CX, CY]}
    for points, pixels, _, _ in cases:

        def solve():
            pose, _ = poselib.estimate_absolute_pose(pixels, points, camera, {"max_reproj_error": 3.0}, {})
            return pose.R, pose.t

        yield timed(solve)


def run_opencv(flag):
    import cv2

    cv2.setNumThreads(1)
    matrix = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1.0]])

    def run(cases):
        for points, pixels, _, _ in cases:

            def solve():
                found, r, t, _ = cv2.solvePnPRansac(
                    points, pixels, matrix, None, iterationsCount=1000, reprojectionError=3.0, confidence=0.9999, flags=flag
                )
                return (cv2.Rodrigues(r)[0], t.ravel()) if found else (np.eye(3), np.zeros(3))

            yield timed(solve)

    return run


def run_sixfold(solver, options):
    def run(cases):
        with tempfile.TemporaryDirectory() as folder:
            path = os.path.join(folder, "cases.bin")
            with open(path, "wb") as f:
                f.write(np.array([FX, FY, CX, CY]).tobytes())
                f.write(np.array([len(cases), COUNT], dtype=np.uint64).tobytes())
                for points, pixels, _, _ in cases:
                    f.write(points.tobytes() + pixels.tobytes())
            command = ["cargo", "run", "--release", "--quiet", "-p", "sixfold-geometry", "--example", "bench_pnp", "--"]
            out = subprocess.run([*command, path, solver, *options], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
        for line in out.stdout.splitlines():
            v = [float(word) for word in line.split()]
            yield (np.reshape(v[2:11], (3, 3)), np.array(v[11:14])), v[0]

    return run


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--no-opencv", action="store_true")
    parser.add_argument("--shape", choices=["volume", "surface"], default="volume")
    parser.add_argument("rest", nargs="*")
    arguments = parser.parse_args()
    solvers = {
        "Sixfold AP3P": run_sixfold("ap3p", arguments.rest),
        "Sixfold EPnP": run_sixfold("epnp", arguments.rest),
        "PoseLib": run_poselib,
    }
    if not arguments.no_opencv:
        import cv2

        solvers["OpenCV AP3P"] = run_opencv(cv2.SOLVEPNP_AP3P)
        solvers["OpenCV EPnP"] = run_opencv(cv2.SOLVEPNP_EPNP)
    print(f"{arguments.cases} cases, {COUNT} correspondences, one thread")
    print("outliers  solver         rotation median   > 10 deg   translation median   mean      median")
    for outliers in (0.3, 0.6, 0.8):
        rng = np.random.default_rng(arguments.seed)
        cases = [make_case(rng, outliers, arguments.shape) for _ in range(arguments.cases)]
        for name, run in solvers.items():
            rotations, translations, times = [], [], []
            for (pose, ms), (_, _, rotation, translation) in zip(run(cases), cases, strict=True):
                cosine = (np.trace(pose[0].T @ rotation) - 1) / 2
                rotations.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
                translations.append(1e3 * np.linalg.norm(pose[1] - translation))
                times.append(ms)
            rotations = np.array(rotations)
            print(
                f"{outliers:7.0%}   {name:13}  {np.median(rotations):8.2f} deg     {np.mean(rotations > 10):7.1%}   "
                f"{np.median(translations):13.1f} mm   {np.mean(times):8.2f} ms {np.median(times):8.2f} ms",
                flush=True,
            )


if __name__ == "__main__":
    main()
