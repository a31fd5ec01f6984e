"""Neural Object Learning: poses of photographs made better, new views rendered from them."""

import numpy as np
import pytest

import sixfold
from scenes import posed


@pytest.fixture(scope="module")
def painted(bumpy):
    """The bumpy thing with patches of colour, one for three by three of its 40 rings and 80 sectors."""
    patches = np.random.default_rng(0).integers(20, 236, (14, 27, 3), dtype=np.uint8)
    colors = patches.repeat(3, 0).repeat(3, 1)[:40, :80].reshape(-1, 3)
    return sixfold.Mesh(bumpy.vertices, bumpy.faces, colors=colors)


@pytest.fixture(scope="module")
def view_camera():
    return sixfold.Camera(380.0, 380.0, 159.5, 119.5, 320, 240)


def looking(azimuth, elevation, distance=0.45):
    """A pose with the object's z axis up in the image."""
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    z = -np.array([ce * ca, ce * sa, se])
    x = np.cross(z, [0, 0, 1])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = [x, np.cross(z, x), z]
    pose[2, 3] = distance
    return pose


@pytest.fixture(scope="module")
def taken(painted, view_camera):
    """Eight photographs around the thing: images, masks, true poses."""
    out = []
    for k in range(8):
        pose = looking(k * np.pi / 4, 0.3 + 0.25 * (k % 2))
        drawn = sixfold.render(painted, pose, view_camera, lights=[sixfold.AmbientLight((1, 1, 1))])
        out.append((drawn.rgb, drawn.mask, pose))
    return out


def photographs(taken, camera, poses=None):
    poses = [t[2] for t in taken] if poses is None else poses
    return [
        sixfold.Photograph(rgb, camera, pose, mask, name=f"number {k}")
        for k, ((rgb, mask, _), pose) in enumerate(zip(taken, poses))
    ]


@pytest.fixture(scope="module")
def untextured(painted):
    return sixfold.Mesh(painted.vertices, painted.faces)


def test_a_photograph_keeps_what_it_was_given(taken, view_camera):
    rgb, mask, pose = taken[0]
    photograph = sixfold.Photograph(rgb, view_camera, pose, mask, name="first")
    assert (photograph.rgb == rgb).all() and (photograph.mask == mask).all() and photograph.name == "first"
    assert np.allclose(photograph.camera_from_object, pose) and photograph.camera.width == 320
    moved = photograph.with_pose(posed((0.01, 0, 0.5), (0, 0, 0)))
    assert np.allclose(moved.camera_from_object[:3, 3], [0.01, 0, 0.5])
    assert sixfold.Photograph(rgb, view_camera, pose).mask is None


def test_poses_get_better(taken, view_camera, untextured):
    rng = np.random.default_rng(3)
    truth = [t[2] for t in taken]
    rough = [pose @ sixfold.pose_exp([*rng.uniform(-0.006, 0.006, 3), *rng.uniform(-0.04, 0.04, 3)]) for pose in truth]
    fractions = []
    refined = sixfold.refine_poses(untextured, photographs(taken, view_camera, rough), progress=fractions.append)
    assert fractions == sorted(fractions) and 0 <= fractions[0] and fractions[-1] <= 1 and len(fractions) > 3

    def errors(poses):
        return np.mean([sixfold.metrics.add(untextured, p, t) for p, t in zip(poses, truth)])

    assert refined.camera_from_object.shape == (8, 4, 4)
    assert errors(refined.camera_from_object) < 0.75 * errors(rough)
    assert refined.moved.shape == refined.rotated.shape == (8,) and refined.differences.shape == (8, 2)
    assert np.nanmean(refined.differences[:, 1]) < np.nanmean(refined.differences[:, 0])
    assert len(refined) == len(refined.dropped) == 8
    kept = refined.photographs
    assert [p.name for p in kept] == [f"number {k}" for k, why in enumerate(refined.dropped) if why is None]
    assert isinstance(refined.still, bool)
    # The same objects, numbered; and an error of the callback stops the work.
    again = sixfold.refine_poses(
        [untextured], photographs(taken, view_camera, rough), objects=np.zeros(8, int), images=range(8)
    )
    assert (again.camera_from_object == refined.camera_from_object).all()

    def stop(fraction):
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        sixfold.refine_poses(untextured, photographs(taken, view_camera, rough), progress=stop)


@pytest.mark.parametrize("weighting", ["best", "average", "network"])
def test_new_views_look_like_the_object(taken, view_camera, untextured, painted, weighting):
    poses = np.stack([looking(0.4, 0.4), looking(2.0, 0.5)])
    told = []
    views = sixfold.synthesize(
        untextured,
        photographs(taken, view_camera),
        poses,
        view_camera,
        weighting=weighting,
        progress=lambda done, total: told.append((done, total)),
    )
    assert told == [(1, 2), (2, 2)] and len(views) == 2
    for view, pose in zip(views, poses):
        truth = sixfold.render(painted, pose, view_camera, lights=[sixfold.AmbientLight((1, 1, 1))])
        assert (view.mask == truth.mask).mean() > 0.995
        assert (view.rgb[~view.mask] == 0).all() and not (view.unseen & ~view.mask).any()
        assert view.unseen_fraction == pytest.approx(view.unseen.sum() / view.mask.sum()) and view.unseen_fraction < 0.1
        seen = view.mask & truth.mask & ~view.unseen
        difference = np.abs(view.rgb[seen].astype(int) - truth.rgb[seen]).mean()
        assert difference < 30, (weighting, difference)
        assert 1 <= len(view.sources) <= 6 and len(set(view.sources)) == len(view.sources)


def test_what_no_photograph_shows_is_said(taken, view_camera, untextured):
    [view] = sixfold.synthesize(
        untextured, photographs(taken, view_camera)[:1], [looking(np.pi, 0.3)], view_camera, weighting="best"
    )
    assert view.unseen_fraction > 0.5 and view.rgb[view.unseen].any()
    assert (
        sixfold.synthesize(
            untextured, photographs(taken, view_camera), np.zeros((0, 4, 4)), view_camera, weighting="best"
        )
        == []
    )


def test_wrong_use(taken, view_camera, untextured, weights, tmp_path):
    rgb, mask, pose = taken[0]
    behind = pose.copy()
    behind[2, 3] = -1
    lens = sixfold.Camera(380, 380, 160, 120, 320, 240, distortion=(0.1, 0, 0, 0))
    some = photographs(taken, view_camera)
    cloud = sixfold.Mesh(np.eye(3))
    hidden = [sixfold.Photograph(rgb, view_camera, pose, np.zeros_like(mask))]
    for call, name in [
        (lambda: sixfold.Photograph(rgb.astype(float), view_camera, pose), "rgb"),
        (lambda: sixfold.Photograph(rgb[:9], view_camera, pose), "rgb"),
        (lambda: sixfold.Photograph(rgb, lens, pose), "camera"),
        (lambda: sixfold.Photograph(rgb, view_camera, pose[:3]), "camera_from_object"),
        (lambda: sixfold.Photograph(rgb, view_camera, behind), "camera_from_object"),
        (lambda: sixfold.Photograph(rgb, view_camera, np.full((4, 4), np.nan)), "camera_from_object"),
        (lambda: sixfold.Photograph(rgb, view_camera, pose, mask[:9]), "mask"),
        (lambda: sixfold.Photograph(rgb, view_camera, pose, rgb[..., 0]), "mask"),
        (lambda: some[0].with_pose(behind), "camera_from_object"),
        (lambda: sixfold.refine_poses(untextured, []), "photographs"),
        (lambda: sixfold.refine_poses(cloud, some), "mesh"),
        (lambda: sixfold.refine_poses("mug", some), "mesh"),
        (lambda: sixfold.refine_poses(untextured, some, scene="windy"), "scene"),
        (lambda: sixfold.refine_poses(untextured, some, rough=(0, 0.1)), "rough"),
        (lambda: sixfold.refine_poses(untextured, some, rough=(np.nan, 0.1)), "rough"),
        (lambda: sixfold.refine_poses(untextured, some, objects=[0]), "objects"),
        (lambda: sixfold.refine_poses(untextured, some, objects=[1] * 8), "objects"),
        (lambda: sixfold.refine_poses(untextured, some, images=[0.5] * 8), "images"),
        (lambda: sixfold.refine_poses(untextured, some, shared=-1), "shared"),
        (lambda: sixfold.refine_poses(untextured, some, seed=-1), "seed"),
        (lambda: sixfold.synthesize(untextured, [], [pose], view_camera), "photographs"),
        (lambda: sixfold.synthesize(untextured, hidden, [pose], view_camera, weighting="best"), "photographs"),
        (lambda: sixfold.synthesize(cloud, some, [pose], view_camera), "mesh"),
        (lambda: sixfold.synthesize(untextured, some, pose, view_camera), "poses"),
        (lambda: sixfold.synthesize(untextured, some, [pose], lens), "camera"),
        (lambda: sixfold.synthesize(untextured, some, [pose], view_camera, weighting="worst"), "weighting"),
        (lambda: sixfold.synthesize(untextured, some, [pose], view_camera, per_view=0), "per_view"),
        (lambda: sixfold.synthesize(untextured, some, [pose], view_camera, per_view=99), "per_view"),
        (lambda: sixfold.synthesize(untextured, some, [pose], view_camera, weights=weights), "weights"),
        (
            lambda: sixfold.synthesize(untextured, some, [pose], view_camera, weighting="best", weights=weights),
            "weights",
        ),
    ]:
        with pytest.raises(ValueError, match=name):
            call()
    with pytest.raises(FileNotFoundError):
        sixfold.synthesize(untextured, some, [pose], view_camera, weights=tmp_path / "none.safetensors")
    with pytest.raises(TypeError):
        sixfold.refine_poses(untextured, [rgb])
    # Behind the camera there is nothing to see.
    [nothing] = sixfold.synthesize(untextured, some, [behind], view_camera, weighting="best")
    assert not nothing.mask.any() and nothing.unseen_fraction == 0
