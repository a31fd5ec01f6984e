"""Camera, PnP, Kabsch, Umeyama, ICP, depth images."""

import pickle

import numpy as np
import pytest

import sixfold


def correspondences(camera, pose, count=200, outliers=0.4, noise=0.3, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.05, 0.05, (count, 3))
    pixels = camera.project(points @ pose[:3, :3].T + pose[:3, 3]) + rng.normal(scale=noise, size=(count, 2))
    wrong = rng.random(count) < outliers
    pixels[wrong] = rng.uniform(0, 480, (wrong.sum(), 2))
    return points, pixels, wrong


def test_projection_is_the_pinhole_formula(camera):
    points = np.random.default_rng(0).uniform([-0.2, -0.2, 0.5], [0.2, 0.2, 2], (50, 3))
    expected = points[:, :2] / points[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    assert np.allclose(camera.project(points), expected)
    assert np.allclose(camera.unproject(expected, points[:, 2]), points)
    assert np.isnan(camera.project([[0, 0, -1], [0, 0, 0]])).all()


def test_camera_files(tmp_path):
    file = tmp_path / "camera.json"
    file.write_text('{"fx": 500, "fy": 510, "cx": 320, "cy": 240, "depth_scale": 0.1}')
    assert sixfold.Camera.load(file, 640, 480) == (sixfold.Camera(500, 510, 320, 240, 640, 480), 0.1)
    with pytest.raises(ValueError, match="width and height"):
        sixfold.Camera.load(file)
    with pytest.raises(ValueError, match=r"camera\.json.*another resolution"):
        sixfold.Camera.load(file, 320, 240)
    file.write_text('{"cam_K": [500, 0, 320, 0, 510, 240, 0, 0, 1], "width": 640, "height": 480}')
    assert sixfold.Camera.load(file) == (sixfold.Camera(500, 510, 320, 240, 640, 480), None)
    file.write_text('{"cam_K": [500, 0]}')
    with pytest.raises(ValueError, match=r"camera\.json.*cam_K"):
        sixfold.Camera.load(file, 640, 480)
    with pytest.raises(FileNotFoundError):
        sixfold.Camera.load(tmp_path / "none.json", 640, 480)


def test_distortion_is_undone():
    camera = sixfold.Camera(500, 510, 320, 240, 640, 480, distortion=(-0.1, 0.02, 0.001, -0.002))
    assert camera.distortion == (-0.1, 0.02, 0.001, -0.002, 0.0)
    pixels = np.random.default_rng(1).uniform(0, 480, (100, 2))
    assert np.allclose(camera.undistort_points(camera.distort_points(pixels)), pixels, atol=1e-6)
    assert camera.without_distortion().distortion is None


def test_camera_is_a_value(camera):
    assert pickle.loads(pickle.dumps(camera)) == camera
    assert camera != camera.resize(320, 240)
    assert eval(repr(camera), {"Camera": sixfold.Camera}) == camera
    small = camera.crop([100, 50, 64, 48])
    assert (small.width, small.height, small.cx) == (64, 48, camera.cx - 100)


def test_exponential_and_logarithm():
    twist = np.array([0.1, -0.2, 0.8, 0.3, -0.5, 0.7])
    pose = sixfold.pose_exp(twist)
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
    assert np.allclose(sixfold.pose_log(pose), twist)


@pytest.mark.parametrize("solver", ["ap3p", "epnp"])
def test_pnp_finds_the_pose_among_outliers(camera, pose, solver):
    points, pixels, wrong = correspondences(camera, pose)
    found = sixfold.pnp_ransac(points, pixels, camera, solver=solver)
    assert found.camera_from_object.shape == (4, 4) and found.camera_from_object.dtype == np.float64
    assert found.inliers.dtype == bool and found.inliers.sum() == found.inlier_count
    assert np.abs(found.camera_from_object - pose)[:3, :3].max() < 0.02
    assert not found.inliers[wrong].sum() > 3 and found.inliers[~wrong].all()
    unpacked, inliers = found
    assert unpacked is found.camera_from_object and inliers is found.inliers


def test_pnp_of_a_distorted_image(pose):
    camera = sixfold.Camera(572, 573, 325, 242, 640, 480, distortion=(-0.1, 0.05, 0, 0, 0))
    points, pixels, _ = correspondences(camera, pose, outliers=0, noise=0)
    found = sixfold.pnp_ransac(points, camera.distort_points(pixels), camera)
    assert np.allclose(found.camera_from_object, pose, atol=1e-6)


def test_same_seed_same_bytes(camera, pose, bumpy):
    points, pixels, _ = correspondences(camera, pose, outliers=0.7)
    runs = [sixfold.pnp_ransac(points, pixels, camera, seed=s).camera_from_object.tobytes() for s in (3, 3, 4)]
    assert runs[0] == runs[1]
    samples = [bumpy.sample_surface(500, seed=s)[0].tobytes() for s in (3, 3, 4)]
    assert samples[0] == samples[1] != samples[2]
    drawn = sixfold.render(bumpy, pose, camera)
    noisy = [sixfold.simulate_depth(drawn.depth, drawn.normals, seed=s).tobytes() for s in (3, 3, 4)]
    assert noisy[0] == noisy[1] != noisy[2]


def test_epnp_and_refinement(camera, pose):
    points, pixels, wrong = correspondences(camera, pose, noise=0.1)
    clean = sixfold.epnp(points[~wrong], pixels[~wrong], camera)
    assert np.allclose(clean, pose, atol=5e-3)
    refined, inliers = sixfold.refine_pose(points, pixels, camera, clean)
    assert np.allclose(refined, pose, atol=2e-3) and inliers >= (~wrong).sum() - 2


def test_kabsch_and_umeyama_with_weights(pose):
    rng = np.random.default_rng(0)
    source = rng.normal(size=(30, 3))
    target = source @ pose[:3, :3].T + pose[:3, 3]
    assert np.allclose(sixfold.kabsch(source, target), pose)
    spoiled = target.copy()
    spoiled[:5] += 10
    weights = np.r_[np.zeros(5), np.ones(25)]
    assert np.allclose(sixfold.kabsch(source, spoiled, weights), pose)
    found, scale = sixfold.umeyama(source, 2.5 * source @ pose[:3, :3].T + pose[:3, 3])
    assert np.isclose(scale, 2.5) and np.allclose(found, pose)


def test_icp_on_points(bumpy):
    points, normals, _ = bumpy.sample_surface(4000, seed=0)
    source, source_normals, _ = bumpy.sample_surface(1000, seed=1)
    start = sixfold.pose_exp([0.004, -0.003, 0.002, 0.05, -0.04, 0.06])
    found = sixfold.icp(source, points, normals, start, rejection_distance=0.015, source_normals=source_normals)
    pose, rms = found
    assert np.allclose(pose, np.eye(4), atol=3e-3) and rms == found.rms < 1e-3
    assert found.inliers > 900 and found.iterations > 1
    levels = [(0.015, 20, 1)]
    again = sixfold.icp(source, points, normals, start, levels=levels)
    assert np.allclose(again.target_from_source, np.eye(4), atol=3e-3)


def test_icp_on_a_depth_image(camera, bumpy, pose):
    drawn = sixfold.render(bumpy, pose, camera)
    start = sixfold.pose_exp([0.003, -0.002, 0.004, 0.03, -0.02, 0.02]) @ pose
    source = drawn.coordinates[drawn.mask]
    found = sixfold.icp_to_depth(source, drawn.depth, camera, start, rejection_distance=0.02)
    assert np.abs(found.target_from_source - pose).max() < 2e-3


def test_depth_becomes_points_normals_and_planes(camera):
    y, x = np.mgrid[:480, :640]
    normal, offset = np.array([0.1, -0.6, -0.79]), -0.6
    normal /= np.linalg.norm(normal)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
    depth = (offset / (rays @ normal)).astype(np.float32)
    depth[depth > 3] = 0
    depth[100:110, 100:110] = np.nan
    normals = sixfold.normals_from_depth(depth, camera)
    assert np.allclose(normals[300, 320], normal, atol=1e-3) and not normals[105, 105].any()
    points, at = sixfold.point_cloud(depth, camera)
    assert points.shape == at.shape and np.abs(points @ normal - offset).max() < 1e-4
    plane = sixfold.dominant_plane(points[::50])
    assert np.allclose(plane.normal, normal, atol=1e-3) and np.isclose(plane.offset, offset, atol=1e-3)
    assert np.abs(plane.distance(points)).max() < 2e-3
    thin, kept = sixfold.voxel_downsample(points, 0.05, at)
    assert len(thin) == len(kept) < len(points) / 20
    assert sixfold.inpaint_depth(np.array([[1, 0, 1.0]]), 1).tolist() == [[1, 1, 1]]


def test_ppf_finds_a_mesh_in_simulated_depth(camera, bumpy, pose):
    table = sixfold.Mesh(np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), [[0, 1, 2], [0, 2, 3]])
    behind = sixfold.pose_exp([0, 0, 0.85, 0.3, 0, 0])
    drawn = sixfold.render_scene([(bumpy, pose), (table, behind)], camera)
    depth = sixfold.simulate_depth(drawn.depth, drawn.normals, seed=1)
    model = sixfold.PpfModel(bumpy)
    assert np.isclose(model.diameter, bumpy.diameter) and model.pair_count > 1000 and model.samples.shape[1] == 3
    scene = sixfold.PpfScene(depth, camera)
    assert scene.plane is not None and scene.points.shape[1] == 3
    found = sixfold.estimate_ppf(scene, model)
    assert len(found) == 1 and 0 < found[0].confidence <= 1 and found[0].verification["inliers"] > 100
    assert sixfold.metrics.add(bumpy, found[0].camera_from_object, pose) < 0.1 * bumpy.diameter
    again = sixfold.estimate_ppf(depth, bumpy, camera)
    assert again[0].camera_from_object.tobytes() == found[0].camera_from_object.tobytes()


def test_ppf_description_is_kept(tmp_path, bumpy):
    file = tmp_path / "bumpy.sixfold-ppf"
    first = sixfold.PpfModel(bumpy, cache=file)
    assert file.is_file()
    second = sixfold.PpfModel(bumpy, cache=file)
    assert second.cache_note is None and second.pair_count == first.pair_count
    file.write_bytes(b"broken")
    third = sixfold.PpfModel(bumpy, cache=file)
    assert third.cache_note and third.pair_count == first.pair_count
