"""Objects found by templates: from a mesh, from one masked depth image, with and without poses."""

import numpy as np
import pytest

import sixfold
from scenes import box_mesh, posed


@pytest.fixture(scope="module")
def thing():
    """Two boxes grown together, 15 cm large: no symmetry."""
    return sixfold.Mesh.merged(
        [box_mesh((0.05, 0.12, 0.04)), box_mesh((0.08, 0.04, 0.07)).transformed(posed((0.03, 0.04, 0.015), (0, 0, 0)))]
    )


def scene_of(thing, turn, place):
    """The thing on a table: depth, camera, its mask and pose."""
    camera = sixfold.Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
    table = box_mesh((1.2, 1.2, 0.02))
    view = posed((0.0, 0.05, 0.8), (2.4, 0.0, 0.0))
    pose = view @ posed((*place, 0.02), (0.0, 0.0, turn))
    drawn = sixfold.render_scene([(table, view @ posed((0, 0, -0.01), (0, 0, 0))), (thing, pose)], camera)
    return drawn.depth, camera, drawn.masks[1], pose


@pytest.fixture(scope="module")
def scene(thing):
    return scene_of(thing, 0.7, (0.04, -0.03))


@pytest.fixture(scope="module")
def templates(thing):
    return sixfold.Templates.from_mesh(thing)


def overlap(a, b):
    return (a & b).sum() / (a | b).sum()


def test_templates_and_their_files(templates, thing, tmp_path):
    assert len(templates) == 305 and templates.source == "mesh"
    assert np.isclose(templates.diameter, thing.diameter) and templates.size > templates.diameter
    assert templates.view_from_object.shape == (305, 4, 4)
    patches = templates.patches
    assert patches.shape == (305, 64, 64) and patches.dtype == np.float32
    assert np.abs(patches[:, 32, 32]).max() < 0.02 and np.isnan(patches[:, 0, 0]).all()
    file = tmp_path / "thing.sixfold-templates"
    templates.save(file)
    again = sixfold.Templates.load(file)
    assert (again.view_from_object == templates.view_from_object).all()
    file.write_bytes(file.read_bytes()[:-7])
    with pytest.raises(ValueError, match="thing.sixfold-templates: .*checksum"):
        sixfold.Templates.load(file)
    with pytest.raises(FileNotFoundError):
        sixfold.Templates.load(tmp_path / "none")
    with pytest.raises(OSError):
        templates.save(tmp_path / "no/such/folder")


def test_a_mesh_is_found(templates, thing, scene):
    depth, camera, mask, pose = scene
    known = sixfold.Mttm(templates, thing)
    assert known.has_mesh and len(known.templates) == 305
    [found] = sixfold.estimate_mttm(depth, known, camera)
    assert found.confidence > 0.5 and 0 <= found.template < 305
    assert sixfold.metrics.add(thing, found.camera_from_object, pose) < 0.05 * thing.diameter
    assert found.mask.dtype == bool and overlap(found.mask, mask) > 0.7
    assert 0 < found.verification["total"] <= 1
    # A prepared scene and a mesh as it is give the same.
    [same] = sixfold.estimate_mttm(sixfold.PpfScene(depth, camera), thing)
    assert (same.camera_from_object == found.camera_from_object).all()
    # Without the mesh the templates decide; nothing is there where the mask hides it.
    [alone] = sixfold.estimate_mttm(depth, templates, camera)
    assert sixfold.metrics.add(thing, alone.camera_from_object, pose) < 0.15 * thing.diameter
    hidden = np.where(mask, 0, depth)
    assert sixfold.estimate_mttm(hidden, known, camera, min_score=0.6) == []


@pytest.mark.parametrize("matcher", ["points", "network", "both"])
def test_who_matches(templates, thing, scene, matcher):
    depth, camera, mask, pose = scene
    known = sixfold.Mttm(templates, thing, matcher=matcher)
    assert known.matcher == matcher and matcher in repr(known)
    [found] = sixfold.estimate_mttm(depth, known, camera)
    assert sixfold.metrics.add(thing, found.camera_from_object, pose) < 0.02 * thing.diameter
    # Without the mesh too, which would put a wrong template right.
    [found] = sixfold.estimate_mttm(depth, sixfold.Mttm(templates, matcher=matcher), camera)
    assert sixfold.metrics.add(thing, found.camera_from_object, pose) < 0.1 * thing.diameter
    assert overlap(found.mask, mask) > 0.7


def test_another_network_and_what_it_keeps(templates, scene, mttm_weights, tmp_path):
    depth, camera, *_ = scene
    [shipped] = sixfold.estimate_mttm(depth, sixfold.Mttm(templates, matcher="network"), camera, min_score=0)
    # Another matcher is another way to the pose.
    [by_points] = sixfold.estimate_mttm(depth, sixfold.Mttm(templates, matcher="points"), camera, min_score=0)
    assert (by_points.camera_from_object != shipped.camera_from_object).any()
    kept = tmp_path / "thing.sixfold-descriptors"
    for cache in (None, kept, kept):
        read = sixfold.Mttm(templates, matcher="network", weights=mttm_weights, cache=cache)
        [same] = sixfold.estimate_mttm(depth, read, camera, min_score=0)
        assert read.cache_note is None and same.template == shipped.template
        assert (same.camera_from_object == shipped.camera_from_object).all()
    written = kept.read_bytes()
    kept.write_bytes(written[: len(written) // 2])
    read = sixfold.Mttm(templates, matcher="network", cache=str(kept))
    assert kept.name in read.cache_note and kept.read_bytes() == written
    read = sixfold.Mttm(templates, matcher="network", cache=tmp_path / "no/such/folder")
    assert "no/such/folder" in read.cache_note


def test_an_object_without_a_mesh(thing, scene):
    seen_depth, camera, seen_mask, seen_pose = scene_of(thing, 0.6, (-0.02, 0.01))
    depth, _, mask, pose = scene
    one = sixfold.Templates.from_depth([(seen_depth, camera, seen_mask)])
    assert len(one) == 1 and one.source == "depth"
    [found] = sixfold.estimate_mttm(depth, one, camera, min_score=0.2)
    assert overlap(found.mask, mask) > 0.6
    known = sixfold.Templates.from_depth([(seen_depth, camera, seen_mask, seen_pose)])
    assert known.source == "posed depth"
    [found] = sixfold.estimate_mttm(depth, known, camera, min_score=0.2)
    assert sixfold.metrics.translation_error(found.camera_from_object, pose) < 0.03
    assert not sixfold.Mttm(known).has_mesh


def grown(mask, pixels):
    """The mask with all pixels at most so many columns and rows from it."""
    padded = np.pad(mask, pixels)
    shifts = range(2 * pixels + 1)
    return np.any([padded[y:, x:][: mask.shape[0], : mask.shape[1]] for y in shifts for x in shifts], axis=0)


def test_masks_are_held_against_depth(thing):
    depth, camera, mask, _ = scene_of(thing, 0.6, (-0.02, 0.01))
    right = sixfold.Templates.from_depth([(depth, camera, mask)], check_masks=False).diameter
    with pytest.warns(UserWarning, match=r"views\[0\]: left out .* of the mask"):
        trimmed = sixfold.Templates.from_depth([(depth, camera, grown(mask, 5))])
    assert abs(trimmed.diameter / right - 1) < 0.04
    with pytest.raises(ValueError, match=r"views\[0\] \(check_masks=False.*cut it closer"):
        sixfold.Templates.from_depth([(depth, camera, grown(mask, 30))])
    large = sixfold.Templates.from_depth([(depth, camera, grown(mask, 30))], check_masks=False)
    assert large.diameter > 1.2 * right


def test_wrong_use(thing, templates, scene, weights, tmp_path):
    depth, camera, mask, pose = scene
    lens = sixfold.Camera(525, 525, 320, 240, 640, 480, distortion=(0.1, 0, 0, 0))
    for views, name in [
        ([], "views: no view"),
        ([depth], r"views\[0\]: expected a tuple"),
        ([(depth, camera)], r"views\[0\]: .*2 things"),
        ([(depth, camera, mask), (depth, camera, mask, pose)], "views: view 2"),
        ([(depth, camera, mask[:9])], "views: the mask is"),
        ([(depth, camera, np.zeros_like(mask))], "views: only 0"),
        ([(depth, camera, depth)], r"views\[0\]: mask: expected"),
        ([(depth, camera, mask), (1000 * depth.astype(np.uint16), camera, mask)], r"views\[1\]: depth: expected"),
        ([(1000 * depth, camera, mask)], "views: .*depth scale"),
        ([(depth[:9], camera, mask[:9])], "views: "),
        ([(depth, lens, mask)], "camera"),
        ([(depth, None, mask)], r"views\[0\]: "),
        ([(depth, camera, mask, np.eye(3))], "views: "),
    ]:
        with pytest.raises(ValueError, match=name):
            sixfold.Templates.from_depth(views)
    cloud = sixfold.Mesh(np.eye(3))
    for call, name in [
        (lambda: sixfold.Templates.from_mesh(cloud), "mesh"),
        (lambda: sixfold.Templates.from_mesh(thing, coverage="below"), "coverage"),
        (lambda: sixfold.Mttm("mug"), "templates"),
        (lambda: sixfold.Mttm(templates, 3), "mesh"),
        (lambda: sixfold.Mttm(templates, cloud), "mesh"),
        (lambda: sixfold.Mttm(templates, matcher="forest"), "matcher: expected .*points.*both.*, found"),
        (lambda: sixfold.Mttm(templates, matcher="points", weights="w.safetensors"), "weights"),
        (lambda: sixfold.Mttm(templates, matcher="points", cache="kept"), "cache"),
        (lambda: sixfold.Mttm(templates, weights=weights), "pix2pose-lmo.safetensors"),
        (lambda: sixfold.estimate_mttm(depth, templates), "camera"),
        (lambda: sixfold.estimate_mttm(depth, "mug", camera), "model"),
        (lambda: sixfold.estimate_mttm(depth, templates, camera, instances=0), "instances"),
        (lambda: sixfold.estimate_mttm(depth, templates, camera, min_score=2), "min_score"),
        (lambda: sixfold.estimate_mttm(1000 * depth, templates, camera), "depth"),
        (lambda: sixfold.estimate_mttm(depth, templates, camera, depth), "mask"),
        (lambda: sixfold.estimate_mttm(np.full_like(depth, np.nan), templates, camera), "depth"),
    ]:
        with pytest.raises(ValueError, match=name):
            call()
    with pytest.raises(FileNotFoundError, match="none.safetensors"):
        sixfold.Mttm(templates, weights=tmp_path / "none.safetensors")
    with pytest.raises(TypeError):
        sixfold.Mttm(templates, weights=3)
