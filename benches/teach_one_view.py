"""Six real objects taught from one photograph with depth each (tabletop objects).

    python benches/teach_one_view.py target/release/sixfold DIR [--out FOLDER]

DIR holds tabletop_objects/NAME/{rgb,depth,mask}.png with camera.json, and meshes/ycb. Each object is taught with its mask by `sixfold teach`.
Printed: the mesh's diameter and height above the table, the fraction of its surface that the photograph does not show, the median distance of
the mesh to the measured depth in the object's pixels, the overlap of its silhouette with the mask, and seconds. The mustard bottle is YCB's
(the cracker box is of another size): its mesh is compared with the true one, which point pair features find in the same image.
Needs the packages sixfold, numpy, pillow and scipy."""

import argparse
import json
import subprocess
import time
from pathlib import Path

import numpy as np
import sixfold
from PIL import Image
from scipy.spatial import cKDTree


def camera_of(folder):
    c = json.loads((folder / "camera.json").read_text())
    k = c["cam_K"]
    return sixfold.Camera(k[0], k[4], k[2], k[5], c["width"], c["height"]), c["depth_scale"]


def taught(binary, folder, out, scale):
    """The mesh, the camera's pose relative to it, and the seconds it took."""
    entry = {"image": "rgb.png", "camera": "camera.json", "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0, 0, 0], "mask": "mask.png",
             "depth": "depth.png", "depth_scale": scale}
    for key in ("image", "camera", "mask", "depth"):
        entry[key] = str((folder / entry[key]).resolve())
    out.mkdir(parents=True, exist_ok=True)
    listed = out / "photographs.json"
    listed.write_text(json.dumps({"photographs": [entry]}))
    start = time.monotonic()
    command = [binary, "teach", folder.name, "--photographs", listed, "--store", out / "objects", "--out", out / "teaching", "--replace"]
    subprocess.run([str(c) for c in command], check=True, capture_output=True)
    seconds = time.monotonic() - start
    facts = json.loads((out / "teaching" / "teaching.json").read_text())["shape"]
    return sixfold.Mesh.load(str(out / "teaching" / "mesh.ply"), unit="m"), np.array(facts["board_from_object"]), facts["unseen"], seconds


def height(mesh, pose, depth, mask, camera):
    """Extent of the mesh along the normal of the plane around the object, metres."""
    v, u = np.nonzero((depth > 0) & ~mask)
    z = depth[v, u]
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], 1)[::7]
    random, best = np.random.default_rng(0), None
    for _ in range(300):
        a, b, c = points[random.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        if np.linalg.norm(normal) < 1e-9:
            continue
        normal = normal / np.linalg.norm(normal)
        near = np.abs(points @ normal - a @ normal) < 0.005
        if best is None or near.sum() > best.sum():
            best = near
    centre = points[best].mean(0)
    normal = np.linalg.svd(points[best] - centre, full_matrices=False)[2][2]
    normal = normal if normal @ centre < 0 else -normal
    return float(((mesh.vertices @ pose[:3, :3].T + pose[:3, 3] - centre) @ normal).max())


def surface(mesh, pose):
    points = mesh.sample_surface(50_000)
    points = points[0] if isinstance(points, tuple) else getattr(points, "points", points)
    return np.asarray(points) @ pose[:3, :3].T + pose[:3, 3]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("binary", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, default=Path("out/teach-one-view"))
    a = parser.parse_args()
    rows = []
    for folder in sorted((a.data / "tabletop_objects").iterdir()):
        camera, scale = camera_of(folder)
        depth = np.asarray(Image.open(folder / "depth.png")).astype(np.float32) * scale / 1000
        mask = np.asarray(Image.open(folder / "mask.png").convert("L")) > 0
        mesh, pose, unseen, seconds = taught(a.binary, folder, a.out / folder.name, scale)
        drawn = sixfold.render(mesh, pose, camera)
        both = mask & (depth > 0) & drawn.mask
        off = float(np.median(np.abs(drawn.depth[both] - depth[both])))
        overlap = (mask & drawn.mask).sum() / (mask | drawn.mask).sum()
        row = [folder.name.replace("_", " "), round(1000 * mesh.diameter), round(1000 * height(mesh, pose, depth, mask, camera)), round(unseen, 2),
               round(1000 * off, 2), round(float(overlap), 3), round(seconds, 1)]
        print(json.dumps(row))
        rows.append(row)
        if folder.name == "mustard":
            true = sixfold.Mesh.load(str(a.data / "meshes" / "ycb" / "MustardBottle.ply"), unit="mm")
            found = sixfold.estimate_ppf(depth, true, camera, mask=mask, min_score=0.0)[0]
            there, here = surface(true, found.camera_from_object), surface(mesh, pose)
            both_ways = [1000 * cKDTree(y).query(x)[0].mean() for x, y in ((here, there), (there, here))]
            print(f"mustard: mesh to truth {both_ways[0]:.2f} mm, truth to mesh {both_ways[1]:.2f} mm, true diameter {1000 * true.diameter:.1f} mm")
    print(json.dumps(rows))


if __name__ == "__main__":
    main()
