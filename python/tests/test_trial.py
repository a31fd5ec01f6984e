"""Grasps tried in the physics engine."""

import numpy as np
import pytest

import sixfold
from scenes import box_mesh, posed


@pytest.fixture(scope="module")
def solid():
    return sixfold.Solid(box_mesh((0.05, 0.05, 0.05)), convex=True)


def test_an_object_comes_to_rest(solid):
    rest = solid.rest()
    assert np.allclose(rest[:3, 3], [0, 0, 0.025], atol=1e-3) and solid.part_count == 1
    tilted = solid.rest(posed((0, 0, 0), (0.4, 0.2, 0.0)))
    assert abs(tilted[2, 3] - 0.025) < 1e-3 and (solid.rest(posed((0, 0, 0), (0.4, 0.2, 0.0))) == tilted).all()


def test_a_cube_is_held_and_missed(solid):
    held = sixfold.try_grasp(solid, sixfold.gripper_pose([0, 0, 0.01]), gripper="jaws-85", opening=0.07)
    assert held and held.held and held.outcome == "held"
    assert abs(held.gap - 0.05) < 2e-3 and held.raised > 0.08 and held.slip < 0.01 and held.turn < 0.2
    assert held.time > 1 and held.pushed < 0.01 and held.world_from_object.shape == (4, 4)
    missed = sixfold.try_grasp(solid, sixfold.gripper_pose([0.2, 0, 0.01]), gripper="jaws-85")
    assert not missed and missed.outcome == "missed"
    under = sixfold.try_grasp(solid, sixfold.gripper_pose([0, 0, -0.03]), gripper="jaws-85")
    assert under.outcome == "blocked"
    heavy = sixfold.try_grasp(
        solid, sixfold.gripper_pose([0, 0, 0.01]), gripper="jaws-85", mass=10, friction=0.05, force=2
    )
    assert not heavy.held
    # Where the object stands is an argument too, and a mesh is cut into parts by itself.
    moved = posed((0.1, 0.02, 0.025), (0, 0, 0))
    again = sixfold.try_grasp(
        box_mesh((0.05, 0.05, 0.05)),
        sixfold.gripper_pose([0.1, 0.02, 0.01]),
        world_from_object=moved,
        gripper=sixfold.Gripper.built_in("jaws-85"),
    )
    assert again.held and (again.world_from_object == moved).all()


def test_gripper_pose():
    pose = sixfold.gripper_pose([0.1, 0.2, 0.3], approach=[0, 0, -2], closing=[1, 0, 5])
    assert np.allclose(pose[:3, :3], [[1, 0, 0], [0, -1, 0], [0, 0, -1]])
    assert np.allclose(pose[:3, 3], [0.1, 0.2, 0.3])


def test_wrong_use(solid):
    pose = sixfold.gripper_pose([0, 0, 0.01])
    flat = sixfold.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    for call, name in [
        (lambda: sixfold.Solid(flat), "mesh"),
        (lambda: sixfold.try_grasp(flat, pose), "mesh"),
        (lambda: sixfold.try_grasp("cube", pose), "object"),
        (lambda: sixfold.try_grasp(solid, pose[:3]), "world_from_gripper"),
        (lambda: sixfold.try_grasp(solid, np.full((4, 4), np.nan)), "world_from_gripper"),
        (lambda: sixfold.try_grasp(solid, pose, world_from_object=np.zeros((4, 4))), "world_from_object"),
        (lambda: sixfold.try_grasp(solid, pose, gripper="hand"), "gripper"),
        (lambda: sixfold.try_grasp(solid, pose, gripper="jaws-85", opening=0.2), "opening"),
        (lambda: sixfold.try_grasp(solid, pose, opening=-1), "opening"),
        (lambda: sixfold.try_grasp(solid, pose, mass=0), "mass"),
        (lambda: sixfold.try_grasp(solid, pose, friction=-1), "friction"),
        (lambda: sixfold.try_grasp(solid, pose, force=np.nan), "force"),
        (lambda: sixfold.try_grasp(solid, pose, lift=np.inf), "lift"),
        (lambda: sixfold.gripper_pose([0, 0]), "tip"),
        (lambda: sixfold.gripper_pose([0, 0, 0], [1, 0, 0], [2, 0, 0]), "approach, closing"),
        (lambda: solid.rest(np.eye(3)), "start"),
    ]:
        with pytest.raises(ValueError, match=name):
            call()
