"""Point-to-plane ICP: `bench_icp` against Open3D and small_gicp on the same clouds, in the same run, one thread each.

    pip install numpy open3d small_gicp
    python benches/icp_vs_open3d_small_gicp.py [--cases 60]

An object of 10 cm (an ellipsoid with bumps) on a table: the target is what a depth camera sees of both, 1 mm of noise, 5 % stray points,
a third of the object hidden; the source is 2,000 points of the side of the model that faces the camera; the start has an error of up to 10 mm and
10 degrees. Rejection distances 20, 10 and 5 mm with at most 10, 10 and 20 iterations for all. A success is below 3 mm and 3 degrees.
Index: the search tree of the target. Normals are given to Open3D as to us; small_gicp estimates its own beforehand, not timed.
"""

import argparse
import os
import pathlib
import subprocess
import tempfile
import time

os.environ["OMP_NUM_THREADS"] = "1"
import numpy as np  # noqa: E402
import open3d as o3d  # noqa: E402
import small_gicp  # noqa: E402

ROOT = pathlib.Path(__file__).resolve().parent.parent
clock = time.perf_counter
LEVELS = [(0.02, 10), (0.01, 10), (0.005, 20)]


def rotation_of(w):
    angle = np.linalg.norm(w)
    k = w / angle
    k = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def surface(rng, n):
    """Points and normals of an ellipsoid with bumps."""

    def point(a):
        theta, phi = a[:, 0], a[:, 1]
        r = 1 + 0.15 * np.sin(3 * phi) * np.sin(theta) ** 2 + 0.1 * np.cos(5 * theta)
        d = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
        return d * r[:, None] * [0.05, 0.04, 0.03]

    a = np.stack([np.arccos(rng.uniform(-0.999, 0.999, n)), rng.uniform(0, 2 * np.pi, n)], -1)
    h = 1e-5
    du = point(a + [h, 0]) - point(a - [h, 0])
    dv = point(a + [0, h]) - point(a - [0, h])
    normals = np.cross(du, dv)
    return point(a), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def make_case(rng):
    pose = np.eye(4)
    pose[:3, :3] = rotation_of(rng.normal(size=3))
    pose[:3, 3] = [rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), rng.uniform(0.6, 1.0)]

    def moved(p, n):
        return p @ pose[:3, :3].T + pose[:3, 3], n @ pose[:3, :3].T

    p, n = surface(rng, 16000)
    p, n = moved(p, n)
    seen = np.einsum("ij,ij->i", p, n) < 0
    hidden = p[:, 0] - pose[0, 3] > np.quantile(p[seen, 0] - pose[0, 3], 0.67)
    p, n = p[seen & ~hidden], n[seen & ~hidden]
    table = np.stack([rng.uniform(-0.2, 0.2, 12000), rng.uniform(-0.2, 0.2, 12000), np.full(12000, 0.06)], -1)
    table = table + pose[:3, 3]
    stray = pose[:3, 3] + rng.uniform(-0.08, 0.08, (len(p) // 20, 3))
    stray_normals = rng.normal(size=stray.shape)
    stray_normals /= np.linalg.norm(stray_normals, axis=1, keepdims=True)
    target = np.concatenate([p, table, stray])
    normals = np.concatenate([n, np.tile([0, 0, -1.0], (len(table), 1)), stray_normals])
    target = target + rng.normal(scale=0.001, size=target.shape)
    normals = normals + rng.normal(scale=0.1, size=normals.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    source, source_normals = surface(rng, 8000)
    q, m = moved(source, source_normals)
    front = np.flatnonzero(np.einsum("ij,ij->i", q, m) < 0)[:2000]
    start = np.eye(4)
    axis = rng.normal(size=3)
    start[:3, :3] = rotation_of(axis / np.linalg.norm(axis) * np.radians(rng.uniform(1, 10)))
    offset = rng.normal(size=3)
    start[:3, 3] = offset / np.linalg.norm(offset) * rng.uniform(0, 0.01)
    return target, normals, source[front], source_normals[front], pose @ start, pose


def run_sixfold(cases):
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/clouds.bin"
        with open(path, "wb") as f:
            f.write(np.uint64(len(cases)).tobytes())
            for target, normals, source, source_normals, start, _ in cases:
                f.write(np.array([len(target), len(source)], dtype=np.uint64).tobytes())
                for a in (target, normals, source, source_normals, start[:3]):
                    f.write(np.ascontiguousarray(a).tobytes())
        command = ["cargo", "run", "--release", "--quiet", "-p", "sixfold-geometry", "--example", "bench_icp", "--", path]
        out = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
    for line in out.stdout.splitlines():
        v = [float(word) for word in line.split()]
        pose = np.eye(4)
        pose[:3, :3] = np.reshape(v[2:11], (3, 3))
        pose[:3, 3] = v[11:]
        yield pose, v[0], v[1]


def median_time(work):
    times = []
    for _ in range(3):
        begin = clock()
        result = work()
        times.append(1e3 * (clock() - begin))
    return result, sorted(times)[1]


def run_open3d(cases):
    icp = o3d.pipelines.registration
    for target, normals, source, source_normals, start, _ in cases:
        t, s = o3d.geometry.PointCloud(), o3d.geometry.PointCloud()
        t.points, t.normals = o3d.utility.Vector3dVector(target), o3d.utility.Vector3dVector(normals)
        s.points, s.normals = o3d.utility.Vector3dVector(source), o3d.utility.Vector3dVector(source_normals)

        def work():
            pose = start
            for distance, iterations in LEVELS:
                estimation = icp.TransformationEstimationPointToPlane(icp.TukeyLoss(distance))
                criteria = icp.ICPConvergenceCriteria(1e-6, 1e-6, iterations)
                pose = icp.registration_icp(s, t, distance, pose, estimation, criteria).transformation
            return pose

        # registration_icp builds its tree inside, once a level.
        pose, ms = median_time(work)
        _, tree_ms = median_time(lambda: o3d.geometry.KDTreeFlann(t))
        yield pose, tree_ms, ms - len(LEVELS) * tree_ms


def run_small_gicp(kind):
    def run(cases):
        for target, _, source, _, start, _ in cases:
            t, s = small_gicp.PointCloud(target), small_gicp.PointCloud(source)
            small_gicp.estimate_normals_covariances(t, num_neighbors=20, num_threads=1)
            small_gicp.estimate_normals_covariances(s, num_neighbors=20, num_threads=1)
            tree, tree_ms = median_time(lambda: small_gicp.KdTree(t, num_threads=1))

            def work():
                pose = start
                for distance, iterations in LEVELS:
                    pose = small_gicp.align(
                        t, s, tree, pose, registration_type=kind, max_correspondence_distance=distance,
                        num_threads=1, max_iterations=iterations,
                    ).T_target_source
                return pose

            pose, ms = median_time(work)
            yield pose, tree_ms, ms

    return run


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--cases", type=int, default=60)
    arguments = parser.parse_args()
    rng = np.random.default_rng(3)
    cases = [make_case(rng) for _ in range(arguments.cases)]
    print(f"{len(cases)} cases, about {len(cases[0][0])} target and {len(cases[0][2])} source points, one thread")
    print("                         rotation     translation   success    index       align (median)")
    for name, run in {
        "Sixfold": run_sixfold,
        "Open3D": run_open3d,
        "small_gicp PLANE_ICP": run_small_gicp("PLANE_ICP"),
        "small_gicp GICP": run_small_gicp("GICP"),
    }.items():
        turns, shifts, builds, aligns = [], [], [], []
        for (pose, build, align), case in zip(run(cases), cases, strict=True):
            truth = case[5]
            cosine = (np.trace(pose[:3, :3].T @ truth[:3, :3]) - 1) / 2
            turns.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
            shifts.append(1e3 * np.linalg.norm(pose[:3, 3] - truth[:3, 3]))
            builds.append(build)
            aligns.append(align)
        success = np.mean((np.array(turns) < 3) & (np.array(shifts) < 3))
        print(
            f"{name:22} {np.median(turns):7.3f} deg {np.median(shifts):9.3f} mm {success:10.1%} "
            f"{np.median(builds):8.2f} ms {np.median(aligns):8.2f} ms",
            flush=True,
        )


if __name__ == "__main__":
    main()
