"""Pix2Pose with the repository's weights on the sample frame."""

import numpy as np
import pytest

import sixfold
from sixfold import bop, metrics


@pytest.fixture(scope="module")
def frame(demo):
    dataset = bop.Dataset(demo)
    camera = dataset.camera(2, 3)
    truth = {g["obj_id"]: g["camera_from_object"] for g in dataset.ground_truth(2, 3)}
    return dataset, camera, dataset.rgb(2, 3), dataset.depth(2, 3), truth


@pytest.fixture(scope="module")
def network(weights, frame):
    return sixfold.Pix2Pose.load(weights, camera=frame[1])


def box_of(mesh, pose, camera):
    rows, columns = np.nonzero(sixfold.render_depth(mesh, pose, camera))
    return [columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1]


def test_poses_in_boxes(network, frame):
    dataset, camera, rgb, depth, truth = frame
    mesh = dataset.model(8)
    box = box_of(mesh, truth[8], camera)
    [plain] = network(rgb, [box], [8])
    [refined] = network(rgb, box, [8], meshes={8: mesh})
    [aligned] = network(rgb, box, [8], meshes={8: mesh}, depth=depth)
    assert plain.object_id == 8 and 0 < plain.score <= 1 and not plain.refined and not plain.aligned_to_depth
    assert plain.coordinates.shape[2] == 3 and plain.error.shape == plain.visible.shape == plain.coordinates.shape[:2]
    assert plain.input.dtype == np.uint8 and plain.window.shape == (4,) and len(plain.hypotheses) >= 1
    assert len(plain.object_points) == len(plain.image_points) > 10
    for pose in (refined, aligned):
        assert metrics.add(mesh, pose.camera_from_object, truth[8]) < 0.2 * mesh.diameter
    assert aligned.aligned_to_depth


def test_same_seed_same_result_and_views_of_arrays(network, frame):
    dataset, camera, rgb, _, truth = frame
    box = box_of(dataset.model(8), truth[8], camera)
    first, second = network(np.asfortranarray(rgb), [box, box], [8, 8])
    [third] = network(rgb, np.array([box], np.float32), np.array([8]))
    assert first.camera_from_object.tobytes() == second.camera_from_object.tobytes()
    assert np.allclose(first.camera_from_object, third.camera_from_object, atol=1e-12)


def test_no_box_no_pose(network, frame):
    assert network(frame[2], np.zeros((0, 4)), []) == []


def test_what_the_model_knows(network):
    known = {o["id"] for o in network.objects}
    assert 8 in known and all(o["diameter"] > 0.01 for o in network.objects)
    assert network.card["architecture"].startswith("pix2pose")


def test_wrong_use(network, frame, weights, tmp_path):
    dataset, camera, rgb, depth, _ = frame
    box = [[10, 10, 40, 40]]
    for arguments, options, name in [
        ((rgb, box), {}, "object_ids"),
        ((rgb, box, [999]), {}, "object_ids"),
        ((rgb, box, [8, 8]), {}, "object_ids"),
        ((rgb, [[0, 0, 0, 0]], [8]), {}, "boxes"),
        ((rgb, [[np.nan, 0, 5, 5]], [8]), {}, "boxes"),
        ((rgb, [[9000, 0, 50, 50]], [8]), {}, "boxes"),
        ((rgb[:, :100], box, [8]), {}, "rgb"),
        ((rgb.astype(float), box, [8]), {}, "rgb"),
        ((rgb, box, [8]), {"depth": depth}, "meshes"),
        ((rgb, box, [8]), {"meshes": {8: dataset.model(8).scaled(2)}}, "meshes"),
        ((rgb, box, [8]), {"crop_factor": -1}, "crop_factor"),
    ]:
        with pytest.raises(ValueError, match=name):
            network(*arguments, **options)
    with pytest.raises(ValueError, match="camera"):
        sixfold.Pix2Pose.load(weights)(rgb, box, [8])
    with pytest.raises(FileNotFoundError):
        sixfold.Pix2Pose.load(tmp_path / "none.safetensors")
    (tmp_path / "broken.safetensors").write_bytes(b"\x08\0\0\0\0\0\0\0{broken}")
    with pytest.raises(ValueError, match="broken.safetensors"):
        sixfold.Pix2Pose.load(tmp_path / "broken.safetensors")
