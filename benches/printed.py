"""Objects with printed textures in simulated clutter with exact ground truth, with the views.

    python benches/printed.py target/release/sixfold DIR OUT [--scenes N]

DIR holds hope/ (five textured meshes) and backgrounds/ (photographs). The scenes are simulated with other objects among them; then each image
gets a photograph as its background, another exposure, blur and noise. All five objects are searched in every image, without a region, and
scored where at least a tenth of them is visible. OUT keeps the scenes, poses.csv and scores.json; run it with another program and another
OUT to compare. Needs NumPy and Pillow."""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image, ImageFilter

CAMERA = {"fx": 980.0, "fy": 980.0, "cx": 639.5, "cy": 359.5, "width": 1280, "height": 720, "depth_scale": 1.0}
VISIBLE = 0.1


def call(*command):
    done = subprocess.run([str(c) for c in command], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    if done.returncode not in (0, 1):
        sys.exit(done.stderr)


def photographed(path, masks, backgrounds, random):
    """Replaces the simulated ground by a photograph, and adds what a camera adds."""
    image = Image.open(path).convert("RGB")
    objects = np.zeros((image.height, image.width), bool)
    for mask in masks:
        objects |= np.asarray(Image.open(mask)) > 0
    behind = Image.open(backgrounds[random.integers(len(backgrounds))]).convert("RGB").resize(image.size)
    pixels = np.where(objects[..., None], np.asarray(image), np.asarray(behind)) / 255.0
    pixels = np.clip(pixels * random.uniform(0.8, 2.2), 0.0, 1.0) ** random.uniform(0.7, 1.2)
    blurred = Image.fromarray((255.0 * pixels).astype(np.uint8)).filter(ImageFilter.GaussianBlur(random.uniform(0.4, 1.1)))
    noisy = np.asarray(blurred) + random.normal(0.0, random.uniform(2.0, 9.0), pixels.shape)
    Image.fromarray(np.clip(noisy, 0.0, 255.0).astype(np.uint8)).save(path)


def simulate(binary, data, scenes, number):
    meshes = sorted((data / "hope/models_textured").glob("obj_*/textured.obj"))
    camera = scenes.parent / "camera.json"
    camera.write_text(json.dumps(CAMERA))
    call(binary, "simulate-scenes", "--object", *meshes, "--unit", "mm", "--families", "all", "--toys", 4, "--scenes", number, "--views", 2,
         "--objects-per-scene", "10,13", "--stacked", 0.6, "--distance", "0.5,1.0", "--elevation", "20,80", "--sensor", "kinect",
         "--camera", camera, "--seed", 11, "--out", scenes)
    backgrounds = sorted((data / "backgrounds").glob("*.jpg"))
    random = np.random.default_rng(1)
    for path in sorted(scenes.glob("test/*/rgb/*")):
        photographed(path, sorted(path.parent.parent.glob(f"mask_visib/{path.stem}_*.png")), backgrounds, random)
    return len(meshes)


def targets(scenes, objects):
    rows = []
    for truth in sorted(scenes.glob("test/*/scene_gt.json")):
        info = json.loads(truth.with_name("scene_gt_info.json").read_text())
        for image, instances in json.loads(truth.read_text()).items():
            for number in range(1, objects + 1):
                seen = [i for i, v in zip(instances, info[image]) if i["obj_id"] == number and v["visib_fract"] > VISIBLE]
                if seen:
                    rows.append({"scene_id": int(truth.parent.name), "im_id": int(image), "obj_id": number, "inst_count": len(seen)})
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("binary", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", type=int, default=14)
    a = parser.parse_args()
    a.out.mkdir(parents=True, exist_ok=True)
    scenes, done = a.out / "scenes", a.out / "objects.json"
    if not done.exists():
        done.write_text(json.dumps(simulate(a.binary, a.data, scenes, a.scenes)))
    objects = json.loads(done.read_text())
    chosen, poses, scores = a.out / "targets.json", a.out / "poses.csv", a.out / "scores.json"
    chosen.write_text(json.dumps(targets(scenes, objects)))
    for old in a.out.glob("poses.csv*"):
        old.unlink()
    began = time.monotonic()
    ids = ",".join(str(i + 1) for i in range(objects))
    call(a.binary, "estimate", "--dataset", scenes, "--targets", "all", "--ids", ids, "--method", "views", "--min-score", 0,
         "--out", poses)
    seconds = time.monotonic() - began
    call(a.binary, "eval", "--dataset", scenes, "--targets", chosen, "--no-vsd", "--results", poses, "--json", scores)
    print(f"{len(json.loads(chosen.read_text()))} targets, {seconds:.0f} s")
    subprocess.run([str(c) for c in [a.binary, "eval", "--dataset", scenes, "--targets", chosen, "--no-vsd", "--results", poses]], check=False)


if __name__ == "__main__":
    main()
