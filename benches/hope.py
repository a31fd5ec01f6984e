"""Objects with printed textures in one real scene under three lamps, from colour alone, without training (HOPE).

    python benches/hope.py target/release/sixfold DIR [--method METHOD] [--out FILE]

DIR holds hope/: photographs of one scene, five textured meshes, ground truth. Each object is searched in each photograph; its best pose is
right if no vertex of the mesh lies further than a tenth of the diameter from its true position (MSSD; of two copies any counts). Printed: how
many are right, the lowest probability of a right one and the highest of a wrong one. Needs NumPy."""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np


def vertices(path):
    """Vertices of an OBJ file, millimetres."""
    lines = (line.split() for line in path.read_text().splitlines() if line.startswith("v "))
    return np.array([[float(v) for v in line[1:4]] for line in lines])


def estimates(binary, method, image, camera, meshes):
    command = [binary, "estimate", "--method", method, "--rgb", image, "--camera", camera, "--unit", "mm", "--min-score", "0"]
    done = subprocess.run([str(c) for c in [*command, "--object", *meshes, "--json"]], capture_output=True, text=True)
    if done.returncode not in (0, 1):
        sys.exit(done.stderr)
    return json.loads(done.stdout)["poses"]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("binary", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--method", default="auto")
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    hope = a.data / "hope"
    truth = json.loads((hope / "scene_gt.json").read_text())
    cameras = json.loads((hope / "scene_camera.json").read_text())
    diameters = {int(k): v["diameter"] for k, v in json.loads((hope / "models/models_info.json").read_text()).items()}
    meshes = sorted((hope / "models_textured").glob("obj_*/textured.obj"))
    points = {int(m.parent.name.removeprefix("obj_")): vertices(m) for m in meshes}
    folder = a.out.parent if a.out else Path(".")
    rows = {}
    for image, instances in truth.items():
        k = cameras[image]["cam_K"]
        camera = folder / f"hope-camera-{image}.json"
        camera.write_text(json.dumps({"fx": k[0], "fy": k[4], "cx": k[2], "cy": k[5], "width": 1920, "height": 1080, "depth_scale": 1.0}))
        found = {}
        for mesh in meshes:
            number = int(mesh.parent.name.removeprefix("obj_"))
            poses = estimates(a.binary, a.method, hope / f"rgb/{int(image):06}.jpg", camera, [mesh])
            if not poses:
                found[number] = {"mssd": None, "confidence": 0.0, "right": False}
                continue
            best = max(poses, key=lambda p: p["confidence"])
            pose = np.array(best["camera_from_object"]).reshape(4, 4)
            at = points[number] @ pose[:3, :3].T + 1000.0 * pose[:3, 3]
            errors = []
            for instance in (i for i in instances if i["obj_id"] == number):
                rotation = np.array(instance["cam_R_m2c"]).reshape(3, 3)
                there = points[number] @ rotation.T + np.array(instance["cam_t_m2c"])
                errors.append(float(np.linalg.norm(at - there, axis=1).max() / diameters[number]))
            found[number] = {"mssd": min(errors), "confidence": best["confidence"], "right": min(errors) < 0.1}
            print(image, number, found[number], file=sys.stderr, flush=True)
        camera.unlink()
        right = [f["confidence"] for f in found.values() if f["right"]]
        wrong = [f["confidence"] for f in found.values() if not f["right"]]
        rows[image] = {"right": len(right), "of": len(found), "lowest_right": min(right, default=None), "highest_wrong": max(wrong, default=None), "objects": found}
        print(f"{image}: {len(right)} of {len(found)} right, lowest {min(right, default=0):.2f}, highest wrong {max(wrong, default=0):.2f}")
    if a.out:
        a.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
