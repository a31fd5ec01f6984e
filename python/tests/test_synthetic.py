"""Scenes made from nothing: objects that are drawn, fall on a table, are looked at, and become a BOP dataset."""

import json

import numpy as np
import pytest

import sixfold
from sixfold import bop, coco
from scenes import box_mesh, posed

CAMERA = sixfold.Camera(525.0, 525.0, 319.5, 239.5, 640, 480)


def test_synthetic_objects():
    for kind in ("can", "mug", "cup", "bottle", "bowl", "box", "clamp", "drill", "toy"):
        mesh = sixfold.synthetic_mesh(kind, seed=4)
        assert 0.03 < mesh.diameter < 0.5 and len(mesh.faces) > 4
        assert (mesh.vertices == sixfold.synthetic_mesh(kind, seed=4).vertices).all()
        assert not np.array_equal(mesh.vertices, sixfold.synthetic_mesh(kind, seed=5).vertices)


def test_they_fall_and_rest():
    solids = [sixfold.Solid(box_mesh((0.06, 0.05, 0.04)), convex=True) for _ in range(3)]
    poses = sixfold.drop_objects(solids, stacked=0.0, upright=1.0, seed=2)
    assert len(poses) == 3 and all(pose is not None for pose in poses)
    for pose in poses:
        # Upright on the table: the box's centre is half its height above it, within a millimetre.
        assert abs(pose[2, 3] - 0.02) < 1e-3 and pose[2, 2] > 0.99
    centres = np.array([pose[:2, 3] for pose in poses])
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1)[np.triu_indices(3, 1)]
    assert apart.min() > 0.05
    again = sixfold.drop_objects(solids, stacked=0.0, upright=1.0, seed=2)
    assert all((a == b).all() for a, b in zip(poses, again, strict=True))
    assert sixfold.drop_objects([]) == []


@pytest.fixture
def scene():
    """Two objects before a camera: meshes, poses, drawn."""
    meshes = {3: box_mesh((0.1, 0.06, 0.04)), 7: sixfold.synthetic_mesh("mug", seed=1)}
    poses = {3: posed((0.0, 0.0, 0.6), (0.4, 0.2, 0.1)), 7: posed((0.03, 0.01, 0.8), (0.1, 0.5, 0.0))}
    return meshes, poses, sixfold.render_scene([(meshes[i], poses[i]) for i in meshes], CAMERA)


def test_a_dataset_is_written_and_read(scene, tmp_path):
    meshes, poses, drawn = scene
    meshes[3] = meshes[3].with_symmetries([np.diag([-1.0, -1, 1, 1])])
    with bop.SceneWriter(tmp_path, "train", scene_id=5) as writer:
        writer.add(2, CAMERA, list(poses.items()), rgb=drawn.rgb, depth=drawn.depth, meshes=meshes)
        writer.add(3, CAMERA, [])
    bop.write_models(tmp_path, meshes)
    bop.write_camera(tmp_path, CAMERA, 0.1)
    bop.write_targets(tmp_path / "targets.json", [(5, 2, 3, 1), (5, 2, 7, 1)])
    dataset = bop.Dataset(tmp_path, "train")
    assert dataset.scene_ids == [5] and dataset.image_ids(5) == [2, 3] and dataset.object_ids == [3, 7]
    assert (dataset.rgb(5, 2) == drawn.rgb).all() and dataset.rgb(5, 3) is None
    assert np.abs(dataset.depth(5, 2) - drawn.depth).max() < 0.51e-4
    truth = {g["obj_id"]: g for g in dataset.ground_truth(5, 2)}
    for index, (obj_id, pose) in enumerate(poses.items()):
        assert np.allclose(truth[obj_id]["camera_from_object"], pose, atol=1e-9)
        assert (dataset.mask(5, 2, index) == drawn.masks[index]).all()
    # The box hides some of the mug.
    assert truth[3]["visible"] == 1.0 and 0.05 < truth[7]["visible"] < 0.95
    assert np.allclose(dataset.model(7).vertices, meshes[7].vertices, atol=1e-6)
    assert np.allclose(dataset.model(3).symmetries, meshes[3].symmetries)
    assert dataset.targets(tmp_path / "targets.json") == [(5, 2, 3, 1), (5, 2, 7, 1)]
    camera = json.loads((tmp_path / "camera.json").read_text())
    assert camera["depth_scale"] == 0.1 and camera["fx"] == CAMERA.fx
    # What is right scores 1, what is a box off does not.
    found = [
        {"scene_id": 5, "image_id": 2, "category_id": i, "score": 0.9, "bbox": truth[i]["box_visible"].tolist()}
        for i in poses
    ]
    assert coco.evaluate(dataset, found)["ap"] == pytest.approx(1.0)
    assert coco.evaluate(dataset, found, images=[(5, 3)])["ap"] is None
    found[0]["bbox"][0] += 300
    assert coco.evaluate(dataset, found)["ap"] == pytest.approx(0.5)


def test_what_was_added_is_saved_when_an_error_ends_the_block(tmp_path):
    with pytest.raises(ZeroDivisionError):
        with bop.SceneWriter(tmp_path, "train", 1) as writer:
            writer.add(0, CAMERA, [(1, posed((0, 0, 1), (0, 0, 0)))])
            raise ZeroDivisionError
    assert list(json.loads((tmp_path / "train/000001/scene_gt.json").read_text())) == ["0"]


def test_wrong_use(scene, tmp_path):
    meshes, poses, drawn = scene
    writer = bop.SceneWriter(tmp_path / "out", "train", 1)
    lens = sixfold.Camera(525, 525, 320, 240, 640, 480, distortion=(0.1, 0, 0, 0))
    objects = list(poses.items())
    solid = sixfold.Solid(meshes[3], convex=True)
    for call, name in [
        (lambda: bop.SceneWriter(tmp_path, "train", -1), "scene_id"),
        (lambda: writer.add(-1, CAMERA, objects), "im_id"),
        (lambda: writer.add(0, lens, objects), "camera"),
        (lambda: writer.add(0, CAMERA, [3]), "objects"),
        (lambda: writer.add(0, CAMERA, 3), "objects"),
        (lambda: writer.add(0, CAMERA, [(3, np.eye(3))]), "objects"),
        (lambda: writer.add(0, CAMERA, [(-3, np.eye(4))]), "objects"),
        (lambda: writer.add(0, CAMERA, objects, rgb=drawn.rgb[:9]), "rgb"),
        (lambda: writer.add(0, CAMERA, objects, rgb=drawn.depth), "rgb"),
        (lambda: writer.add(0, CAMERA, objects, depth=drawn.depth[:, :9]), "depth"),
        (lambda: writer.add(0, CAMERA, objects, mm_per_unit=0), "mm_per_unit"),
        (lambda: writer.add(0, CAMERA, objects, camera_from_world=np.full((4, 4), np.nan)), "camera_from_world"),
        (lambda: writer.add(0, CAMERA, objects, meshes={3: meshes[3]}), "meshes: .*object 7"),
        (lambda: bop.write_targets(tmp_path / "t.json", [(1, 1, 1, 0)]), "targets"),
        (lambda: bop.write_camera(tmp_path, lens, 0.1), "camera"),
        (lambda: bop.write_camera(tmp_path, CAMERA, -1), "mm_per_unit"),
        (lambda: sixfold.synthetic_mesh("teapot"), "kind: .*mug.* or toy, found"),
        (lambda: sixfold.synthetic_mesh(seed=-1), "seed"),
        (lambda: sixfold.drop_objects([solid], radius=-1), "radius"),
        (lambda: sixfold.drop_objects([solid], reach=0.1), "reach"),
        (lambda: sixfold.drop_objects([solid], upright=np.nan), "upright"),
        (lambda: sixfold.drop_objects([solid], stacked=2), "stacked"),
        (lambda: sixfold.drop_objects([meshes[3]]), "solids"),
        (lambda: coco.evaluate({"images": [], "annotations": []}, [], images=[(1, 1)]), "images"),
    ]:
        with pytest.raises(ValueError, match=f"^{name}"):
            call()
    assert not (tmp_path / "out").exists()
    file = tmp_path / "file"
    file.write_text("no folder")
    for call in (
        lambda: bop.SceneWriter(file / "below", "train", 1).finish(),
        lambda: bop.write_models(file / "below", meshes),
        lambda: bop.write_camera(file / "below", CAMERA, 1.0),
    ):
        with pytest.raises(OSError):
            call()
