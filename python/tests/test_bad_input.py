"""Whatever is handed in: a ValueError that names the argument, never a crash, and views of arrays give the same result."""

import numpy as np
import pytest

import sixfold
from sixfold import bop, metrics
from scenes import box_mesh

CAMERA = sixfold.Camera(500, 500, 320, 240, 640, 480)
BOX = box_mesh()
POSE = sixfold.pose_exp([0, 0, 0.6, 0.1, 0.2, 0.3])
RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-0.05, 0.05, (30, 3))
PIXELS = CAMERA.project(POINTS @ POSE[:3, :3].T + POSE[:3, 3])
DEPTH = sixfold.render_depth(BOX, POSE, CAMERA)
NORMALS = np.tile([0.0, 0.0, -1.0], (30, 1))


def with_nan(array):
    array = np.array(array, float)
    array.flat[3] = np.nan
    return array


def line(n=30):
    return np.linspace(0, 1, n)[:, None] * [0.1, 0.05, 0.02]


TEXT = np.array([["a", "b", "c"]])
WRONG_POINTS = {
    "a string": "points",
    "None": None,
    "a number": 3.0,
    "text": TEXT,
    "complex": POINTS.astype(complex),
    "bool": POINTS > 0,
    "objects": np.array([[object()] * 3]),
    "two columns": POINTS[:, :2],
    "one dimension": POINTS.ravel(),
    "three dimensions": POINTS[None],
    "ragged": [[0, 0, 0], [1, 2]],
    "NaN": with_nan(POINTS),
    "infinite": np.full((30, 3), np.inf),
    "dates": np.zeros((30, 3), "datetime64[s]"),
}


@pytest.mark.parametrize("wrong", WRONG_POINTS.values(), ids=WRONG_POINTS.keys())
@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("object_points", lambda p: sixfold.pnp_ransac(p, PIXELS, CAMERA)),
        ("object_points", lambda p: sixfold.epnp(p, PIXELS, CAMERA)),
        ("object_points", lambda p: sixfold.refine_pose(p, PIXELS, CAMERA, POSE)),
        ("source", lambda p: sixfold.kabsch(p, POINTS)),
        ("target", lambda p: sixfold.umeyama(POINTS, p)),
        ("source", lambda p: sixfold.icp(p, POINTS, NORMALS)),
        ("target", lambda p: sixfold.icp(POINTS, p, NORMALS)),
        ("target_normals", lambda p: sixfold.icp(POINTS, POINTS, p)),
        ("vertices", lambda p: sixfold.Mesh(p)),
        ("points", lambda p: CAMERA.project(p)),
        ("points", lambda p: sixfold.voxel_downsample(p, 0.01)),
        ("points", lambda p: sixfold.fit_plane(p)),
        ("points", lambda p: sixfold.dominant_plane(p)),
        ("model", lambda p: metrics.add(p, POSE, POSE)),
        ("model", lambda p: metrics.mssd(p, POSE, POSE)),
    ],
)
def test_points(name, call, wrong):
    with pytest.raises(ValueError, match=f"^{name}: expected .*, found "):
        call(wrong)


WRONG_POSES = {
    "3x4": POSE[:3],
    "a stack": POSE[None],
    "NaN": with_nan(POSE),
    "zeros": np.zeros((4, 4)),
    "a reflection": np.diag([1.0, 1, -1, 1]),
    "a scale": np.diag([2.0, 2, 2, 1]),
    "a projection": np.vstack([POSE[:3], [0, 0, 1, 1]]),
    "text": "pose",
    "None": None,
}


@pytest.mark.parametrize("wrong", WRONG_POSES.values(), ids=WRONG_POSES.keys())
@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("camera_from_object", lambda p: sixfold.render(BOX, p, CAMERA)),
        ("camera_from_object", lambda p: sixfold.render_depth(BOX, p, CAMERA)),
        ("camera_from_object", lambda p: sixfold.render_scene([(BOX, p)], CAMERA)),
        ("camera_from_object", lambda p: bop.Estimate(1, 1, 1, 1.0, p)),
        ("estimate", lambda p: metrics.add(POINTS, p, POSE)),
        ("ground_truth", lambda p: metrics.mspd(POINTS, POSE, p, CAMERA)),
        ("ground_truth", lambda p: metrics.rotation_error(POSE, p)),
        ("initial", lambda p: sixfold.refine_pose(POINTS, PIXELS, CAMERA, p)),
        ("pose", lambda p: BOX.transformed(p)),
        ("pose", lambda p: bop.pose_to_mm(p)),
    ],
)
def test_poses(name, call, wrong):
    with pytest.raises(ValueError, match=f"^{name}: "):
        call(wrong)


WRONG_DEPTH = {
    "millimetres in integers": (1000 * DEPTH).astype(np.uint16),
    "colour": np.zeros((480, 640, 3), np.float32),
    "empty": np.zeros((0, 640), np.float32),
    "bool": DEPTH > 0,
    "None": None,
}


@pytest.mark.parametrize("wrong", WRONG_DEPTH.values(), ids=WRONG_DEPTH.keys())
@pytest.mark.parametrize(
    "call",
    [
        lambda d: sixfold.normals_from_depth(d, CAMERA),
        lambda d: sixfold.point_cloud(d, CAMERA),
        lambda d: sixfold.estimate_ppf(d, BOX, CAMERA),
        lambda d: sixfold.icp_to_depth(POINTS, d, CAMERA, POSE),
        lambda d: metrics.vsd(BOX, POSE, POSE, d, CAMERA),
        lambda d: sixfold.undistort_depth(d, CAMERA),
    ],
)
def test_depth(call, wrong):
    with pytest.raises(ValueError, match="^depth: expected "):
        call(wrong)


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("object_points, image_points", lambda: sixfold.pnp_ransac(POINTS[:9], PIXELS, CAMERA)),
        ("object_points", lambda: sixfold.pnp_ransac(POINTS[:3], PIXELS[:3], CAMERA)),
        ("object_points", lambda: sixfold.pnp_ransac(POINTS[:0], PIXELS[:0], CAMERA)),
        ("object_points", lambda: sixfold.pnp_ransac(line(), PIXELS, CAMERA)),
        ("object_points", lambda: sixfold.pnp_ransac(np.zeros((30, 3)), PIXELS, CAMERA)),
        ("image_points", lambda: sixfold.pnp_ransac(POINTS, with_nan(PIXELS), CAMERA)),
        ("image_points", lambda: sixfold.pnp_ransac(POINTS, POINTS, CAMERA)),
        ("threshold_px", lambda: sixfold.pnp_ransac(POINTS, PIXELS, CAMERA, threshold_px=-1)),
        ("threshold_px", lambda: sixfold.pnp_ransac(POINTS, PIXELS, CAMERA, threshold_px=np.nan)),
        ("max_iterations", lambda: sixfold.pnp_ransac(POINTS, PIXELS, CAMERA, max_iterations=0)),
        ("max_iterations", lambda: sixfold.pnp_ransac(POINTS, PIXELS, CAMERA, max_iterations=-4)),
        ("confidence", lambda: sixfold.pnp_ransac(POINTS, PIXELS, CAMERA, confidence=2.0)),
        ("seed", lambda: sixfold.pnp_ransac(POINTS, PIXELS, CAMERA, seed=-1)),
        ("solver", lambda: sixfold.pnp_ransac(POINTS, PIXELS, CAMERA, solver="dlt")),
        ("source, target", lambda: sixfold.kabsch(POINTS[:2], POINTS[:2])),
        ("source, target", lambda: sixfold.kabsch(line(), line())),
        ("source, target", lambda: sixfold.kabsch(POINTS, POINTS[:5])),
        ("weights", lambda: sixfold.kabsch(POINTS, POINTS, -np.ones(30))),
        ("weights", lambda: sixfold.kabsch(POINTS, POINTS, with_nan(np.ones(30)))),
        ("weights", lambda: sixfold.kabsch(POINTS, POINTS, np.ones(29))),
        ("depth_estimate", lambda: metrics.vsd_of_depth(DEPTH[:9], DEPTH, DEPTH, CAMERA, 0.1)),
        ("depth", lambda: metrics.vsd_of_depth(DEPTH, DEPTH, DEPTH[:9], CAMERA, 0.1)),
        ("target_normals", lambda: sixfold.icp(POINTS, POINTS, NORMALS[:5])),
        ("source_normals", lambda: sixfold.icp(POINTS, POINTS, NORMALS, source_normals=NORMALS[:5])),
        ("source", lambda: sixfold.icp(POINTS[:0], POINTS, NORMALS)),
        ("rejection_distance", lambda: sixfold.icp(POINTS, POINTS, NORMALS, rejection_distance=0)),
        ("levels", lambda: sixfold.icp(POINTS, POINTS, NORMALS, levels=[(0.01, 5)])),
        ("levels", lambda: sixfold.icp(POINTS, POINTS, NORMALS, levels=3)),
        ("max_angle", lambda: sixfold.icp(POINTS, POINTS, NORMALS, max_angle=-1)),
        ("vertices", lambda: sixfold.Mesh(np.zeros((0, 3)))),
        ("faces", lambda: sixfold.Mesh(POINTS, [[0, 1, 99]])),
        ("faces", lambda: sixfold.Mesh(POINTS, [[0, 1, -1]])),
        ("faces", lambda: sixfold.Mesh(POINTS, [[0.0, 1.0, 2.0]])),
        ("faces", lambda: sixfold.Mesh(POINTS, [[0, 1, 2**40]])),
        ("colors", lambda: sixfold.Mesh(POINTS, colors=np.zeros((5, 3), np.uint8))),
        ("colors", lambda: sixfold.Mesh(POINTS, colors=np.zeros((30, 3)))),
        ("normals", lambda: sixfold.Mesh(POINTS, normals=POINTS[:4])),
        ("texture", lambda: sixfold.Mesh(POINTS, texcoords=POINTS[:, :2])),
        ("symmetries", lambda: sixfold.Mesh(POINTS, symmetries=[np.zeros((4, 4))])),
        ("symmetry_axes", lambda: sixfold.Mesh(POINTS, symmetry_axes=[((0, 0, 0), (0, 0, 0))])),
        ("symmetry_axes", lambda: sixfold.Mesh(POINTS, symmetry_axes=[1])),
        ("unit", lambda: sixfold.Mesh.load("x.ply", unit="feet")),
        ("faces", lambda: BOX.simplify(0)),
        ("factor", lambda: BOX.scaled(0)),
        ("factor", lambda: BOX.scaled(np.inf)),
        ("count", lambda: BOX.sample_surface(-1)),
        ("mesh", lambda: sixfold.Mesh(line()).surfels()),
        ("mesh", lambda: sixfold.Mesh(POINTS[:3], [[0, 1, 2]]).convex_hull()),
        ("meshes", lambda: sixfold.Mesh.merged([])),
        ("fx", lambda: sixfold.Camera(0, 500, 320, 240, 640, 480)),
        ("fy", lambda: sixfold.Camera(500, np.nan, 320, 240, 640, 480)),
        ("cx", lambda: sixfold.Camera(500, 500, np.inf, 240, 640, 480)),
        ("width", lambda: sixfold.Camera(500, 500, 320, 240, 0, 480)),
        ("height", lambda: sixfold.Camera(500, 500, 320, 240, 640, -480)),
        ("distortion", lambda: sixfold.Camera(500, 500, 320, 240, 640, 480, distortion=[1, 2, 3])),
        ("distortion", lambda: sixfold.Camera(500, 500, 320, 240, 640, 480, distortion=[np.nan] * 5)),
        ("depth", lambda: CAMERA.unproject(PIXELS, [1.0])),
        ("box", lambda: CAMERA.crop([0, 0, 0, 0])),
        ("background", lambda: sixfold.render(BOX, POSE, CAMERA, background=np.zeros((4, 4, 3), np.uint8))),
        ("lights", lambda: sixfold.render(BOX, POSE, CAMERA, lights=["sun"])),
        ("lights", lambda: sixfold.render(BOX, POSE, CAMERA, lights=3)),
        ("camera", lambda: sixfold.render(BOX, POSE, sixfold.Camera(500, 500, 0, 0, 2**20, 2**20))),
        ("camera", lambda: sixfold.render_depth(BOX, POSE, sixfold.Camera(500, 500, 0, 0, 2**20, 2**20))),
        ("count", lambda: BOX.sample_surface(2**40)),
        ("near", lambda: sixfold.render(BOX, POSE, CAMERA, near=-1)),
        ("shininess", lambda: sixfold.render(BOX, POSE, CAMERA, shininess=np.nan)),
        ("objects", lambda: sixfold.render_scene([], CAMERA)),
        ("objects", lambda: sixfold.render_scene([BOX], CAMERA)),
        ("objects", lambda: sixfold.render_scene(7, CAMERA)),
        ("color", lambda: sixfold.AmbientLight((np.nan, 0, 0))),
        ("direction", lambda: sixfold.DirectionalLight((0, 0, 0))),
        ("normals", lambda: sixfold.simulate_depth(DEPTH, np.zeros((4, 4, 3), np.float32))),
        ("depth", lambda: sixfold.normals_from_depth(DEPTH[:-1], CAMERA)),
        ("depth", lambda: sixfold.estimate_ppf(1000 * DEPTH, BOX, CAMERA)),
        ("mask", lambda: sixfold.estimate_ppf(DEPTH, BOX, CAMERA, DEPTH)),
        ("mask", lambda: sixfold.estimate_ppf(DEPTH, BOX, CAMERA, np.ones((4, 4), bool))),
        ("camera", lambda: sixfold.estimate_ppf(DEPTH, BOX)),
        ("model", lambda: sixfold.estimate_ppf(DEPTH, "box", CAMERA)),
        ("instances", lambda: sixfold.estimate_ppf(DEPTH, BOX, CAMERA, instances=0)),
        ("min_score", lambda: sixfold.estimate_ppf(DEPTH, BOX, CAMERA, min_score=np.nan)),
        ("mesh", lambda: sixfold.PpfModel(sixfold.Mesh(POINTS))),
        ("sampling_step", lambda: sixfold.PpfModel(BOX, sampling_step=5)),
        ("size", lambda: sixfold.voxel_downsample(POINTS, 0)),
        ("normals", lambda: sixfold.voxel_downsample(POINTS, 0.1, NORMALS[:4])),
        ("points", lambda: sixfold.fit_plane(POINTS[:2])),
        ("twist", lambda: sixfold.pose_exp([1, 2, 3])),
        ("symmetries", lambda: metrics.mssd(POINTS, POSE, POSE, np.zeros((0, 4, 4)))),
        ("model", lambda: metrics.adi(np.zeros((0, 3)), POSE, POSE)),
        ("diameter", lambda: metrics.vsd(BOX, POSE, POSE, DEPTH, CAMERA, diameter=0)),
        ("mesh", lambda: metrics.vsd(sixfold.Mesh(POINTS), POSE, POSE, DEPTH, CAMERA)),
        ("delta", lambda: metrics.vsd(BOX, POSE, POSE, DEPTH, CAMERA, delta=-1)),
        ("positives", lambda: metrics.average_precision([True], -1)),
        ("errors", lambda: metrics.area_under_accuracy([np.nan])),
        ("score", lambda: bop.Estimate(1, 1, 1, np.nan, POSE)),
        ("scene_id", lambda: bop.Estimate(-1, 1, 1, 1.0, POSE)),
        ("time", lambda: bop.Estimate(1, 1, 1, 1.0, POSE, time=-3)),
        ("rotation", lambda: bop.pose_from_mm(np.zeros((3, 3)), [0, 0, 0])),
        ("mm_per_unit", lambda: bop.read_depth("depth.png", 0)),
        ("mask", lambda: sixfold.coco.encode_mask(DEPTH)),
    ],
)
def test_every_refusal_names_its_argument(name, call):
    with pytest.raises(ValueError, match=f"(^|field |option ){name}"):
        call()


def test_no_solution_is_told_from_bad_input():
    scattered = RNG.uniform(0, 480, PIXELS.shape)
    with pytest.raises(sixfold.NoSolutionError):
        sixfold.pnp_ransac(POINTS, scattered, CAMERA, threshold_px=0.01)
    with pytest.raises(sixfold.NoSolutionError, match="rejection distance"):
        sixfold.icp(POINTS + 10, POINTS, NORMALS)
    assert issubclass(sixfold.NoSolutionError, ValueError)


def test_distorted_images_are_refused_where_a_pinhole_is_needed():
    lens = sixfold.Camera(500, 500, 320, 240, 640, 480, distortion=(0.1, 0, 0, 0))
    for call in (
        lambda: sixfold.estimate_ppf(DEPTH, BOX, lens),
        lambda: sixfold.point_cloud(DEPTH, lens),
        lambda: metrics.vsd(BOX, POSE, POSE, DEPTH, lens),
    ):
        with pytest.raises(ValueError, match="camera: .*undistort"):
            call()


def test_views_are_read_as_they_look():
    wide = np.zeros((60, 6))
    wide[::2, ::2] = POINTS
    expected = sixfold.pnp_ransac(POINTS, PIXELS, CAMERA).camera_from_object
    for points in (
        wide[::2, ::2],
        np.asfortranarray(POINTS),
        POINTS.astype(">f8"),
        POINTS[::-1][::-1],
        POINTS.tolist(),
    ):
        assert (sixfold.pnp_ransac(points, PIXELS, CAMERA).camera_from_object == expected).all()
    transposed = sixfold.pose_exp([0, 0, 0.6, 0.1, 0.2, 0.3]).T
    assert (sixfold.render_depth(BOX, transposed.T, CAMERA) == DEPTH).all()
    read_only = POINTS.copy()
    read_only.flags.writeable = False
    assert (sixfold.pnp_ransac(read_only, PIXELS, CAMERA).camera_from_object == expected).all()
    flipped = DEPTH[::-1]
    assert (sixfold.inpaint_depth(flipped, 0) == flipped).all()
    single = POINTS.astype(np.float32)
    assert np.allclose(sixfold.pnp_ransac(single, PIXELS, CAMERA).camera_from_object, expected, atol=1e-4)


def test_missing_depth_may_be_nan_zero_or_negative():
    holes = DEPTH.copy()
    holes[200:240, 300:320] = [[np.nan] * 10 + [-1.0] * 5 + [np.inf] * 5]
    zeros = np.where(np.isfinite(holes) & (holes > 0), holes, 0)
    assert (sixfold.normals_from_depth(holes, CAMERA) == sixfold.normals_from_depth(zeros, CAMERA)).all()
    assert len(sixfold.point_cloud(np.zeros((480, 640), np.float32), CAMERA)[0]) == 0
    with pytest.raises(ValueError, match="^depth: .*no valid pixel"):
        sixfold.estimate_ppf(np.zeros((480, 640), np.float32), BOX, CAMERA)


def test_files_that_are_missing_or_broken(tmp_path):
    with pytest.raises(FileNotFoundError, match="none.ply"):
        sixfold.Mesh.load(tmp_path / "none.ply", "mm")
    with pytest.raises(FileNotFoundError):
        bop.Dataset(tmp_path / "none")
    with pytest.raises(OSError):
        BOX.save(tmp_path / "no/such/folder/box.ply", "mm")
    (tmp_path / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 5\nend_header\n")
    with pytest.raises(ValueError, match="broken.ply"):
        sixfold.Mesh.load(tmp_path / "broken.ply", "mm")
    (tmp_path / "image.png").write_bytes(b"no image")
    with pytest.raises(ValueError, match="image.png"):
        bop.read_rgb(tmp_path / "image.png")


def test_impossible_cameras_are_refused_with_advice(tmp_path):
    for numbers, words in [
        ((0.5, 0.5, 319.5, 239.5), "millimetres"),
        ((0.9, 1.2, 0.5, 0.5), "normalised"),
        ((572.4, 57.24, 325.3, 242.0), "factor of 2"),
        ((572.4, 573.6, 1e9, 242.0), "another resolution"),
    ]:
        with pytest.raises(ValueError, match=f"field.*{words}"):
            sixfold.Camera(*numbers, 640, 480)
    with pytest.raises(ValueError, match="field"):
        CAMERA.crop((1e6, 0, 100, 100))
    with pytest.raises(ValueError, match="factor of 2"):
        CAMERA.resize(2000, 480)
    file = tmp_path / "camera.json"
    file.write_text('{"fx": 572.4, "fy": 573.6, "cx": 325.3, "cy": 242.0, "width": 640, "height": 480, "lens": 1}')
    with pytest.raises(ValueError, match=r"camera\.json.*field lens is unknown; known are fx"):
        sixfold.Camera.load(file)
    file.write_text("height: 480\nwidth: 640\nK: [572.4, 0, 325.3, 0, 573.6, 242.0, 0, 0, 1]\nD: [0.1, 0, 0, 0, 0]\n")
    camera, _ = sixfold.Camera.load(file)
    assert camera.distortion == (0.1, 0, 0, 0, 0) and camera.fx == 572.4


def test_images_above_the_limit_are_refused(tmp_path):
    bop.write_rgb(tmp_path / "rgb.png", np.zeros((30, 40, 3), np.uint8))
    try:
        bop.set_max_pixels(1199)
        with pytest.raises(ValueError, match=r"rgb\.png.*40x30.*set_max_pixels"):
            bop.read_rgb(tmp_path / "rgb.png")
        bop.set_max_pixels(1200)
        assert bop.read_rgb(tmp_path / "rgb.png").shape == (30, 40, 3)
    finally:
        bop.set_max_pixels(100_000_000)
    with pytest.raises(ValueError, match="^pixels"):
        bop.set_max_pixels(0)


def test_scalars_of_a_wrong_type_are_type_errors():
    with pytest.raises(TypeError):
        sixfold.Camera("500", 500, 320, 240, 640, 480)
    with pytest.raises(TypeError):
        sixfold.render("mesh", POSE, CAMERA)
