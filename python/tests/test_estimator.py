"""The one interface of all methods: the same poses as the methods' own functions, runs over a dataset, wrong use."""

import json

import numpy as np
import pytest

import sixfold
from scenes import box_mesh, posed
from sixfold import bop, metrics


@pytest.fixture(scope="module")
def frame(demo):
    dataset = bop.Dataset(demo)
    truth = {g["obj_id"]: g["camera_from_object"] for g in dataset.ground_truth(2, 3)}
    return dataset.model(8), dataset.camera(2, 3), dataset.rgb(2, 3), dataset.depth(2, 3), truth[8]


@pytest.fixture(scope="module")
def box(frame):
    mesh, camera, _, _, truth = frame
    rows, columns = np.nonzero(sixfold.render_depth(mesh, truth, camera))
    return [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]


@pytest.fixture
def targets(tmp_path):
    """One object of one image."""
    file = tmp_path / "targets.json"
    file.write_text(json.dumps([{"scene_id": 2, "im_id": 3, "obj_id": 8, "inst_count": 1}]))
    return file


def test_what_the_methods_need(weights):
    ppf = sixfold.Estimator("ppf")
    assert ppf.name == "ppf" and repr(ppf) == "<Estimator: ppf>"
    assert ppf.needs == {"depth": "required", "rgb": "unused", "region": "optional", "object": "required"}
    assert sixfold.Estimator("mttm", matcher="points").needs == ppf.needs
    pix2pose = sixfold.Estimator("pix2pose", weights=weights)
    assert pix2pose.needs == {"depth": "unused", "rgb": "required", "region": "required", "object": "optional"}
    aligned = sixfold.Estimator("pix2pose", weights=weights, icp=True, passes=2, starts=2, refine=False)
    assert aligned.needs["depth"] == aligned.needs["object"] == "required"


def test_ppf_is_estimate_ppf(frame, box):
    mesh, camera, rgb, depth, truth = frame
    [expected] = sixfold.estimate_ppf(depth, mesh, camera)
    estimator = sixfold.Estimator("ppf")
    # The second search takes the object that the first one described; colour is not looked at.
    for _ in range(2):
        [found] = estimator.find(mesh, camera, depth, rgb=rgb, min_confidence=0.05)
        assert found.camera_from_object.tobytes() == expected.camera_from_object.tobytes()
        assert found.confidence == expected.confidence
        assert found.details["verification"] == expected.verification
        assert found.mask is None and found.notes == []
    mask = np.zeros(depth.shape, bool)
    x, y, width, height = box
    mask[y : y + height, x : x + width] = True
    for where in ({"box": box}, {"mask": mask}, {"box": box, "mask": mask}):
        [found] = estimator.find(mesh, camera, depth, **where)
        assert metrics.add(mesh, found.camera_from_object, truth) < 0.2 * mesh.diameter
    assert estimator.find(mesh, camera, depth, min_confidence=1.0) == []


def test_mttm_is_estimate_mttm(frame):
    mesh, camera, _, depth, _ = frame
    expected = sixfold.estimate_mttm(depth, sixfold.Mttm(mesh, matcher="points"), camera, min_score=0)
    found = sixfold.Estimator("mttm", matcher="points").find(mesh, camera, depth, min_confidence=0)
    assert len(found) == len(expected) == 1
    assert found[0].camera_from_object.tobytes() == expected[0].camera_from_object.tobytes()
    assert found[0].confidence == expected[0].confidence and (found[0].mask == expected[0].mask).all()
    assert found[0].details["template"] == expected[0].template and found[0].details["verified_by"] == "mesh"


def test_auto_says_how_probable_a_pose_is(frame):
    mesh, camera, _, depth, truth = frame
    auto = sixfold.Estimator("auto")
    assert auto.needs == {"depth": "optional", "rgb": "optional", "region": "optional", "object": "required"}
    [found] = auto.find(mesh, camera, depth)
    assert np.linalg.norm(found.camera_from_object[:3, 3] - truth[:3, 3]) < 0.01
    assert 0.5 <= found.probability <= 1 and found.confidence == found.probability
    assert found.details["found_by"] and found.details["evidence"]["visible"] > 0.3
    assert found.mask.shape == depth.shape and found.mask.any()
    # Nothing is there that looks like it.
    assert auto.find(mesh, camera, np.full_like(depth, 0.9)) == []
    assert sixfold.Estimator("ppf").find(mesh, camera, depth)[0].probability is None
    with pytest.raises(ValueError, match="auto"):
        auto.find(mesh, camera)


def test_pix2pose_is_pix2pose(frame, box, weights):
    mesh, camera, rgb, depth, _ = frame
    network = sixfold.Pix2Pose.load(weights, camera=camera)
    estimator = sixfold.Estimator("pix2pose", weights=weights)
    for object, meshes in ((mesh, {8: mesh}), (None, None)):
        [expected] = network(rgb, [box], [8], meshes=meshes)
        [found] = estimator.find(object, camera, rgb=rgb, box=box, id=8)
        assert found.camera_from_object.tobytes() == expected.camera_from_object.tobytes()
        assert found.confidence == expected.score and found.details["object_id"] == 8
    aligned = sixfold.Estimator("pix2pose", weights=weights, icp=True)
    [expected] = network(rgb, [box], [8], meshes={8: mesh}, depth=depth)
    [found] = aligned.find(mesh, camera, depth, rgb, box, id=8)
    assert found.camera_from_object.tobytes() == expected.camera_from_object.tobytes()


def test_a_run_over_a_dataset(demo, frame, targets, tmp_path):
    mesh, _, _, _, truth = frame
    estimator, out = sixfold.Estimator("ppf"), tmp_path / "results.csv"

    def refuse(event):
        assert event == {"stage": "estimating", "done": 1, "total": 1, "image": "2/3"}
        raise RuntimeError("enough")

    # What the callback raises comes out, and what was done until then is there.
    with pytest.raises(RuntimeError, match="enough"):
        estimator.run_dataset(demo, out, boxes="gt", targets=targets, progress=refuse)
    written, events = out.read_bytes(), []
    summary = estimator.run_dataset(demo, out, boxes="gt", targets=targets, progress=events.append)
    assert summary == {
        "images": 1,
        "targets": 1,
        "poses": 1,
        "skipped": [],
        "seconds_per_image": None,
        "results": str(out),
    }
    assert out.read_bytes() == written and [e["image"] for e in events] == ["2/3"]
    [row] = bop.read_results(out)
    assert (row.scene_id, row.im_id, row.obj_id) == (2, 3, 8) and row.time > 0
    assert metrics.add(mesh, row.camera_from_object, truth) < 0.2 * mesh.diameter
    assert metrics.bop19(demo, out, targets=targets, vsd=False)["ar_mssd"] > 0
    # With other options the file is another's.
    for options, name in [
        ({"min_confidence": 0.5}, "min_confidence"),
        ({"boxes": None}, "boxes"),
    ]:
        with pytest.raises(ValueError, match=f"^out: .*{name}"):
            estimator.run_dataset(demo, out, **{"boxes": "gt", "targets": targets, **options})
    with pytest.raises(ValueError, match="^out: .*seed"):
        sixfold.Estimator("ppf", seed=1).run_dataset(demo, out, boxes="gt", targets=targets)
    assert out.read_bytes() == written


def test_options_of_other_methods_are_refused(tmp_path):
    for method, options, name in [
        ("icp", {}, "method"),
        ("ppf", {"weights": "w.safetensors"}, "weights"),
        ("ppf", {"matcher": "points"}, "matcher"),
        ("ppf", {"templates_only": True}, "templates_only"),
        ("ppf", {"templates": "around"}, "templates"),
        ("mttm", {"templates": "below"}, "templates"),
        ("ppf", {"icp": True}, "icp"),
        ("mttm", {"refine": False}, "refine"),
        ("mttm", {"passes": 2}, "passes"),
        ("mttm", {"matcher": "forest"}, "matcher"),
        ("mttm", {"matcher": "points", "weights": "w.safetensors"}, "weights"),
        ("pix2pose", {}, "weights"),
        ("pix2pose", {"weights": "w.safetensors", "keep_plane": True}, "keep_plane"),
        ("pix2pose", {"weights": "w.safetensors", "passes": 0}, "passes"),
        ("pix2pose", {"weights": "w.safetensors", "starts": 6}, "starts"),
        ("views", {"starts": 2}, "starts"),
        ("auto", {"icp": True}, "icp"),
        ("ppf", {"budget": 1.0}, "budget"),
        ("auto", {"budget": 0.0}, "budget"),
        ("auto", {"budget": float("nan")}, "budget"),
        ("ppf", {"seed": -1}, "seed"),
    ]:
        with pytest.raises(ValueError, match=f"^{name}: expected .*, found "):
            sixfold.Estimator(method, **options)
    with pytest.raises(ValueError, match='"mttm" and "pix2pose"'):
        sixfold.Estimator("ppf", weights="w.safetensors")
    for method in ("mttm", "pix2pose"):
        with pytest.raises(FileNotFoundError, match="none.safetensors"):
            sixfold.Estimator(method, weights=tmp_path / "none.safetensors")
    with pytest.raises(TypeError):
        sixfold.Estimator("ppf", looks=2)


def test_wrong_searches(camera, weights):
    mesh, estimator = box_mesh(), sixfold.Estimator("ppf")
    depth = sixfold.render_depth(mesh, posed((0, 0, 0.6), (0.1, 0.2, 0.3)), camera)
    lens = sixfold.Camera(500, 500, 320, 240, 640, 480, distortion=(0.1, 0, 0, 0))
    for arguments, options, name in [
        ((None, camera, depth), {}, "object"),
        (("box", camera, depth), {}, "object"),
        ((sixfold.Mesh(np.eye(3)), camera, depth), {}, "object"),
        ((mesh, lens, depth), {}, "camera"),
        ((mesh, camera), {}, "depth"),
        ((mesh, camera, depth[:, :100]), {}, "depth"),
        ((mesh, camera, 1000 * depth), {}, "depth"),
        ((mesh, camera, np.zeros_like(depth)), {}, "depth"),
        ((mesh, camera, depth), {"box": [0, 0, 0, 0]}, "box"),
        ((mesh, camera, depth), {"box": [9000, 0, 50, 50]}, "box"),
        ((mesh, camera, depth), {"box": [[0, 0, 9, 9], [0, 0, 9, 9]]}, "box"),
        ((mesh, camera, depth), {"mask": depth}, "mask"),
        ((mesh, camera, depth), {"mask": np.ones((4, 4), bool)}, "mask"),
        ((mesh, camera, depth), {"mask": np.zeros(depth.shape, bool)}, "mask"),
        ((mesh, camera, depth), {"box": [0, 0, 9, 9], "mask": depth > 0}, "mask"),
        ((mesh, camera, depth), {"instances": 0}, "instances"),
        ((mesh, camera, depth), {"min_confidence": np.nan}, "min_confidence"),
        ((mesh, camera, depth), {"id": -1}, "id"),
    ]:
        with pytest.raises(ValueError, match=f"^{name}: "):
            estimator.find(*arguments, **options)
    rgb = np.zeros((480, 640, 3), np.uint8)
    estimator = sixfold.Estimator("pix2pose", weights=weights)
    for options, name in [
        ({"box": [9, 9, 50, 50], "id": 8}, "rgb"),
        ({"rgb": rgb, "id": 8}, "box"),
        ({"rgb": rgb, "box": [9, 9, 50, 50]}, "id"),
        ({"rgb": rgb, "box": [9, 9, 50, 50], "id": 999}, "id"),
        ({"rgb": rgb[:9], "box": [9, 9, 50, 50], "id": 8}, "rgb"),
    ]:
        with pytest.raises(ValueError, match=f"^{name}: "):
            estimator.find(None, camera, **options)
    with pytest.raises(ValueError, match="^object: "):
        estimator.find(mesh, camera, rgb=rgb, box=[9, 9, 50, 50], id=8)


def test_wrong_runs(demo, targets, weights, tmp_path):
    estimator, out = sixfold.Estimator("ppf"), tmp_path / "results.csv"
    foreign = tmp_path / "foreign.csv"
    foreign.write_text("scene_id,im_id,obj_id,score,R,t,time\n")
    for file, options, name in [
        (tmp_path / "results.txt", {}, "out"),
        (foreign, {}, "out"),
        (out, {"boxes": "gt", "detector": "d.safetensors"}, "boxes"),
        (out, {"min_confidence": 2}, "min_confidence"),
    ]:
        with pytest.raises(ValueError, match=f"^{name}: "):
            estimator.run_dataset(demo, file, targets=targets, **options)
    with pytest.raises(ValueError, match="^boxes: .*pix2pose needs them"):
        sixfold.Estimator("pix2pose", weights=weights).run_dataset(demo, out, targets=targets)
    for options in ({"boxes": "none.json"}, {"detector": "none.safetensors"}, {"targets": "none.json"}):
        with pytest.raises(FileNotFoundError, match="none"):
            estimator.run_dataset(demo, out, **{"targets": targets, **options})
    assert not out.exists()
