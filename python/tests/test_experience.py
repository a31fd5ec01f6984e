"""Grasps from experience: a store in a file, the nearest of it, and grasps transferred with the repository's weights."""

import json

import numpy as np
import pytest

import sixfold
from scenes import box_mesh, posed


def table_scene(size, turn, place=(0.02, -0.01)):
    """A box on a table seen from above at a slant: depth, camera, the box's mask."""
    camera = sixfold.Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
    box, table = box_mesh(size), box_mesh((1.2, 1.2, 0.02))
    view = posed((0.0, 0.05, 0.75), (2.5, 0.0, 0.0))
    on_table = view @ posed((*place, 0.5 * size[2]), (0.0, 0.0, turn))
    drawn = sixfold.render_scene([(table, view @ posed((0, 0, -0.01), (0, 0, 0))), (box, on_table)], camera)
    return drawn.depth, camera, drawn.masks[1]


@pytest.fixture(scope="module")
def first():
    return table_scene((0.05, 0.16, 0.06), 0.4)


@pytest.fixture(scope="module")
def second():
    return table_scene((0.055, 0.14, 0.065), 0.9, (-0.03, 0.02))


@pytest.fixture(scope="module")
def grasp(first):
    return sixfold.propose_grasps(*first, gripper="jaws-85")[0]


@pytest.fixture(scope="module")
def network(dgcm_weights):
    return sixfold.DgcmNet.load(dgcm_weights)


@pytest.fixture
def store(network, first, grasp, tmp_path):
    """A store of one experience."""
    store = sixfold.ExperienceStore(tmp_path / "new/experience.db", network)
    assert store.add(*first, grasp, object="bar", part="middle", gripper="jaws-85") == (1, True)
    return store


def test_what_is_stored_is_there(store, first, grasp, network, tmp_path):
    assert len(store) == 1 and store.path == tmp_path / "new/experience.db"
    [line] = store.list()
    assert (line["id"], line["object"], line["part"], line["gripper"]) == (1, "bar", "middle", "jaws-85")
    assert line["network"] == network.fingerprint and line["provenance"] == "added by hand"
    kept = store.get(1)
    assert (kept.id, kept.object, kept.part, kept.width) == (1, "bar", "middle", grasp.width)
    assert np.allclose(kept.camera_from_gripper, grasp.camera_from_gripper, atol=1e-12)
    assert kept.opening == grasp.opening and kept.time > 1.7e9 and kept.network == network.fingerprint
    side = kept.mask.shape[0]
    assert kept.camera.width == side and kept.points.shape == kept.normals.shape == (side, side, 3)
    assert kept.region.any() and not (kept.region & ~kept.mask).any()
    assert np.abs(kept.coordinates).max() <= 1.0001
    assert np.allclose(np.linalg.norm(kept.normals[kept.mask], axis=-1), 1, atol=1e-2)
    assert np.allclose(kept.feature, network.feature(*first), atol=1e-5)
    assert kept.picture().shape == (4 * side, 12 * side, 3)
    view = posed((0.0, 0.05, 0.75), (2.5, 0.0, 0.0))
    assert np.allclose(kept.table, [*view[:3, 2], view[:3, 2] @ view[:3, 3]], atol=0.005)
    assert store.get(2) is None
    # The same again is not stored twice; another process sees the same file.
    assert store.add(*first, grasp, object="bar", part="middle", gripper="jaws-85") == (1, False)
    assert len(sixfold.ExperienceStore(store.path, create=False)) == 1


def test_forgetting_merging_exporting_and_encoding_anew(store, first, grasp, network, tmp_path):
    other = sixfold.ExperienceStore(tmp_path / "other.db", network)
    pose = grasp.camera_from_gripper
    assert other.add(*first, pose, object="other", gripper="jaws-85", opening=0.08, width=0.05)[1]
    assert other.merge(store.path) == 1 and other.merge(store.path) == 0
    assert [line["object"] for line in other.list()] == ["other", "bar"]
    assert other.export(tmp_path / "out") == (2, [])
    exported = json.loads((tmp_path / "out/000002.json").read_text())
    assert exported["object"] == "bar" and len(exported["feature"]) == 256
    assert (tmp_path / "out/000001.png").stat().st_size > 1000
    assert other.forget(1) and not other.forget(1)
    assert [line["id"] for line in other.list()] == [2]
    assert other.refresh(tmp_path / "new.db", network) == 1
    assert sixfold.ExperienceStore(tmp_path / "new.db").list()[0]["object"] == "bar"
    with pytest.raises(ValueError, match="out: expected another file"):
        other.refresh(tmp_path / "other.db", network)


def test_the_nearest(store, first, second, grasp, network):
    feature = network.feature(*first)
    found = store.nearest(feature, 3)
    assert [f["id"] for f in found] == [1, 1, 1]
    assert found[0]["angle"] == 0 and found[0]["distance"] < 1e-4
    assert [f["distance"] for f in found] == sorted(f["distance"] for f in found)
    # The index follows the store.
    pose = sixfold.propose_grasps(*second, gripper="jaws-85")[0]
    number, _ = store.add(*second, pose, object="block", gripper="jaws-85")
    assert store.nearest(network.feature(*second), 1)[0]["id"] == number
    assert {f["id"] for f in store.nearest(feature, 50, without_object="bar")} == {number}
    assert {f["id"] for f in store.nearest(feature, 50, part="middle")} == {1}
    assert store.forget(number) and {f["id"] for f in store.nearest(feature, 50)} == {1}
    assert store.nearest(feature, part="handle") == []


def test_grasps_are_transferred_and_ranked_with_the_planners(store, second, network):
    plain = sixfold.propose_grasps(*second, gripper="jaws-85", most=20)
    assert all(g.experience is None for g in plain)
    both = sixfold.propose_grasps(*second, gripper="jaws-85", most=20, experiences=store)
    assert {g.experience["kind"] for g in both} <= {"geometry", "experience"}
    assert [g.score for g in both] == sorted((g.score for g in both), reverse=True)
    assert all(0 <= g.experience["agreement"] <= 1 for g in both)
    # With a part's name what was transferred, here from the one that was stored, and the planner's that hold the same.
    learnt = sixfold.propose_grasps(
        *second, gripper="jaws-85", most=50, experiences=store, weights=network, part="middle"
    )
    transferred = [g for g in learnt if g.experience["kind"] == "experience"]
    assert transferred and all(g.experience["id"] == 1 for g in transferred)
    assert transferred[0].experience["distance"] > 0 and transferred[0].experience["hypothesis"] in {
        "scaled",
        "turned",
        "same_side",
    }
    assert sixfold.propose_grasps(*second, gripper="jaws-85", experiences=store, part="handle") == []
    again = sixfold.propose_grasps(*second, gripper="jaws-85", most=20, experiences=store)
    assert [g.camera_from_gripper.tobytes() for g in again] == [g.camera_from_gripper.tobytes() for g in both]


def test_wrong_use(store, first, grasp, network, dgcm_weights, weights, tmp_path):
    depth, camera, mask = first
    pose = grasp.camera_from_gripper
    far = pose.copy()
    far[2, 3] += 0.5
    known = {"object": "x", "gripper": "jaws-85"}
    for arguments, options, name in [
        ((depth, camera, mask, far), {"opening": 0.08, "width": 0.05}, "grasp: expected a gripper at the object"),
        ((depth, camera, mask, pose), {}, "opening"),
        ((depth, camera, mask, pose), {"opening": 0.08}, "width"),
        ((depth, camera, mask, pose), {"opening": 80, "width": 50}, "opening: expected above 0 and below 1 m"),
        ((depth, camera, mask, pose[:3]), {"opening": 0.08, "width": 0.05}, "grasp"),
        ((depth, camera, np.zeros_like(mask), grasp), {}, "mask"),
        ((depth, camera, mask[:100], grasp), {}, "mask"),
        ((depth, camera, mask.astype(int), grasp), {}, "mask"),
        ((depth[:100], camera, mask[:100], grasp), {}, "depth"),
        ((np.full_like(depth, np.nan), camera, mask, grasp), {}, "depth|mask"),
        ((depth.astype(np.uint16), camera, mask, grasp), {}, "depth"),
        ((depth, camera, mask, grasp), {"gripper": "hand"}, "gripper"),
        ((depth, camera, mask, grasp), {"weights": 3}, "weights"),
        ((depth, camera, mask, grasp), {"seed": -1}, "seed"),
    ]:
        with pytest.raises(ValueError, match=name):
            store.add(*arguments, **{**known, **options})
    assert len(store) == 1
    for feature in (np.zeros(5), np.full(256, np.nan), "feature", np.zeros((256, 1))):
        with pytest.raises(ValueError, match="^feature"):
            store.nearest(feature)
    with pytest.raises(ValueError, match="count"):
        store.nearest(np.zeros(256), 0)
    without = sixfold.ExperienceStore(tmp_path / "without.db")
    with pytest.raises(ValueError, match="^weights: .*None"):
        without.nearest(np.zeros(256))
    with pytest.raises(ValueError, match="^weights: .*None"):
        sixfold.propose_grasps(*first, experiences=without)
    assert sixfold.propose_grasps(*first, experiences=without, weights=dgcm_weights, part="x") == []
    with pytest.raises(ValueError, match="^part: expected experiences"):
        sixfold.propose_grasps(*first, part="handle")
    with pytest.raises(ValueError, match="^weights: expected experiences"):
        sixfold.propose_grasps(*first, weights=network)
    with pytest.raises(ValueError, match="card's `architecture`"):
        sixfold.DgcmNet.load(weights)
    with pytest.raises(FileNotFoundError):
        sixfold.DgcmNet.load(tmp_path / "none.safetensors")


def test_files_that_are_no_stores(store, tmp_path):
    with pytest.raises(FileNotFoundError, match="none.db"):
        sixfold.ExperienceStore(tmp_path / "none.db", create=False)
    with pytest.raises(FileNotFoundError, match="none.db"):
        store.merge(tmp_path / "none.db")
    (tmp_path / "text.db").write_bytes(b"no database, but long enough to look like one" * 100)
    with pytest.raises(ValueError, match="text.db: found no SQLite file"):
        sixfold.ExperienceStore(tmp_path / "text.db")
    with pytest.raises(OSError):
        sixfold.ExperienceStore(tmp_path / "text.db/below.db")
    (tmp_path / "cut.db").write_bytes(store.path.read_bytes()[:5000])
    with pytest.raises((ValueError, OSError), match="cut.db"):
        sixfold.ExperienceStore(tmp_path / "cut.db").list()
    with pytest.raises(OSError):
        store.export(tmp_path / "text.db")
