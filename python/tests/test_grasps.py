"""Grasps on a rendered table scene."""

import json

import numpy as np
import pytest

import sixfold
from scenes import box_mesh, posed


@pytest.fixture(scope="module")
def scene():
    """A box on a table, seen from above at a slant: depth, camera, box's mask and pose."""
    camera = sixfold.Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
    box, table = box_mesh((0.05, 0.16, 0.06)), box_mesh((1.2, 1.2, 0.02))
    view = posed((0.0, 0.05, 0.75), (2.5, 0.0, 0.0))
    on_table = view @ posed((0.02, -0.01, 0.03), (0.0, 0.0, 0.4))
    drawn = sixfold.render_scene([(table, view @ posed((0, 0, -0.01), (0, 0, 0))), (box, on_table)], camera)
    return drawn.depth, camera, drawn.masks[1], on_table


def test_the_box_is_found_on_the_table(scene):
    depth, camera, mask, _ = scene
    [found] = sixfold.find_objects(depth, camera)
    assert found.dtype == bool and found.shape == depth.shape
    assert (found & mask).sum() > 0.8 * mask.sum() and (found & ~mask).sum() < 0.1 * mask.sum()


def test_grasps_hold_the_box_at_its_narrow_sides(scene):
    depth, camera, mask, box = scene
    grasps = sixfold.propose_grasps(depth, camera, mask, gripper="jaws-85", most=8)
    assert 1 <= len(grasps) <= 8
    assert [g.score for g in grasps] == sorted((g.score for g in grasps), reverse=True)
    best = grasps[0]
    assert 0 < best.quality <= 1 and best.opening <= 0.085 and best.members >= 1
    for part in (best.alignment, best.support, best.centring, best.observed):
        assert 0 <= part <= 1
    gripper = np.linalg.inv(box) @ best.camera_from_gripper
    # Closes across a side that the gripper can span, 5 or 6 cm, never along the 16 cm.
    closing = np.abs(gripper[:3, 0])
    assert closing[1] < 0.3 and 0.04 < best.width < 0.075
    assert np.all(np.abs(gripper[:3, 3]) < [0.04, 0.09, 0.06])


def test_without_a_mask_and_with_the_same_seed(scene):
    depth, camera, mask, _ = scene
    first, second = (sixfold.propose_grasps(depth, camera, gripper="jaws-85", seed=3) for _ in range(2))
    assert len(first) == len(second) > 0
    for a, b in zip(first, second):
        assert a.camera_from_gripper.tobytes() == b.camera_from_gripper.tobytes()
    seen = sixfold.propose_grasps(depth, camera, mask, gripper="jaws-85", seen_only=True)
    assert all(g.observed == 1 for g in seen)


def test_grippers(tmp_path):
    gripper = sixfold.Gripper.built_in("jaws-140")
    assert gripper.max_opening == 0.14 and gripper.force > 0 and gripper.friction > 0
    assert gripper.finger_length > 0 and gripper.finger_width > 0 and gripper.name == "jaws-140"
    low, high = gripper.mesh(0.1).bounding_box
    assert high[2] == 0 and high[0] - low[0] > 0.1
    file = tmp_path / "gripper.json"
    fields = {
        "kind": "parallel-jaws",
        "name": "mine",
        "max_opening": 0.1,
        "finger_length": 0.05,
        "finger_width": 0.02,
        "finger_thickness": 0.01,
        "palm_width": 0.12,
        "palm_depth": 0.05,
        "palm_height": 0.1,
        "force": 20,
        "friction": 0.6,
    }
    file.write_text(json.dumps(fields))
    assert sixfold.Gripper.load(file).max_opening == 0.1
    file.write_text(json.dumps({**fields, "max_opening": 100}))
    with pytest.raises(ValueError, match="max_opening.*metres"):
        sixfold.Gripper.load(file)
    with pytest.raises(FileNotFoundError):
        sixfold.Gripper.load(tmp_path / "none.json")
    with pytest.raises(ValueError, match="opening"):
        gripper.mesh(0.2)
    with pytest.raises(ValueError, match="jaws-85"):
        sixfold.Gripper.built_in("hand")


def test_pictures(scene):
    depth, camera, mask, _ = scene
    grasps = sixfold.propose_grasps(depth, camera, mask)
    black = np.zeros((*depth.shape, 3), np.uint8)
    assert (sixfold.draw_grasps(black, [], camera) == black).all()
    picture = sixfold.draw_grasps(black, grasps, camera, depth=depth)
    assert picture.shape == black.shape and 500 < (picture.max(axis=2) > 0).sum() < 200_000


def test_wrong_use(scene):
    depth, camera, mask, _ = scene
    two = mask.copy()
    two[:60, :60] = True
    for arguments, options, name in [
        ((depth * 1000, camera, mask), {}, "depth"),
        ((np.zeros_like(depth), camera, mask), {}, "depth"),
        ((depth[:100], camera, mask[:100]), {}, "depth"),
        ((depth, camera, mask[:100]), {}, "mask"),
        ((depth, camera, np.zeros_like(mask)), {}, "mask"),
        ((np.where(mask, 0, depth), camera, mask), {}, "mask"),
        ((depth, camera, mask.astype(float)), {}, "mask"),
        ((depth, camera, mask), {"gripper": "hand"}, "gripper"),
        ((depth, camera, mask), {"gripper": 3}, "gripper"),
        ((depth, camera, mask), {"most": 0}, "most"),
    ]:
        with pytest.raises(ValueError, match=name):
            sixfold.propose_grasps(*arguments, **options)
    with pytest.raises(ValueError, match="rgb"):
        sixfold.draw_grasps(np.zeros((10, 10, 3), np.uint8), [], camera)
