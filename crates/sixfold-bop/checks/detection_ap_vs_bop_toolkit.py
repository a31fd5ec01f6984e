"""6D detection AP (BOP'24) of a result file on LM-O, computed with the official toolkit's own functions.

    python detection_ap_vs_bop_toolkit.py BOP_TOOLKIT_DIR LMO_DIR RESULTS.csv

Prints AP over MSSD and MSPD thresholds and over MSSD in millimetres. The numbers stand in tests/conformance.rs.
Needs numpy < 2 and scipy. LM-O as cut here has no scene_gt_info.json: every pose counts as visible.
"""

import json
import sys

import numpy as np

toolkit, lmo, results = sys.argv[1:4]
sys.path.insert(0, toolkit)
from bop_toolkit_lib import inout, misc, pose_error, pose_matching, score  # noqa: E402


def main():
    info = {int(k): v for k, v in json.load(open(f"{lmo}/models/models_info.json")).items()}
    targets = json.load(open(f"{lmo}/test_targets_bop19.json"))
    images = sorted({(t["scene_id"], t["im_id"]) for t in targets})
    scene_gt = inout.load_scene_gt(f"{lmo}/test/000002/scene_gt.json")
    camera = inout.load_scene_camera(f"{lmo}/test/000002/scene_camera.json")
    points = {i: inout.load_ply(f"{lmo}/models/obj_{i:06d}.ply")["pts"] for i in info}
    symmetries = {i: misc.get_symmetry_transformations(info[i], 0.01) for i in info}
    estimates = {}
    for e in inout.load_bop_results(results, max_num_estimates_per_image=100):
        estimates.setdefault((e["scene_id"], e["im_id"], e["obj_id"]), []).append(e)

    errors = {"mssd": [], "mspd": []}
    for scene_id, im_id in images:
        for obj_id in dict.fromkeys(gt["obj_id"] for gt in scene_gt[im_id]):
            found = estimates.get((scene_id, im_id, obj_id), [])
            for est_id, e in sorted(enumerate(found), key=lambda x: x[1]["score"], reverse=True):
                both = {"mssd": {}, "mspd": {}}
                for gt_id, gt in enumerate(scene_gt[im_id]):
                    if gt["obj_id"] != obj_id:
                        continue
                    pose = (e["R"], e["t"], gt["cam_R_m2c"], gt["cam_t_m2c"])
                    near = np.linalg.norm(e["t"] - gt["cam_t_m2c"]) < info[obj_id]["diameter"]
                    both["mssd"][gt_id] = [
                        pose_error.mssd(*pose, points[obj_id], symmetries[obj_id]) if near else np.inf
                    ]
                    both["mspd"][gt_id] = [
                        pose_error.mspd(*pose, camera[im_id]["cam_K"], points[obj_id], symmetries[obj_id])
                    ]
                for kind in both:
                    errors[kind].append({
                        "scene_id": scene_id, "im_id": im_id, "obj_id": obj_id, "est_id": est_id,
                        "score": e["score"], "errors": both[kind],
                        "gt_visib_fracts": {g: 1.0 for g in both[kind]},
                    })

    def average_precision(kind, thresholds, by_diameter):
        per_object = {i: [] for i in info}
        for threshold in thresholds:
            scaled = []
            for e in errors[kind]:
                d = info[e["obj_id"]]["diameter"] if by_diameter else 1.0
                scaled.append({**e, "errors": {g: [v[0] / d] for g, v in e["errors"].items()}})
            matches = []
            for scene_id in {s for s, _ in images}:
                ids = [im for s, im in images if s == scene_id]
                gts = {im: scene_gt[im] for im in ids}
                gt_info = {im: [{"visib_fract": 1.0}] * len(gts[im]) for im in ids}
                valid = {im: [True] * len(gts[im]) for im in ids}
                matches += pose_matching.match_poses_scene(
                    scene_id, gts, gt_info, valid, scaled, [threshold], 0
                )
            found = score.calc_pose_detection_scores(
                {s for s, _ in images}, list(info), matches, scaled, visib_gt_min=0.1, do_print=False
            )
            for i, ap in found["scores"].items():
                if found["num_targets_per_object"][i] > 0:
                    per_object[i].append(ap)
        return np.mean([np.mean(v) for v in per_object.values() if v])

    print("ap_mssd", average_precision("mssd", np.arange(0.05, 0.51, 0.05), True))
    print("ap_mspd", average_precision("mspd", np.arange(5, 51, 5), False))
    print("ap_mssd_mm", average_precision("mssd", range(2, 21, 2), False))


main()
