"""Datasets, result files, images, detections."""

import json

import numpy as np
import pytest

import sixfold
from scenes import scenario
from sixfold import bop, coco


def test_the_sample_dataset(demo):
    dataset = bop.Dataset(demo)
    assert 2 in dataset.scene_ids and 3 in dataset.image_ids(2) and 8 in dataset.object_ids
    camera = dataset.camera(2, 3)
    assert (camera.width, camera.height) == (640, 480)
    assert dataset.rgb(2, 3).shape == (480, 640, 3)
    depth = dataset.depth(2, 3)
    assert depth.dtype == np.float32 and 0.2 < np.median(depth[depth > 0]) < 3
    truth = dataset.ground_truth(2, 3)
    assert truth[0]["camera_from_object"].shape == (4, 4) and 0.2 < truth[0]["camera_from_object"][2, 3] < 3
    assert dataset.mask(2, 3, 0) is None or dataset.mask(2, 3, 0).shape == (480, 640)
    assert len(dataset.model(10).symmetries) == 2 and len(dataset.model(1).symmetries) == 1
    assert {t[2] for t in dataset.targets()} <= set(dataset.object_ids)


def test_result_files(tmp_path, pose):
    file = tmp_path / "results.csv"
    estimates = [bop.Estimate(1, 2, 3, 0.5, pose), bop.Estimate(1, 2, 4, 0.25, np.eye(4), time=1.5)]
    bop.write_results(file, estimates)
    again = bop.read_results(file)
    assert [e.obj_id for e in again] == [3, 4] and again[0].time is None and again[1].time == 1.5
    assert np.allclose(again[0].camera_from_object, pose, atol=1e-9)
    file.write_text(file.read_text() + "1,2,x,0,1 0 0 0 1 0 0 0 1,0 0 0,-1\n")
    with pytest.raises(ValueError, match="line 4, column obj_id"):
        bop.read_results(file)
    with pytest.warns(UserWarning, match="1 rows left out"):
        assert len(bop.read_results(file, lenient=True)) == 2
    with pytest.raises(FileNotFoundError, match="missing.csv"):
        bop.read_results(tmp_path / "missing.csv")


def test_a_rotation_that_is_slightly_off_is_kept_as_written():
    written = np.eye(4)
    written[:3, :3] *= 1.005
    estimate = bop.Estimate(1, 1, 1, 1.0, written)
    assert (estimate.camera_from_object_as_written == written).all()
    assert np.allclose(estimate.camera_from_object, np.eye(4))
    assert sixfold.metrics.add([[0.1, 0, 0]], written, np.eye(4)) == pytest.approx(0.0005)


def test_millimetres_say_so(pose):
    rotation, translation_mm = bop.pose_to_mm(pose)
    assert np.allclose(translation_mm, 1000 * pose[:3, 3])
    assert np.allclose(bop.pose_from_mm(rotation, translation_mm), pose)


def test_images(tmp_path):
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 255, (20, 30, 3), np.uint8)
    bop.write_rgb(tmp_path / "rgb.png", rgb)
    assert (bop.read_rgb(tmp_path / "rgb.png") == rgb).all()
    depth = rng.uniform(0.3, 2, (20, 30)).astype(np.float32)
    bop.write_depth(tmp_path / "depth.png", depth, mm_per_unit=0.1)
    assert np.abs(bop.read_depth(tmp_path / "depth.png", mm_per_unit=0.1) - depth).max() < 6e-5
    mask = rng.random((20, 30)) < 0.5
    bop.write_mask(tmp_path / "mask.png", mask)
    assert (bop.read_mask(tmp_path / "mask.png") == mask).all()


def test_run_lengths():
    mask = np.random.default_rng(0).random((37, 53)) < 0.3
    rle = coco.encode_mask(mask)
    assert rle["size"] == [37, 53] and (coco.decode_mask(rle) == mask).all()
    assert (coco.decode_mask({"size": [37, 53], "counts": rle["counts"].encode()}) == mask).all()
    assert (coco.decode_mask(coco.encode_mask(mask[:, ::2])) == mask[:, ::2]).all()
    with pytest.raises(ValueError, match="rle"):
        coco.decode_mask({"size": [3, 3], "counts": [1, 1]})


def test_coco_scores_as_pycocotools():
    cocotools = pytest.importorskip("pycocotools.coco")
    cocoeval = pytest.importorskip("pycocotools.cocoeval")
    for seed in range(3):
        truth, found = scenario(np.random.default_rng(seed))
        reference = cocotools.COCO()
        reference.dataset = json.loads(json.dumps(truth))
        reference.createIndex()
        run = cocoeval.COCOeval(reference, reference.loadRes(json.loads(json.dumps(found))), "bbox")
        run.evaluate()
        run.accumulate()
        run.summarize()
        names = "ap ap50 ap75 ap_small ap_medium ap_large ar1 ar10 ar100 ar_small ar_medium ar_large".split()
        ours = coco.evaluate(truth, found)
        for name, theirs in zip(names, run.stats):
            assert (ours[name] if ours[name] is not None else -1) == pytest.approx(theirs, abs=1e-12), name


def test_detections_in_files_and_by_scene(tmp_path):
    truth, found = scenario(np.random.default_rng(1))
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    (tmp_path / "found.json").write_text(json.dumps(found))
    direct = coco.evaluate(truth, found)
    assert coco.evaluate(tmp_path / "truth.json", str(tmp_path / "found.json")) == direct
    assert coco.evaluate({0: truth}, found) == direct
    listed = coco.read_detections(tmp_path / "found.json")
    assert len(listed) == len(found) and listed[0]["score"] == found[0]["score"]
    coco.write_detections(tmp_path / "again.json", listed)
    assert coco.evaluate(truth, tmp_path / "again.json") == direct
    with pytest.warns(UserWarning, match="clipped"):
        coco.read_detections(tmp_path / "found.json", image_size=(200, 150))
    with pytest.raises(ValueError, match="score"):
        coco.evaluate(truth, [{"image_id": 1, "category_id": 1, "bbox": [0, 0, 5, 5]}])
    with pytest.raises(FileNotFoundError):
        coco.evaluate(tmp_path / "none.json", found)
    with pytest.raises(ValueError, match="iou_type"):
        coco.evaluate(truth, found, "keypoints")
