"""Faults put into what the package writes: killed and run again, twice at once, a folder that is none, a disk that is full."""

import json
import os
import pathlib
import subprocess
import sys
import textwrap
import time

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]

pytestmark = pytest.mark.skipif(os.name == "nt", reason="processes are killed otherwise on Windows")

# What each writes, in a process of its own, into the folder `out`.
WRITERS = {
    "training": """
        sixfold.train_dgcm(out / "dgcm", steps=3, pairs=2, views=64)
    """,
    "dataset": """
        sixfold.Estimator("ppf").run_dataset(DEMO, out / "results.csv", cache=out.parent / "cache")
    """,
    "store": """
        network = sixfold.DgcmNet.load(ROOT / "weights/dgcm.safetensors")
        sys.path.insert(0, str(ROOT / "python/tests"))
        from scenes import box_mesh, posed
        camera = sixfold.Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
        view = posed((0.0, 0.05, 0.75), (2.5, 0.0, 0.0))
        scene = [(box_mesh((1.2, 1.2, 0.02)), view @ posed((0, 0, -0.01), (0, 0, 0)))]
        scene.append((box_mesh((0.05, 0.16, 0.06)), view @ posed((0.02, -0.01, 0.03), (0, 0, 0.4))))
        drawn = sixfold.render_scene(scene, camera)
        seen = (drawn.depth, camera, drawn.masks[1])
        store = sixfold.ExperienceStore(out / "experience.db", network)
        for number, grasp in enumerate(sixfold.propose_grasps(*seen, gripper="jaws-85")[:3]):
            store.add(*seen, grasp, object=f"box {number}", gripper="jaws-85")
        assert len(store) >= 1
    """,
    "results": """
        estimates = [sixfold.bop.Estimate(2, image, 1, 0.5, sixfold.pose_exp([0] * 6), 0.1) for image in range(20000)]
        sixfold.bop.write_results(out / "results.csv", estimates)
    """,
}
CLOCK = ("second", "time", "created")


def start(name, out, **options):
    head = f"""
        import pathlib
        import sys
        import sixfold
        ROOT, DEMO, out = (pathlib.Path(p) for p in ({str(ROOT)!r}, {str(ROOT / "data/demo")!r}, {str(out)!r}))
    """
    script = textwrap.dedent(head) + textwrap.dedent(WRITERS[name])
    return subprocess.Popen([sys.executable, "-c", script], stderr=subprocess.PIPE, text=True, **options)


def finish(process):
    _, message = process.communicate(timeout=300)
    return process.returncode, message


def timeless(value):
    """A value of a JSON file without what a clock measured."""
    if isinstance(value, dict):
        return {k: timeless(v) for k, v in value.items() if not any(word in k for word in CLOCK)}
    return [timeless(v) for v in value] if isinstance(value, list) else value


def tree(folder):
    """The files below a folder, comparable between runs."""
    held = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        name = str(path.relative_to(folder))
        if path.suffix == ".db":
            import sixfold

            network = sixfold.DgcmNet.load(ROOT / "weights/dgcm.safetensors")
            lines = sixfold.ExperienceStore(path, network).list()
            held[name] = sorted(line["object"] for line in lines)
        elif path.suffix == ".json":
            held[name] = timeless(json.loads(path.read_text()))
        elif path.suffix == ".jsonl":
            held[name] = [timeless(json.loads(line)) for line in path.read_text().splitlines()]
        elif path.suffix == ".csv":
            held[name] = [line.rsplit(",", 1)[0] for line in path.read_text().splitlines()]
        elif path.suffix == ".checkpoint":
            # Holds parameters under random names and the time; the model that comes of it is compared.
            held[name] = None
        elif path.name == "curves.png":
            # Shows how many samples a second were learnt from.
            held[name] = path.read_bytes()[:8]
        else:
            held[name] = path.read_bytes()
    hidden = [name for name in held if pathlib.Path(name).name.startswith(".") or name.endswith((".tmp", ".lock"))]
    assert not hidden, hidden
    return held


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What an undisturbed run of a writer leaves, and how long it takes."""
    known = {}

    def of(name):
        if not (ROOT / "weights/dgcm.safetensors").exists() or not (ROOT / "data/demo").exists():
            pytest.skip("the repository's weights and sample data are not at hand")
        if name not in known:
            out = tmp_path_factory.mktemp("whole") / "out"
            out.mkdir()
            began = time.monotonic()
            code, message = finish(start(name, out))
            assert code == 0, message
            known[name] = (tree(out), time.monotonic() - began)
        return known[name]

    return of


@pytest.mark.parametrize("name", WRITERS)
def test_a_killed_process_is_made_up_for_by_the_next(name, whole, tmp_path):
    expected, seconds = whole(name)
    for number, fraction in enumerate((0.4, 0.7, 0.95)):
        out = tmp_path / str(number) / "out"
        out.mkdir(parents=True)
        process = start(name, out)
        time.sleep(fraction * seconds)
        process.kill()
        process.communicate()
        code, message = finish(start(name, out))
        assert code == 0, message
        assert tree(out) == expected, fraction


@pytest.mark.parametrize("name", WRITERS)
def test_two_processes_at_once_harm_nothing(name, whole, tmp_path):
    expected, _ = whole(name)
    out = tmp_path / "out"
    out.mkdir()
    ends = [finish(process) for process in [start(name, out), start(name, out)]]
    assert any(code == 0 for code, _ in ends), ends
    assert all(code == 0 or "another process" in message for code, message in ends), ends
    assert tree(out) == expected


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_in_place_of_the_folder_is_named(name, whole, tmp_path):
    whole(name)
    out = tmp_path / "out"
    out.write_text("no folder")
    code, message = finish(start(name, out))
    assert code == 1 and str(out) in message and "panicked" not in message and "PanicException" not in message, message
    assert out.read_text() == "no folder"
