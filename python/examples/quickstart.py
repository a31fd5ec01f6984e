"""Quickstart: from a mesh and an image to poses, with an image of every step.

    pip install ./python matplotlib
    python python/examples/quickstart.py [--data data/demo] [--weights weights/pix2pose-lmo.safetensors]
        [--detector weights/detector-lmo.safetensors] [--out out]

Reads one real frame of LM-O that comes with the repository and writes OUT/quickstart.png. Each part stands for itself;
the lines starting with `# %%` make cells in an editor that knows them.
"""

# %% What is needed
import argparse
import pathlib
import time

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import sixfold
from sixfold import bop, metrics

ROOT = pathlib.Path(__file__).resolve().parents[2]
parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument(
    "--data", type=pathlib.Path, default=ROOT / "data/demo", help="a BOP dataset (default: %(default)s)"
)
parser.add_argument("--weights", type=pathlib.Path, default=ROOT / "weights/pix2pose-lmo.safetensors")
parser.add_argument("--detector", type=pathlib.Path, default=ROOT / "weights/detector-lmo.safetensors")
parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("out"), help="folder for the image")
arguments = parser.parse_args()
COLORS = ["#e69f00", "#56b4e9", "#009e73", "#f0e442", "#d55e00", "#cc79a7", "#0072b2", "#a06e3c"]
SCENE, IMAGE, SHOWN = 2, 3, 8


def outline(axes, mesh, pose, color, label):
    """Draws the border of an object at a pose."""
    mask = sixfold.render_depth(mesh, pose, camera) > 0
    if mask.any():
        axes.contour(mask, levels=[0.5], colors=[color], linewidths=1.4)
        rows, columns = np.nonzero(mask)
        axes.text(columns.mean(), rows.min() - 4, label, color="white", fontsize=7, ha="center", backgroundcolor=color)


def judge(mesh, pose, truth):
    """ADD or, for a symmetric object, ADI, in millimetres and as a fraction of the diameter."""
    error = (metrics.adi if len(mesh.symmetries) > 1 else metrics.add)(mesh, pose, truth)
    return 1000 * error, error / mesh.diameter


# %% A dataset: images, camera, ground truth, models with their symmetries. Metres from here on.
dataset = bop.Dataset(arguments.data)
camera = dataset.camera(SCENE, IMAGE)
rgb, depth = dataset.rgb(SCENE, IMAGE), dataset.depth(SCENE, IMAGE)
truth = {g["obj_id"]: g["camera_from_object"] for g in dataset.ground_truth(SCENE, IMAGE)}
meshes = {i: dataset.model(i) for i in truth}
print(f"{camera}\n{len(meshes)} objects in scene {SCENE}, image {IMAGE}")
figure, panels = plt.subplots(2, 3, figsize=(15, 8.4), constrained_layout=True)
for axes in panels.flat[:5]:
    axes.axis("off")

# %% Render: depth, mask, normals, object coordinates, colour
mesh = meshes[SHOWN]
drawn = sixfold.render(mesh, truth[SHOWN], camera, background=rgb // 3)
rows, columns = np.nonzero(drawn.mask)
view = np.s_[rows.min() - 8 : rows.max() + 9, columns.min() - 8 : columns.max() + 9]
low, high = mesh.bounding_box
coordinates = np.nan_to_num((drawn.coordinates - low) / (high - low), nan=1.0).clip(0, 1)
panels[0, 0].imshow(np.hstack([drawn.rgb[view] / 255.0, (drawn.normals[view] + 1) / 2, coordinates[view]]))
panels[0, 0].set_title(f"render: object {SHOWN} in colour, normals, object coordinates")

# %% PnP: a fifth of the object's pixels with noise, half of them wrong
rng = np.random.default_rng(0)
keep = rng.permutation(len(rows))[: len(rows) // 5]
pixels = np.stack([columns, rows], axis=1)[keep].astype(float)
points = drawn.coordinates[rows, columns][keep] + rng.normal(scale=0.002, size=(len(keep), 3))
wrong = rng.random(len(keep)) < 0.5
points[wrong] = rng.permutation(points[wrong])
pnp = sixfold.pnp_ransac(points, pixels, camera, threshold_px=3.0)
pose, inliers = pnp
print(f"PnP: {inliers.sum()} of {len(inliers)} correspondences agree, {judge(mesh, pose, truth[SHOWN])[0]:.1f} mm ADD")
panels[0, 1].imshow(rgb[view], extent=(view[1].start, view[1].stop, view[0].stop, view[0].start))
panels[0, 1].scatter(*pixels[inliers].T, s=2, c="#009e73", label=f"{inliers.sum()} inliers")
panels[0, 1].scatter(*pixels[~inliers].T, s=2, c="#d55e00", label=f"{(~inliers).sum()} outliers")
panels[0, 1].legend(loc="lower right")
panels[0, 1].set_title("PnP with every second correspondence wrong")

# %% ICP: the object's surface against the measured depth, from a pose with an error of 1 cm and 8 degrees
start = truth[SHOWN] @ sixfold.pose_exp([0.006, -0.004, 0.007, 0.1, -0.08, 0.06])
seen = sixfold.render(mesh, start, camera)
surface = seen.coordinates[seen.mask]
try:
    aligned = sixfold.icp_to_depth(surface, depth, camera, start, rejection_distance=0.02)
    before, after = judge(mesh, start, truth[SHOWN])[0], judge(mesh, aligned.target_from_source, truth[SHOWN])[0]
    print(f"ICP: {before:.1f} mm ADD before, {after:.1f} mm after {aligned.iterations} iterations")
except sixfold.NoSolutionError as error:
    print(f"ICP: {error}")
valid = np.where(depth > 0, depth, np.nan)
shown = panels[0, 2].imshow(valid, cmap="viridis_r", vmin=np.nanpercentile(valid, 2), vmax=np.nanpercentile(valid, 98))
figure.colorbar(shown, ax=panels[0, 2], shrink=0.75, label="metres")
panels[0, 2].set_title("measured depth")

# %% Poses from depth alone: nothing but meshes, nobody says where to look
begin = time.perf_counter()
models = {obj_id: sixfold.PpfModel(mesh) for obj_id, mesh in meshes.items()}
print(f"depth alone: {len(models)} objects described in {time.perf_counter() - begin:.1f} s (once an object)")
begin = time.perf_counter()
scene = sixfold.PpfScene(depth, camera)
from_depth = {}
for obj_id, model in models.items():
    found = sixfold.estimate_ppf(scene, model)
    if found:
        from_depth[obj_id] = found[0].camera_from_object
print(f"depth alone: poses of {len(from_depth)} objects in {time.perf_counter() - begin:.1f} s")
panels[1, 0].imshow(rgb)
for color, (obj_id, pose) in zip(COLORS, from_depth.items()):
    outline(panels[1, 0], meshes[obj_id], pose, color, obj_id)
panels[1, 0].set_title("poses from depth alone (point pair features)")

# %% An object by its templates, with nothing but the mesh, and then without one: cut out of this very image
begin = time.perf_counter()
templates = sixfold.Templates.from_mesh(mesh, coverage="around")
found = sixfold.estimate_mttm(scene, sixfold.Mttm(templates, mesh), min_score=0.2)
said = f"{judge(mesh, found[0].camera_from_object, truth[SHOWN])[0]:.1f} mm ADD" if found else "not found"
print(f"templates: {len(templates)} views of object {SHOWN}, {said}, {time.perf_counter() - begin:.1f} s")
seen = sixfold.Templates.from_depth([(depth, camera, drawn.mask)])
again = sixfold.estimate_mttm(scene, seen, min_score=0.2)
shared = (again[0].mask & drawn.mask).sum() / drawn.mask.sum() if again else 0.0
print(f"templates: one masked view in place of the mesh, {100 * shared:.0f} % of its mask found again")

# %% Poses from colour alone: a detector says where the objects are, a second network how they are turned
from_colour = {}
panels[1, 1].imshow(rgb)
if arguments.weights.exists() and arguments.detector.exists():
    detector = sixfold.Detector.load(arguments.detector)
    network = sixfold.Pix2Pose.load(arguments.weights, camera=camera, meshes=meshes)
    begin = time.perf_counter()
    detected = detector(rgb, threshold=0.3, per_object=1)  # each object is there once, so unsure boxes are worth a look
    for found in network(rgb, [d.bbox for d in detected], [d.object_id for d in detected]):
        if found is not None:
            from_colour[found.object_id] = found.camera_from_object
    print(f"colour alone: {len(from_colour)} of {len(detected)} detected in {time.perf_counter() - begin:.1f} s")
    for color, (obj_id, pose) in zip(COLORS, from_colour.items()):
        outline(panels[1, 1], meshes[obj_id], pose, color, obj_id)
else:
    print(f"colour alone: left out, {arguments.weights} or {arguments.detector} is not there")
panels[1, 1].set_title("poses from colour alone (detector and Pix2Pose)")

# %% Errors: below a tenth of the diameter a pose counts as right
labels = sorted(truth)
for offset, (name, poses) in enumerate([("depth", from_depth), ("colour", from_colour)]):
    fractions = [judge(meshes[i], poses[i], truth[i])[1] if i in poses else np.nan for i in labels]
    right = np.nansum(np.array(fractions) < 0.1)
    panels[1, 2].bar(
        np.arange(len(labels)) + 0.4 * offset - 0.2,
        np.minimum(fractions, 0.5),
        0.38,
        color=COLORS[5 * offset + 1],
        label=f"{name}: {right} of {len(labels)} right",
    )
    for i, fraction in zip(labels, fractions):
        print(
            f"  {name:6} object {i:2}: " + ("not found" if np.isnan(fraction) else f"{100 * fraction:5.1f} % of the diameter")
        )
panels[1, 2].axhline(0.1, color="black", linewidth=1)
panels[1, 2].set_xticks(range(len(labels)), [str(i) for i in labels])
panels[1, 2].set_ylim(0, 0.5)
panels[1, 2].set(xlabel="object", ylabel="ADD(-S) / diameter, cut at 0.5", title="errors against ground truth")
panels[1, 2].legend()

# %% A grasp tried in a physics engine: from above, across the narrower side of the object at rest on a table
solid = sixfold.Solid(mesh)
rest = solid.rest()
if rest is not None:
    low, high = mesh.transformed(rest).bounding_box
    narrow = np.argmin((high - low)[:2])
    grasp = sixfold.gripper_pose([*(low + high)[:2] / 2, high[2] - 0.03], closing=np.eye(3)[narrow])
    trial = sixfold.try_grasp(solid, grasp, world_from_object=rest, gripper="jaws-140")
    print(f"physics: object {SHOWN} in {solid.part_count} convex parts, grasped from above: {trial.outcome}")

# %% The image, and the estimates as a result file of the BOP Challenge
arguments.out.mkdir(parents=True, exist_ok=True)
figure.savefig(arguments.out / "quickstart.png", dpi=110)
estimates = [bop.Estimate(SCENE, IMAGE, i, 1.0, pose) for i, pose in from_depth.items()]
bop.write_results(arguments.out / "quickstart.csv", estimates)
print(f"{arguments.out / 'quickstart.png'}, {arguments.out / 'quickstart.csv'}")
