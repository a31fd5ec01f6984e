"""Depth of our renderer against Open3D's ray caster, on the mesh and pose of `bench_render`, one thread each.

    pip install numpy open3d
    python benches/render_vs_open3d.py

Pixels at depth edges (where a neighbour differs by more than 2 mm or is empty) are left out of the difference.
"""

import os
import pathlib
import subprocess
import tempfile
import time

os.environ["OMP_NUM_THREADS"] = "1"
import numpy as np  # noqa: E402
import open3d as o3d  # noqa: E402

ROOT = pathlib.Path(__file__).resolve().parent.parent
K = np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]])


def main():
    with tempfile.TemporaryDirectory() as folder:
        command = ["cargo", "run", "--release", "--quiet", "-p", "sixfold-render", "--example", "bench_render", "--", folder]
        out = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
        vertices = np.fromfile(f"{folder}/vertices.bin").reshape(-1, 3)
        faces = np.fromfile(f"{folder}/faces.bin", dtype=np.uint32).reshape(-1, 3)
        ours = np.fromfile(f"{folder}/depth.bin", dtype=np.float32).reshape(480, 640)
    print(out.stdout, end="")
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces))
    # Rays through pixel centres at whole numbers; with z = 1 the hit's parameter is the depth.
    x, y = np.meshgrid(np.arange(640), np.arange(480))
    directions = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)
    rays = o3d.core.Tensor(np.concatenate([np.zeros_like(directions), directions], -1).astype(np.float32))
    times = []
    for _ in range(20):
        start = time.perf_counter()
        hit = scene.cast_rays(rays, nthreads=1)["t_hit"]
        times.append(1e3 * (time.perf_counter() - start))
    theirs = hit.numpy()
    theirs[~np.isfinite(theirs)] = 0
    edge = np.zeros(theirs.shape, bool)
    for axis in (0, 1):
        for shift in (-1, 1):
            edge |= np.abs(np.roll(theirs, shift, axis) - theirs) > 0.002
    inner = ~edge & (theirs > 0)
    difference = 1e3 * np.abs(ours - theirs)[inner]
    print(f"Open3D ray caster   median {np.median(times):.2f} ms (depth only, scene built beforehand)")
    print(
        f"{inner.sum()} pixels away from edges: largest difference {difference.max():.5f} mm, "
        f"99.9 % below {np.quantile(difference, 0.999):.5f} mm"
    )
    print(f"pixels covered by one only: {np.sum((ours > 0) != (theirs > 0))} (at edges), elsewhere {np.sum(((ours > 0) != (theirs > 0)) & inner)}")


if __name__ == "__main__":
    main()
