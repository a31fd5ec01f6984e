"""The package `sixfold` against its peers from PyPI: same inputs, same run, one thread each.

    pip install ./python
    pip install poselib==2.0.5 opencv-python-headless open3d small_gicp pycocotools scipy
    python python/benches/compare.py [pnp] [icp] [metrics] [coco] [render] [--cases N] [--toolkit DIR]

Without a name all five run. Open3D's wheel also asks for the system's libusb-1.0, libGL, libX11 and libgomp. A peer that
is not installed is left out, and the table says so. Times are processor time and include the way through Python (arrays in,
arrays out). Poses and clouds go to all solvers in turn, so that all see the same state of the machine; where other programs
run too, only the ratios mean something. The scenes of `pnp` and `icp` are those of `benches/` beside the Rust sources.

pnp      800 correspondences with 30, 60, 80 % outliers, threshold 3 pixels: PoseLib, OpenCV (AP3P, EPnP)
icp      point to plane on a partly hidden object with strays: Open3D, small_gicp
metrics  ADD, ADI, MSSD, MSPD, VSD: their definitions written out in numpy here; with --toolkit DIR (a checkout of
         bop_toolkit, which wants pytz, imageio and pypng) or an installed bop_toolkit_lib that, too
coco     twelve scores of random boxes and masks: pycocotools
render   depth of a scanned-like surface: Open3D's ray caster; pixels at depth edges are left out
"""

import argparse
import contextlib
import importlib
import io
import json
import os
import pathlib
import sys
import time

for variable in ("OMP_NUM_THREADS", "RAYON_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[variable] = "1"
import numpy as np  # noqa: E402

import sixfold  # noqa: E402
from sixfold import coco, metrics  # noqa: E402

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "benches"), str(ROOT / "python/tests")]


def optional(name):
    """The module, or None where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        print(f"  {name}: left out, {error}")
        return None


def timed(work, repeats=3):
    """Result and milliseconds of processor time, all threads together: the median of a few calls after a first one."""
    result = work()
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        result = work()
        times.append(1e3 * (time.process_time() - begin))
    return result, sorted(times)[len(times) // 2]


def angle(a, b):
    return np.degrees(np.arccos(np.clip((np.trace(a.T @ b) - 1) / 2, -1, 1)))


def pnp(arguments):
    import pnp_vs_poselib as scenes

    camera = sixfold.Camera(scenes.FX, scenes.FY, scenes.CX, scenes.CY, 640, 480)

    def ours(points, pixels):
        pose = sixfold.pnp_ransac(points, pixels, camera, threshold_px=3.0).camera_from_object
        return pose[:3, :3], pose[:3, 3]

    solvers = {"Sixfold AP3P": ours}
    poselib, cv2 = optional("poselib"), optional("cv2")
    if poselib:
        theirs = {
            "model": "PINHOLE",
            "width": 640,
            "height": 480,
            "params": [scenes.FX, scenes.FY, scenes.CX, scenes.CY],
        }

        def run_poselib(points, pixels):
            pose, _ = poselib.estimate_absolute_pose(pixels, points, theirs, {"max_reproj_error": 3.0}, {})
            return pose.R, pose.t

        solvers["PoseLib"] = run_poselib
    if cv2:
        cv2.setNumThreads(1)
        for name, flag in (("OpenCV AP3P", cv2.SOLVEPNP_AP3P), ("OpenCV EPnP", cv2.SOLVEPNP_EPNP)):

            def run_opencv(points, pixels, flag=flag):
                found, r, t, _ = cv2.solvePnPRansac(
                    points,
                    pixels,
                    camera.matrix,
                    None,
                    iterationsCount=1000,
                    reprojectionError=3.0,
                    confidence=0.9999,
                    flags=flag,
                )
                return (cv2.Rodrigues(r)[0], t.ravel()) if found else (np.eye(3), np.zeros(3))

            solvers[name] = run_opencv
    count = arguments.cases or 100
    print(f"  {count} cases, {scenes.COUNT} correspondences")
    print("  outliers  solver        rotation median   > 10 deg   translation median   mean time")
    for outliers in (0.3, 0.6, 0.8):
        rng = np.random.default_rng(1)
        cases = [scenes.make_case(rng, outliers, "volume") for _ in range(count)]
        measured = {name: ([], [], []) for name in solvers}
        for points, pixels, rotation, translation in cases:
            for name, solve in solvers.items():
                (r, t), ms = timed(lambda: solve(points, pixels))
                turns, shifts, times = measured[name]
                turns.append(angle(r, rotation))
                shifts.append(1e3 * np.linalg.norm(t - translation))
                times.append(ms)
        for name, (turns, shifts, times) in measured.items():
            print(
                f"  {outliers:8.0%}  {name:12} {np.median(turns):10.2f} deg {np.mean(np.array(turns) > 10):12.1%} "
                f"{np.median(shifts):15.1f} mm {np.mean(times):13.2f} ms"
            )


def icp(arguments):
    o3d, small_gicp = optional("open3d"), optional("small_gicp")
    if not (o3d and small_gicp):
        print("  the scenes of this part need both peers: left out")
        return
    import icp_vs_open3d_small_gicp as scenes

    scenes.clock = time.process_time

    def run_sixfold(cases):
        levels = [(distance, iterations, 1) for distance, iterations in scenes.LEVELS]
        for target, normals, source, source_normals, start, _ in cases:
            found, ms = timed(
                lambda: sixfold.icp(source, target, normals, start, source_normals=source_normals, levels=levels)
            )
            yield found.target_from_source, 0.0, ms

    rng = np.random.default_rng(3)
    cases = [scenes.make_case(rng) for _ in range(arguments.cases or 30)]
    print(f"  {len(cases)} cases, about {len(cases[0][0])} target and {len(cases[0][2])} source points")
    print("                         rotation   translation   success   index and alignment, median")
    runs = {
        "Sixfold": run_sixfold,
        "Open3D": scenes.run_open3d,
        "small_gicp PLANE_ICP": scenes.run_small_gicp("PLANE_ICP"),
        "small_gicp GICP": scenes.run_small_gicp("GICP"),
    }
    measured = {name: ([], [], []) for name in runs}
    for case, *found in zip(cases, *(run(cases) for run in runs.values()), strict=True):
        for (turns, shifts, times), (pose, index, align) in zip(measured.values(), found, strict=True):
            turns.append(angle(pose[:3, :3], case[5][:3, :3]))
            shifts.append(1e3 * np.linalg.norm(pose[:3, 3] - case[5][:3, 3]))
            times.append(index + align)
    for name, (turns, shifts, times) in measured.items():
        success = np.mean((np.array(turns) < 3) & (np.array(shifts) < 3))
        print(
            f"  {name:22} {np.median(turns):6.3f} deg {np.median(shifts):8.3f} mm {success:9.1%} {np.median(times):10.2f} ms"
        )


class InNumpy:
    """The errors as the BOP Challenge defines them (Hodan et al. 2016, 2018, 2020; Hinterstoisser et al. 2012)."""

    def __init__(self, points, symmetries, camera):
        from scipy.spatial import cKDTree

        self.points, self.symmetries, self.camera, self.tree = points, symmetries, camera, cKDTree

    def at(self, pose):
        return self.points @ pose[:3, :3].T + pose[:3, 3]

    def pixels(self, points):
        c = self.camera
        return points[:, :2] / points[:, 2:] * [c.fx, c.fy] + [c.cx, c.cy]

    def add(self, e, g):
        return np.linalg.norm(self.at(e) - self.at(g), axis=1).mean()

    def adi(self, e, g):
        return self.tree(self.at(e)).query(self.at(g))[0].mean()

    def mssd(self, e, g):
        at = self.at(e)
        return min(np.linalg.norm(at - self.at(g @ s), axis=1).max() for s in self.symmetries)

    def mspd(self, e, g):
        at = self.pixels(self.at(e))
        return min(np.linalg.norm(at - self.pixels(self.at(g @ s)), axis=1).max() for s in self.symmetries)


def vsd_in_numpy(e, g, test, camera, diameter, taus, delta=0.015):
    y, x = np.mgrid[: e.shape[0], : e.shape[1]]
    ray = np.sqrt(((x - camera.cx) / camera.fx) ** 2 + ((y - camera.cy) / camera.fy) ** 2 + 1)
    e, g, test = (depth.astype(float) * ray for depth in (e, g, test))
    seen_g = (g > 0) & ((g - test <= delta) | (test == 0))
    seen_e = (e > 0) & ((e - test <= delta) | (test == 0) | seen_g)
    both, either = seen_g & seen_e, seen_g | seen_e
    if not either.any():
        return np.ones(len(taus))
    off = np.abs(g[both] - e[both]) / diameter
    return np.array([((off >= tau).sum() + either.sum() - both.sum()) / either.sum() for tau in taus])


def compare_metrics(arguments):
    from scenes import bumpy_mesh, posed

    if optional("scipy.spatial") is None:
        return
    if arguments.toolkit:
        sys.path.insert(0, arguments.toolkit)
    toolkit = optional("bop_toolkit_lib.pose_error")
    camera = sixfold.Camera(572.4, 573.6, 325.3, 242.0, 640, 480)
    turns = [np.eye(4), np.diag([-1.0, -1, 1, 1]), np.diag([1.0, -1, -1, 1]), np.diag([-1.0, 1, -1, 1])]
    mesh = bumpy_mesh(70, 140).with_symmetries(turns[1:])
    rng = np.random.default_rng(0)

    def pose():
        return posed([*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.6, 1.4)], rng.normal(size=3))

    def near(p):
        return sixfold.pose_exp(rng.normal(size=6) * [0.01, 0.01, 0.02, 0.1, 0.1, 0.1]) @ p

    truths = [pose() for _ in range(arguments.cases or 40)]
    pairs = [(near(p), p) for p in truths]
    plain = InNumpy(mesh.vertices, mesh.symmetries, camera)
    turns_mm = [{"R": s[:3, :3], "t": 1000 * s[:3, 3:]} for s in mesh.symmetries]
    points_mm = 1000 * mesh.vertices

    def theirs(name, e, g):
        poses = (e[:3, :3], 1000 * e[:3, 3:], g[:3, :3], 1000 * g[:3, 3:])
        if name == "mspd":
            return toolkit.mspd(*poses, camera.matrix, points_mm, turns_mm)
        return getattr(toolkit, name)(*poses, *((points_mm, turns_mm) if name == "mssd" else (points_mm,))) / 1000

    print(f"  {len(pairs)} pairs of poses, {len(mesh.vertices)} points, {len(turns)} symmetries")
    print("  error   largest difference to the definition   ours        numpy       bop_toolkit")
    for name in ("add", "adi", "mssd", "mspd"):
        ours = getattr(metrics, name)
        options = (camera,) if name == "mspd" else ()
        a, ms = timed(lambda: [ours(mesh, e, g, *options) for e, g in pairs], 1)
        b, slow = timed(lambda: [getattr(plain, name)(e, g) for e, g in pairs], 1)
        note = "not installed"
        if toolkit:
            c, reference = timed(lambda: [theirs(name, e, g) for e, g in pairs], 1)
            note = f"{reference / len(pairs):.3f} ms, differs by {np.abs(np.subtract(a, c)).max():.1e}"
        unit = "px" if name == "mspd" else "m"
        difference = np.abs(np.subtract(a, b)).max()
        print(f"  {name:6} {difference:20.1e} {unit:2} {ms / len(pairs):25.3f} ms {slow / len(pairs):8.3f} ms  {note}")
    taus = 0.05 * np.arange(1, 11)
    differences, ours_ms, numpy_ms = [], [], []
    for e, g in pairs[:10]:
        drawn = sixfold.render(mesh, g, camera)
        scene, at_e = sixfold.simulate_depth(drawn.depth, drawn.normals), sixfold.render_depth(mesh, e, camera)
        a, ms = timed(lambda: metrics.vsd_of_depth(at_e, drawn.depth, scene, camera, mesh.diameter, taus=taus), 1)
        b, slow = timed(lambda: vsd_in_numpy(at_e, drawn.depth, scene, camera, mesh.diameter, taus), 1)
        differences.append(np.abs(a - b).max())
        ours_ms.append(ms)
        numpy_ms.append(slow)
    print(
        f"  vsd    {max(differences):20.1e}    {np.mean(ours_ms):25.3f} ms {np.mean(numpy_ms):8.3f} ms  from rendered depth images"
    )


def compare_coco(arguments):
    from scenes import scenario

    reference, scoring, runs = (
        optional("pycocotools.coco"),
        optional("pycocotools.cocoeval"),
        optional("pycocotools.mask"),
    )
    if not (reference and scoring and runs):
        return
    names = "ap ap50 ap75 ap_small ap_medium ap_large ar1 ar10 ar100 ar_small ar_medium ar_large".split()
    for kind in ("bbox", "segm"):
        worst, ours_ms, theirs_ms, shown = 0.0, [], [], ""
        for seed in range(arguments.cases or 5):
            rng = np.random.default_rng(seed)
            truth, found = scenario(rng, images=120)
            if kind == "segm":
                for entry in truth["annotations"] + found:
                    x, y, w, h = (int(round(v)) for v in entry["bbox"])
                    mask = np.zeros((240, 320), bool)
                    mask[max(y, 0) : y + h, max(x, 0) : x + w] = (
                        rng.random((240, 320))[max(y, 0) : y + h, max(x, 0) : x + w] < 0.9
                    )
                    entry["segmentation"] = coco.encode_mask(mask)
                    entry.setdefault("area", float(mask.sum()))
                for entry in found:
                    del entry["bbox"], entry["area"]
            with contextlib.redirect_stdout(io.StringIO()):
                # Both sides start from the same dicts.
                text = json.dumps([truth, found])

                def theirs():
                    ground_truth, detections = json.loads(text)
                    base = reference.COCO()
                    base.dataset = ground_truth
                    base.createIndex()
                    run = scoring.COCOeval(base, base.loadRes(detections), kind)
                    run.evaluate()
                    run.accumulate()
                    run.summarize()
                    return run.stats

                stats, slow = timed(theirs, 1)
            scores, ms = timed(lambda: coco.evaluate(truth, found, kind), 1)
            values = np.array([-1 if scores[n] is None else scores[n] for n in names])
            worst = max(worst, np.abs(values - stats).max())
            ours_ms.append(ms)
            theirs_ms.append(slow)
            shown = f"AP {scores['ap']:.4f}"
        print(
            f"  {kind}: largest difference of the twelve scores {worst:.1e} ({shown}); "
            f"ours {np.mean(ours_ms):.1f} ms, pycocotools {np.mean(theirs_ms):.1f} ms"
        )


def compare_render(arguments):
    from scenes import bumpy_mesh, posed

    o3d = optional("open3d")
    if not o3d:
        return
    camera = sixfold.Camera(572.4, 573.6, 325.3, 242.0, 640, 480)
    mesh = bumpy_mesh(100, 100)
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces))
    x, y = np.meshgrid(np.arange(640), np.arange(480))
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
    rng = np.random.default_rng(0)
    differences, by_one, inside, ours_ms, all_ms, theirs_ms = [], 0, 0, [], [], []
    for _ in range(arguments.cases or 20):
        pose = posed([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.25, 0.8)], rng.normal(size=3))
        ours, ms = timed(lambda: sixfold.render_depth(mesh, pose, camera))
        _, everything = timed(lambda: sixfold.render(mesh, pose, camera))
        # With z = 1 in the camera's frame the hit's parameter is the depth.
        origin = -pose[:3, :3].T @ pose[:3, 3]
        cast = np.concatenate([np.broadcast_to(origin, rays.shape), rays @ pose[:3, :3]], -1).astype(np.float32)
        tensor = o3d.core.Tensor(cast)
        hit, slow = timed(lambda: scene.cast_rays(tensor, nthreads=1)["t_hit"].numpy())
        theirs = np.where(np.isfinite(hit), hit, 0)
        edge = np.zeros(theirs.shape, bool)
        for axis in (0, 1):
            for shift in (-1, 1):
                edge |= np.abs(np.roll(theirs, shift, axis) - theirs) > 0.002
        inner = ~edge & (theirs > 0)
        differences.append(1e3 * np.abs(ours - theirs)[inner])
        inside += inner.sum()
        by_one += (((ours > 0) != (theirs > 0)) & inner).sum()
        ours_ms.append(ms)
        all_ms.append(everything)
        theirs_ms.append(slow)
    differences = np.concatenate(differences)
    print(
        f"  {len(mesh.faces)} triangles, {len(ours_ms)} poses, {inside} pixels away from edges, {by_one} of them seen by one only"
    )
    print(
        f"  depth: largest difference {differences.max():.5f} mm, 99.9 % below {np.quantile(differences, 0.999):.5f} mm"
    )
    print(
        f"  time: depth alone {np.median(ours_ms):.2f} ms, with normals, coordinates and colour {np.median(all_ms):.2f} ms, "
        f"Open3D (depth, scene built beforehand) {np.median(theirs_ms):.2f} ms"
    )


PARTS = {"pnp": pnp, "icp": icp, "metrics": compare_metrics, "coco": compare_coco, "render": compare_render}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--cases", type=int, help="cases of each part (default: its own number)")
    parser.add_argument("--toolkit", help="a checkout of bop_toolkit")
    arguments = parser.parse_args()
    for name in arguments.parts:
        if name not in PARTS:
            parser.error(f"part: found {name}, expected one of {', '.join(PARTS)}")
    for name in arguments.parts or PARTS:
        print(f"{name}:")
        PARTS[name](arguments)


if __name__ == "__main__":
    main()
