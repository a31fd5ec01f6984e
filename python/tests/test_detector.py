"""The detector with the repository's weights on the sample frame, and poses in its boxes."""

import numpy as np
import pytest

import sixfold
from sixfold import bop, coco, metrics


@pytest.fixture(scope="module")
def rgb(demo):
    return bop.Dataset(demo).rgb(2, 3)


@pytest.fixture(scope="module")
def detector(detector_weights):
    return sixfold.Detector.load(detector_weights)


@pytest.fixture(scope="module")
def boxes(demo):
    """Boxes of the objects' whole outlines."""
    dataset, out = bop.Dataset(demo), {}
    for g in dataset.ground_truth(2, 3):
        depth = sixfold.render_depth(dataset.model(g["obj_id"]), g["camera_from_object"], dataset.camera(2, 3))
        rows, columns = np.nonzero(depth)
        out[g["obj_id"]] = [columns.min(), rows.min(), np.ptp(columns), np.ptp(rows)]
    return out


def overlap(a, b):
    low = np.maximum(a[:2], b[:2])
    high = np.minimum(np.add(a[:2], a[2:]), np.add(b[:2], b[2:]))
    common = np.prod(np.maximum(high - low, 0))
    return common / (np.prod(a[2:]) + np.prod(b[2:]) - common)


def test_finds_what_is_there(detector, rgb, boxes):
    found = detector(rgb, threshold=0.3)
    assert [d.score for d in found] == sorted((d.score for d in found), reverse=True)
    best = {}
    for d in found:
        best.setdefault(d.object_id, d)
    right = sum(i in best and overlap(best[i].bbox, box) > 0.5 for i, box in boxes.items())
    assert right >= len(boxes) - 2
    for d in best.values():
        assert d.mask.shape == rgb.shape[:2] and d.mask.dtype == bool and d.mask.any()
        rows, columns = np.nonzero(d.mask)
        x, y, width, height = d.bbox
        assert columns.min() >= x - 1 and columns.max() <= x + width + 1
        assert rows.min() >= y - 1 and rows.max() <= y + height + 1


def test_boxes_are_those_of_the_network_not_means(detector, rgb):
    def boxes(overlap):
        found = detector(rgb, threshold=0.05, overlap=overlap, per_object=1000, max_detections=1000, masks=False)
        return {(d.object_id, *np.round(d.bbox, 3)) for d in found}

    kept, every = boxes(0.5), boxes(1.0)
    assert 0 < len(kept) < len(every)
    assert kept <= every


def test_poses_in_its_boxes(detector, rgb, demo, weights):
    dataset = bop.Dataset(demo)
    meshes = {i: dataset.model(i) for i in detector.object_ids}
    pix2pose = sixfold.Pix2Pose.load(weights, camera=dataset.camera(2, 3), meshes=meshes)
    found = detector(rgb, threshold=0.3, per_object=1)
    poses = pix2pose(rgb, [d.bbox for d in found], [d.object_id for d in found])
    truth = {g["obj_id"]: g["camera_from_object"] for g in dataset.ground_truth(2, 3)}
    near = [
        p.object_id
        for p in poses
        if p is not None
        and p.object_id in truth
        and metrics.adi(meshes[p.object_id], p.camera_from_object, truth[p.object_id])
        < 0.15 * meshes[p.object_id].diameter
    ]
    assert len(set(near)) >= 4


def test_options(detector, rgb):
    everything = detector(rgb, threshold=0.02, masks=False)
    assert all(d.mask is None for d in everything) and len(everything) > len(detector(rgb))
    assert all(d.score >= 0.7 for d in detector(rgb, threshold=0.7))
    assert len(detector(rgb, threshold=0, max_detections=3)) == 3
    only = detector(rgb, object_ids=[8], threshold=0.3, per_object=1)
    assert [d.object_id for d in only] == [8]
    again = detector(np.asfortranarray(rgb), threshold=0.02, masks=False)
    assert [tuple(d.bbox) for d in again] == [tuple(d.bbox) for d in everything]


def test_masks_as_run_lengths(detector, rgb):
    [best] = detector(rgb, max_detections=1)
    assert (coco.decode_mask(coco.encode_mask(best.mask)) == best.mask).all()


def test_nothing_in_an_empty_image_and_any_size(detector):
    assert detector(np.zeros((37, 411, 3), np.uint8)) == []
    assert detector(np.full((1, 1, 3), 255, np.uint8)) == []


def test_wrong_use(detector, rgb, weights, tmp_path):
    for arguments, options, name in [
        ((rgb[..., 0],), {}, "rgb"),
        ((rgb.astype(float),), {}, "rgb"),
        ((rgb[:0],), {}, "rgb"),
        ((rgb,), {"object_ids": [999]}, "object_ids"),
        ((rgb,), {"threshold": 2}, "threshold"),
        ((rgb,), {"threshold": float("nan")}, "threshold"),
        ((rgb,), {"overlap": -1}, "overlap"),
        ((rgb,), {"per_object": 0}, "per_object"),
        ((rgb,), {"max_detections": -3}, "max_detections"),
    ]:
        with pytest.raises(ValueError, match=name):
            detector(*arguments, **options)
    with pytest.raises(FileNotFoundError):
        sixfold.Detector.load(tmp_path / "none.safetensors")
    with pytest.raises(ValueError, match="detect"):
        sixfold.Detector.load(weights)
    assert 0 < detector.threshold < 1 and detector.card["architecture"].startswith("detect")


@pytest.fixture(scope="module")
def by_views(demo):
    dataset = bop.Dataset(demo)
    return sixfold.ViewsDetector({i: dataset.model(i) for i in (5, 9)}, threshold=0.2)


def test_views_find_objects_without_training(by_views, rgb, boxes):
    found = by_views(rgb)
    assert [d.score for d in found] == sorted((d.score for d in found), reverse=True)
    assert by_views.object_ids == [5, 9] and "5, 9" in repr(by_views)
    for i in (5, 9):
        first = next(d for d in found if d.object_id == i)
        assert overlap(first.bbox, boxes[i]) > 0.7 and 0.5 < first.score <= 1
        assert first.mask.shape == rgb.shape[:2]
        rows, columns = np.nonzero(first.mask)
        assert [columns.min(), rows.min(), np.ptp(columns), np.ptp(rows)] == first.bbox.tolist()


def test_views_name_boxes_quickly(demo, rgb, boxes):
    dataset = bop.Dataset(demo)
    detector = sixfold.ViewsDetector({9: dataset.model(9)}, poses=False, masks=False, threshold=0, max_detections=7)
    found = detector(rgb)
    assert len(found) == 7 and all(d.object_id == 9 and d.mask is None for d in found)
    assert overlap(found[0].bbox, boxes[9]) > 0.5


def test_views_need_objects_and_options_in_range(demo):
    mesh = bop.Dataset(demo).model(9)
    for objects, options, words in [
        ({}, {}, "at least one Mesh"),
        ({9: "mesh"}, {}, "a Mesh"),
        ({-1: mesh}, {}, "whole numbers"),
        ({9: mesh}, {"threshold": 1.5}, "threshold"),
        ({9: mesh}, {"overlap": float("nan")}, "overlap"),
        ({9: mesh}, {"per_object": 0}, "per_object"),
    ]:
        with pytest.raises(ValueError, match=words):
            sixfold.ViewsDetector(objects, **options)
