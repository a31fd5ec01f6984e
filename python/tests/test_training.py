"""Trainings of a few steps: what they write, that they continue, that Ctrl-C keeps what was learnt."""

import inspect
import os
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest

import sixfold
from scenes import box_mesh


@pytest.fixture(scope="module")
def colored():
    """A mesh with colours, to be learnt from renders."""
    mesh = box_mesh()
    colors = np.random.default_rng(0).integers(0, 255, (len(mesh.vertices), 3), dtype=np.uint8)
    return sixfold.Mesh(mesh.vertices, mesh.faces, colors=colors)


SMALL = {"size": 64, "per_object": 1}


def test_pix2pose_learns_and_goes_on(demo, tmp_path):
    heard = []
    options = {"ids": [8], "frames": [(2, 3)], "progress": heard.append, **SMALL}
    trained = sixfold.train_pix2pose(demo, tmp_path / "whole", steps=2, **options)
    assert trained["steps"] == 2 and trained["seconds"] > 0 and trained["losses"]["coordinates"] > 0
    assert heard[0]["stage"] == "training" and heard[0]["done"] == heard[0]["total"] == 2
    assert heard[0]["learning_rate"] > 0 and "coordinates" in heard[0]["losses"]
    assert heard[-1]["stage"] == "measuring" and heard[-1]["done"] == heard[-1]["total"] == 1
    assert (tmp_path / "whole/training/curves.png").exists() and (tmp_path / "whole/model.md").exists()
    model = sixfold.Pix2Pose.load(trained["model"])
    assert [o["id"] for o in model.objects] == [8]
    assert model.card["training_frames"] == [{"scene_id": 2, "im_id": 3}]
    assert model.card["command"] == "sixfold.train_pix2pose"
    # Nothing is left to do: the same bytes again. Other options are another training.
    before = trained["model"].read_bytes()
    trained["model"].unlink()
    again = sixfold.train_pix2pose(str(demo), tmp_path / "whole", steps=2, **options)
    assert again["model"].read_bytes() == before
    with pytest.raises(ValueError, match="steps was 2, is 3"):
        sixfold.train_pix2pose(demo, tmp_path / "whole", steps=3, **options)


@pytest.mark.parametrize("method", ["pix2pose", "detector", "dgcm", "mttm", "nol"])
def test_defaults_are_those_of_the_recipes(method):
    """No number stands here: None is the recipe's default, which a test of the command line compares with the stub's."""
    parameters = inspect.signature(getattr(sixfold, f"train_{method}")).parameters
    defaults = {name: p.default for name, p in parameters.items() if p.default is not p.empty}
    assert not defaults.pop("renders_only", False)
    assert set(defaults.values()) == {None} and {"network", "steps", "seed"} <= set(defaults)


def test_an_error_of_the_callback_stops_and_keeps(colored, tmp_path):
    class Enough(Exception):
        pass

    def stop(news):
        raise Enough

    arguments = ({5: colored}, tmp_path / "out")
    with pytest.raises(Enough):
        sixfold.train_pix2pose(*arguments, steps=40, progress=stop, **SMALL)
    assert not (tmp_path / "out/model.safetensors").exists()
    heard = []
    trained = sixfold.train_pix2pose(*arguments, steps=40, progress=heard.append, **SMALL)
    # The log is written every 25 steps: the second call has only the rest of them to tell.
    assert [news["done"] for news in heard if news["stage"] == "training"] == [40]
    whole = sixfold.train_pix2pose({5: colored}, tmp_path / "whole", steps=40, **SMALL)
    assert trained["model"].read_bytes() == whole["model"].read_bytes()


def test_other_data_are_another_training(demo, colored, tmp_path):
    options = {"steps": 1, **SMALL}
    of = {"ids": [8], "frames": [(2, 3)]}
    trained = sixfold.train_pix2pose(demo, tmp_path, **of, **options)
    before = trained["model"].read_bytes()
    for other, words in [
        ({**of, "ids": [5]}, 'ids was "8", is "5"'),
        ({**of, "renders_only": True, "frames": None}, 'frames was "2/3", is "none"'),
        ({**of, "rotation": 0.1}, "rotation was"),
    ]:
        with pytest.raises(ValueError, match=words):
            sixfold.train_pix2pose(demo, tmp_path, **other, **options)
    with pytest.raises(ValueError, match="mesh of object 8 was"):
        sixfold.train_pix2pose({8: colored}, tmp_path, **options)
    with pytest.raises(ValueError, match="object 8 is named more than once"):
        sixfold.train_pix2pose(demo, tmp_path / "twice", ids=[8, 8], frames=[(2, 3)], **options)
    assert trained["model"].read_bytes() == before


def test_two_at_once_in_one_folder(colored, tmp_path):
    refused = []

    def again(news):
        with pytest.raises(ValueError, match="another process") as error:
            sixfold.train_pix2pose({5: colored}, tmp_path, steps=1, **SMALL)
        refused.append(error)

    sixfold.train_pix2pose({5: colored}, tmp_path, steps=1, progress=again, **SMALL)
    assert refused


def test_the_detector_learns(demo, tmp_path):
    dataset = sixfold.bop.Dataset(demo)
    trained = sixfold.train_detector(dataset, tmp_path, ids=[8, 9], frames=[(2, 3)], steps=2, batch=1, size=96)
    detector = sixfold.Detector.load(trained["model"])
    assert detector.object_ids == [8, 9] and trained["steps"] == 2 and "scores" in trained["losses"]
    assert detector(dataset.rgb(2, 3), threshold=0.9) == []


def test_grasp_and_view_networks_learn(tmp_path):
    heard = []
    trained = sixfold.train_dgcm(tmp_path / "dgcm", steps=2, pairs=2, views=64, progress=heard.append)
    stages = [news["stage"] for news in heard]
    assert list(dict.fromkeys(stages)) == ["preparing", "training", "measuring"]
    quality = trained["quality"]
    assert quality["pairs"] == 8 and 0 < quality["coordinates"] < 2 and quality["families"]
    assert "dgcm-compact" in sixfold.DgcmNet.load(trained["model"]).fingerprint
    assert trained["model"] == tmp_path / "dgcm/model.safetensors"


def test_the_network_for_templates_learns(colored, tmp_path):
    heard = []
    options = {"steps": 2, "anchors": 4, "objects": 16, "scenes": 4}
    trained = sixfold.train_mttm(tmp_path, progress=heard.append, **options)
    stages = [news["stage"] for news in heard]
    assert list(dict.fromkeys(stages)) == ["preparing", "training", "measuring"]
    assert heard[0]["total"] == heard[-1]["total"] == heard[-1]["done"] == 8
    assert trained["steps"] == 2 and trained["losses"]["mask"] > 0 and (tmp_path / "samples.png").exists()
    quality = trained["quality"]
    assert quality["regions"] >= 40 and 0 <= quality["nearest"] <= 1 and len(quality["rotation"]) == 2
    known = sixfold.Mttm(colored, weights=trained["model"])
    assert known.matcher == "both" and known.has_mesh
    # It describes templates otherwise than the network within the package: kept descriptors of one do not fit the other.
    kept = tmp_path / "kept"
    sixfold.Mttm(colored, weights=trained["model"], cache=kept)
    of_this = kept.read_bytes()
    assert (
        sixfold.Mttm(colored, weights=trained["model"], cache=kept).cache_note is None and kept.read_bytes() == of_this
    )
    sixfold.Mttm(colored, cache=kept)
    assert kept.read_bytes() != of_this
    # Going on where nothing is left to do gives the same file; other options are another training.
    before = trained["model"].read_bytes()
    trained["model"].unlink()
    assert sixfold.train_mttm(tmp_path, **options)["model"].read_bytes() == before
    with pytest.raises(ValueError, match="batch.anchors was 4, is 5"):
        sixfold.train_mttm(tmp_path, **{**options, "anchors": 5})


@pytest.mark.skipif(os.name == "nt", reason="signals are sent otherwise on Windows")
def test_ctrl_c_keeps_what_was_learnt(tmp_path):
    script = textwrap.dedent(
        f"""
        import signal
        import sixfold
        signal.signal(signal.SIGINT, signal.default_int_handler)
        mesh = sixfold.Mesh([[0, 0, 0], [0.1, 0, 0], [0, 0.06, 0], [0, 0, 0.04]]).convex_hull()
        print("ready", flush=True)
        try:
            sixfold.train_pix2pose({{1: mesh}}, {str(tmp_path)!r}, steps=100000, size=64, per_object=1, mesh_colors=False)
        except KeyboardInterrupt:
            print("interrupted", flush=True)
        """
    )
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline().strip() == "ready"
        folder = tmp_path / "training"
        for _ in range(600):
            if folder.exists() and any(folder.iterdir()):
                break
            time.sleep(0.1)
        time.sleep(2.0)
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=120)
    finally:
        process.kill()
    assert "interrupted" in out
    # A checkpoint of where it stopped.
    assert max(int(file.stem.split("-")[1].split(".")[0]) for file in folder.glob("step-*")) > 0


def test_wrong_use(demo, colored, weights, tmp_path):
    out = tmp_path / "out"
    file = tmp_path / "file"
    file.write_text("no folder")
    for call, name in [
        (lambda: sixfold.train_pix2pose(3, out), "material"),
        (lambda: sixfold.train_pix2pose({}, out), "material"),
        (lambda: sixfold.train_pix2pose({1: colored}, out, ids=[1]), "ids"),
        (lambda: sixfold.train_pix2pose(demo, out, ids=[1.5]), "ids"),
        (lambda: sixfold.train_pix2pose(demo, out, frames=[1, 2]), "frames"),
        (lambda: sixfold.train_pix2pose(demo, out, frames=[(2, -3)]), "frames"),
        (lambda: sixfold.train_pix2pose(demo, out, frames=[(2, 3)], renders_only=True), "frames"),
        (lambda: sixfold.train_pix2pose(demo, out, frames=[]), "frames"),
        (lambda: sixfold.train_pix2pose({1: colored}, out, steps=0), "steps"),
        (lambda: sixfold.train_pix2pose({1: colored}, out, per_object=0), "per_object"),
        (lambda: sixfold.train_pix2pose({1: colored}, out, learning_rate=-1), "learning_rate"),
        (lambda: sixfold.train_pix2pose({1: colored}, out, learning_rate=np.nan), "learning_rate"),
        (lambda: sixfold.train_pix2pose({1: colored}, out, size=50), "size"),
        (lambda: sixfold.train_pix2pose({1: colored}, out, rotation=7), "rotation"),
        (lambda: sixfold.train_pix2pose({1: colored}, out, render_fraction=2), "render_fraction"),
        (lambda: sixfold.train_pix2pose({1: colored}, out, network="big"), "network"),
        (lambda: sixfold.train_pix2pose({1: colored}, out, network="paper", size=64), "network"),
        (lambda: sixfold.train_pix2pose({3: colored}, out, init=weights), "object 3"),
        (lambda: sixfold.train_pix2pose({1: sixfold.Mesh(np.eye(3))}, out), "no faces"),
        (lambda: sixfold.train_pix2pose({1: colored}, out, seed=-1), "seed"),
        (lambda: sixfold.train_detector({1: colored}, out, threshold=2), "threshold"),
        (lambda: sixfold.train_detector({1: colored}, out, encoder=weights), "encoder"),
        (lambda: sixfold.train_detector({1: colored}, out, batch=0), "batch"),
        (lambda: sixfold.train_detector({1: colored}, out, backbone="lite0"), "backbone"),
        (lambda: sixfold.train_detector({1: colored}, out, network="mask-rcnn", backbone="vgg"), "backbone"),
        (lambda: sixfold.train_detector({1: colored}, out, network="mask-rcnn", backbone="lite0", encoder=weights), "encoder"),
        (lambda: sixfold.train_detector({1: colored}, out, size=50), "size"),
        (lambda: sixfold.train_dgcm(out, views=3), "views"),
        (lambda: sixfold.train_dgcm(out, encoder=weights), "encoder"),
        (lambda: sixfold.train_dgcm(out, lambda_=0), "lambda_"),
        (lambda: sixfold.train_mttm(out, network="big"), "network"),
        (lambda: sixfold.train_mttm(out, steps=0), "steps"),
        (lambda: sixfold.train_mttm(out, anchors=1), "anchors"),
        (lambda: sixfold.train_mttm(out, objects=5), "objects"),
        (lambda: sixfold.train_mttm(out, objects=10**9), "objects"),
        (lambda: sixfold.train_mttm(out, scenes=3), "scenes"),
        (lambda: sixfold.train_mttm(out, learning_rate=np.inf), "learning_rate"),
        (lambda: sixfold.train_mttm(out, encoder=weights), "encoder"),
        (lambda: sixfold.train_mttm(out, seed=-1), "seed"),
        (lambda: sixfold.train_nol(out, network="big"), "network"),
        (lambda: sixfold.train_nol(out, encoder=weights), "encoder"),
        (lambda: sixfold.train_nol(out, steps=-1), "steps"),
    ]:
        with pytest.raises(ValueError, match=name):
            call()
    for call in [
        lambda: sixfold.train_pix2pose(tmp_path / "none", out),
        lambda: sixfold.train_pix2pose(demo, out, ids=[99]),
        lambda: sixfold.train_pix2pose({1: colored}, out, init=tmp_path / "none.safetensors"),
        lambda: sixfold.train_pix2pose({1: colored}, out, backgrounds=tmp_path / "none"),
        lambda: sixfold.train_nol(out, backgrounds=tmp_path / "none"),
        lambda: sixfold.train_pix2pose({1: colored}, file / "below", steps=1, **SMALL),
    ]:
        with pytest.raises(OSError):
            call()
    assert not out.exists()
