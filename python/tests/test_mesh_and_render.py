"""Meshes and images of them."""

import pickle

import numpy as np
import pytest

import sixfold
from scenes import box_mesh


def test_sizes(box):
    assert np.isclose(box.diameter, np.linalg.norm([0.1, 0.06, 0.04]))
    assert np.allclose(box.bounding_box, [[-0.05, -0.03, -0.02], [0.05, 0.03, 0.02]])
    assert np.isclose(box.surface_area, 2 * (0.1 * 0.06 + 0.06 * 0.04 + 0.1 * 0.04))
    assert box.vertices.shape == (8, 3) and box.faces.shape == (12, 3) and box.faces.dtype == np.uint32
    assert box.normals is None and np.allclose(np.linalg.norm(box.vertex_normals(), axis=1), 1)


def test_every_attribute_comes_back():
    rng = np.random.default_rng(0)
    colors = rng.integers(0, 255, (8, 3), np.uint8)
    texture = rng.integers(0, 255, (5, 7, 3), np.uint8)
    texcoords = rng.random((8, 2))
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    mesh = box_mesh(
        colors=colors, texture=texture, texcoords=texcoords, symmetries=[turn], symmetry_axes=[((0, 0, 2), (0, 0, 0))]
    )
    for each in (mesh, pickle.loads(pickle.dumps(mesh))):
        assert (each.colors == colors).all() and (each.texture == texture).all()
        assert np.allclose(each.texcoords, texcoords)
        assert each.symmetries.shape == (2 * 315, 4, 4) and np.allclose(each.symmetries[0], np.eye(4))
        direction, point = each.symmetry_axes[0]
        assert direction.tolist() == [0, 0, 1] and point.tolist() == [0, 0, 0]


def test_files(tmp_path, box):
    for unit, binary in [("mm", True), ("m", False)]:
        file = tmp_path / f"box_{unit}.ply"
        box.save(file, unit, binary=binary)
        again = sixfold.Mesh.load(file, unit=unit)
        assert np.allclose(again.vertices, box.vertices, atol=1e-7) and (again.faces == box.faces).all()
    with pytest.raises(ValueError, match="mm"):
        sixfold.Mesh.load(tmp_path / "box_mm.ply", unit="m")
    assert sixfold.Mesh.load(tmp_path / "box_mm.ply", unit="m", check_size=False).diameter > 100


def test_symmetries_are_found(bumpy, box):
    found = sixfold.find_symmetries(box)
    assert [s["order"] for s in found] == [2, 2, 2] and {s["by_shape"] for s in found} == {"sure"}
    axes = np.abs([s["axis"] for s in found])
    assert np.allclose(np.sort(axes, axis=1), [[0, 0, 1]] * 3, atol=1e-3)
    assert np.allclose(axes.sum(axis=0), 1, atol=1e-3) and found[0]["color_difference_p95"] is None
    poses = np.concatenate([s["poses"] for s in found])
    assert poses.shape == (3, 4, 4) and box.with_symmetries(poses).symmetries.shape == (4, 4, 4)
    for pose in poses:
        moved = box.transformed(pose).vertices
        # Every corner comes to lie on a corner.
        assert np.abs(moved[:, None] - box.vertices[None]).max(axis=2).min(axis=1).max() < 1e-4
    assert not [s for s in sixfold.find_symmetries(bumpy, noise=0.0005) if s["by_shape"] == "sure"]
    with pytest.raises(ValueError, match="noise"):
        sixfold.find_symmetries(box, noise=1.0)


def test_shapes(bumpy, box):
    coarse = bumpy.simplify(500)
    assert len(coarse.faces) <= 500 and abs(coarse.diameter - bumpy.diameter) < 0.002
    hull = sixfold.Mesh(box.sample_surface(300)[0] * 0.9).convex_hull()
    assert 0.5 * box.surface_area < hull.surface_area < box.surface_area
    assert len(sixfold.Mesh(bumpy.vertices).surfels().faces) > 1000
    assert np.isclose(box.scaled(2).diameter, 2 * box.diameter)
    moved = box.transformed(sixfold.pose_exp([0.1, 0, 0, 0, 0, 0]))
    assert np.allclose(moved.vertices, box.vertices + [0.1, 0, 0])
    assert len(sixfold.Mesh.merged([box, moved]).faces) == 24
    points, normals, faces = box.sample_surface(1000, seed=2)
    assert points.shape == normals.shape == (1000, 3) and faces.max() < 12
    on_a_side = np.isclose(np.abs(points), [0.05, 0.03, 0.02]).any(axis=1)
    assert on_a_side.all()


def test_rendering_agrees_with_itself(camera, bumpy, pose):
    drawn = sixfold.render(bumpy, pose, camera)
    depth, mask, normals, coordinates, rgb = drawn
    assert depth.shape == mask.shape == (480, 640) and depth.dtype == np.float32 and mask.dtype == bool
    assert normals.shape == coordinates.shape == rgb.shape == (480, 640, 3) and rgb.dtype == np.uint8
    assert len(drawn) == 5 and depth.flags["C_CONTIGUOUS"] and coordinates.flags["C_CONTIGUOUS"]
    assert (mask == (depth > 0)).all() and np.isnan(coordinates[~mask]).all() and not rgb[~mask].any()
    rows, columns = np.nonzero(mask)
    seen = camera.unproject(np.stack([columns, rows], 1), depth[mask].astype(float))
    assert np.abs(coordinates[mask] @ pose[:3, :3].T + pose[:3, 3] - seen).max() < 1e-5
    assert np.allclose(np.linalg.norm(normals[mask], axis=1), 1, atol=1e-5)
    assert ((normals[mask] * seen).sum(1) <= 1e-6).all()
    assert (sixfold.render_depth(bumpy, pose, camera) == depth).all()


def test_depth_of_a_plane_is_exact(camera):
    square = sixfold.Mesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    pose = sixfold.pose_exp([0, 0, 1.0, 0.4, 0.2, 0])
    depth = sixfold.render_depth(square, pose, camera)
    y, x = np.mgrid[:480, :640]
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
    expected = (pose[:3, 2] @ pose[:3, 3]) / (rays @ pose[:3, 2])
    assert np.abs(depth - expected)[depth > 0].max() < 1e-6


def test_a_scene_hides_what_is_behind(camera, box):
    near, far = np.eye(4), np.eye(4)
    near[:3, 3], far[:3, 3] = (0, 0, 0.5), (0.1, 0, 0.8)
    scene = sixfold.render_scene([(box, far), (box, near)], camera)
    assert scene.masks.shape == (2, 480, 640) and scene.instances.dtype == np.int32
    assert (scene.masks[0] == (scene.instances == 0)).all() and (scene.masks[1] == (scene.instances == 1)).all()
    assert scene.masks[1].sum() == sixfold.render(box, near, camera).mask.sum()
    assert scene.masks[0].sum() < sixfold.render(box, far, camera).mask.sum()
    seen = sixfold.bop.ground_truth_visibility([(box, far), (box, near)], camera)
    assert seen[1]["visible"] == 1.0 and 0 < seen[0]["visible"] < 1


def test_lights_and_background(camera, box, pose):
    gray = np.full((480, 640, 3), 40, np.uint8)
    dark = sixfold.render(box, pose, camera, lights=[], background=gray)
    assert not dark.rgb[dark.mask].any() and (dark.rgb[~dark.mask] == 40).all()
    flat = sixfold.render(box, pose, camera, lights=[sixfold.AmbientLight((1, 1, 1))], plain_color=(10, 20, 30))
    assert (flat.rgb[flat.mask] == [10, 20, 30]).all()
    lamps = [sixfold.DirectionalLight((0, 0, 1)), sixfold.PointLight((0, 0, 0), (0.3, 0.3, 0.3))]
    assert sixfold.render(box, pose, camera, lamps, specular=0.5).rgb[flat.mask].any()


def test_a_mesh_behind_the_camera_is_not_seen(camera, box):
    behind = np.eye(4)
    behind[2, 3] = -1
    assert not sixfold.render(box, behind, camera).mask.any()


def test_results_stay_when_their_source_is_gone(camera, pose):
    depth = sixfold.render(box_mesh(), pose, camera).depth
    copy = depth.copy()
    junk = [sixfold.render(box_mesh(), pose, camera).depth for _ in range(5)]
    del junk
    assert (depth == copy).all()


def test_the_table_under_objects(box):
    down = sixfold.pose_exp([0, 0, 0, 2.2, 0, 0])
    down[:3, 3] = (0, 0, 0.8)
    step = np.eye(4)
    step[0, 3] = 0.2
    plane = sixfold.support_plane([(box, down), (box, down @ step)])
    assert plane is not None and np.isclose(np.linalg.norm(plane.normal), 1)


def test_undistorted_images():
    camera = sixfold.Camera(500, 500, 31.5, 23.5, 64, 48, distortion=(0.2, 0, 0, 0))
    rgb = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    assert sixfold.undistort_rgb(rgb, camera).shape == rgb.shape
    depth = np.full((48, 64), 0.7, np.float32)
    assert np.isclose(np.median(sixfold.undistort_depth(depth, camera)), 0.7)
    assert (sixfold.undistort_rgb(rgb, camera.without_distortion()) == rgb).all()
