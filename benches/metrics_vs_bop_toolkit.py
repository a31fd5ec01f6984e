"""MSSD + MSPD + ADD over the LM-O targets: the official toolkit against `bench_metrics`, in the same run.

    python benches/metrics_vs_bop_toolkit.py BOP_TOOLKIT_DIR LMO_DIR RESULTS.csv

BOP_TOOLKIT_DIR is a checkout of github.com/thodan/bop_toolkit; needs numpy < 2, scipy and cargo. Files and models are
read before the clock starts, on both sides. Also checks that both give the same errors.
"""

import csv
import json
import pathlib
import subprocess
import sys
import tempfile
import time

import numpy as np

toolkit, lmo, results = sys.argv[1:4]
sys.path.insert(0, toolkit)
from bop_toolkit_lib import inout, misc, pose_error  # noqa: E402

ROOT = pathlib.Path(__file__).resolve().parent.parent


def reference():
    info = {int(k): v for k, v in json.load(open(f"{lmo}/models/models_info.json")).items()}
    targets = json.load(open(f"{lmo}/test_targets_bop19.json"))
    scene_gt = inout.load_scene_gt(f"{lmo}/test/000002/scene_gt.json")
    camera = inout.load_scene_camera(f"{lmo}/test/000002/scene_camera.json")
    points = {i: inout.load_ply(f"{lmo}/models/obj_{i:06d}.ply")["pts"] for i in info}
    symmetries = {i: misc.get_symmetry_transformations(info[i], 0.01) for i in info}
    best = {}
    for e in inout.load_bop_results(results):
        key = (e["im_id"], e["obj_id"])
        if key not in best or e["score"] > best[key]["score"]:
            best[key] = e
    pairs = []
    for t in targets:
        gt = next(g for g in scene_gt[t["im_id"]] if g["obj_id"] == t["obj_id"])
        e = best.get((t["im_id"], t["obj_id"]))
        e = (e["R"], e["t"]) if e else (gt["cam_R_m2c"], gt["cam_t_m2c"])
        pairs.append((t["im_id"], t["obj_id"], (*e, gt["cam_R_m2c"], gt["cam_t_m2c"])))
    fastest, errors = float("inf"), {}
    for _ in range(2):
        start = time.perf_counter()
        for im_id, obj_id, pose in pairs:
            pts, syms = points[obj_id], symmetries[obj_id]
            errors[im_id, obj_id] = (
                pose_error.mssd(*pose, pts, syms) / 1000,
                pose_error.mspd(*pose, camera[im_id]["cam_K"], pts, syms),
                pose_error.add(*pose, pts) / 1000,
            )
        fastest = min(fastest, time.perf_counter() - start)
    return fastest * 1e3, errors


def ours(errors_file):
    command = ["cargo", "run", "--release", "--quiet", "-p", "sixfold-bop", "--example", "bench_metrics", "--"]
    out = subprocess.run(
        [*command, lmo, results, errors_file], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True
    )
    return json.loads(out.stdout)


def main():
    theirs_ms, theirs = reference()
    with tempfile.TemporaryDirectory() as folder:
        errors_file = f"{folder}/errors.csv"
        found = ours(errors_file)
        rows = {(int(r[0]), int(r[1])): [float(v) for v in r[2:]] for r in csv.reader(open(errors_file))}
    assert rows.keys() == theirs.keys(), "the two sides compared different targets"
    difference = np.max([np.abs(np.subtract(rows[k], theirs[k])) for k in rows], axis=0)
    print(f"targets                    {found['targets']}")
    print(f"official toolkit           {theirs_ms:10.1f} ms")
    print(f"sixfold, one thread        {found['one_thread_ms']:10.1f} ms   {theirs_ms / found['one_thread_ms']:.0f}x")
    print(
        f"sixfold, {found['threads']} threads         {found['all_threads_ms']:10.1f} ms   "
        f"{theirs_ms / found['all_threads_ms']:.0f}x"
    )
    print("largest difference         MSSD {:.1e} m, MSPD {:.1e} px, ADD {:.1e} m".format(*difference))


main()
