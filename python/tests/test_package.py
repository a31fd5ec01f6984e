"""The package as a whole: stubs and code name the same things, examples in docstrings run, Ctrl-C works, threads do too."""

import ast
import concurrent.futures
import doctest
import inspect
import os
import pathlib
import signal
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest

import sixfold

PACKAGE = pathlib.Path(sixfold.__file__).parent
MODULES = {"__init__": sixfold, "metrics": sixfold.metrics, "bop": sixfold.bop, "coco": sixfold.coco}


def public(module):
    names = [n for n in module.__all__ if n not in MODULES]
    return {n: getattr(module, n) for n in names}


def members(cls):
    return {n for n, m in vars(cls).items() if not n.startswith("_") and not isinstance(m, int)}


@pytest.mark.parametrize("name", MODULES)
def test_stubs_name_what_is_there(name):
    tree = ast.parse((PACKAGE / f"{name}.pyi").read_text())
    stubs = {n.name: n for n in tree.body if isinstance(n, (ast.FunctionDef, ast.ClassDef))}
    assert set(stubs) == set(public(MODULES[name]))
    for thing, value in public(MODULES[name]).items():
        stub = stubs[thing]
        if isinstance(stub, ast.FunctionDef):
            arguments = stub.args
            named = [a.arg for a in arguments.posonlyargs + arguments.args + arguments.kwonlyargs]
            assert named == list(inspect.signature(value).parameters), thing
        elif value is not sixfold.NoSolutionError:
            listed = {n.name for n in stub.body if isinstance(n, ast.FunctionDef) and not n.name.startswith("_")}
            assert listed == members(value), thing
    assert (PACKAGE / "py.typed").exists()


@pytest.mark.parametrize("name", MODULES)
def test_everything_is_documented_and_examples_run(name):
    module = MODULES[name]
    for thing, value in public(module).items():
        assert inspect.getdoc(value), thing
        # What only calls return is shown by their examples.
        returned = inspect.isclass(value) and "__new__" not in vars(value) and "load" not in vars(value)
        assert returned or value is sixfold.NoSolutionError or ">>> " in inspect.getdoc(value), thing
        if inspect.isclass(value):
            for member in members(value):
                assert inspect.getdoc(getattr(value, member)), f"{thing}.{member}"
    names = {**vars(sixfold), **{n: getattr(module, n) for n in module.__all__}}
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    for thing, value in public(module).items():
        for text in [value] + ([getattr(value, m) for m in members(value)] if inspect.isclass(value) else []):
            doc = inspect.getdoc(text) or ""
            test = doctest.DocTestParser().get_doctest(doc, dict(names), thing, None, 0)
            runner.run(test)
    assert runner.summarize(verbose=False).failed == 0


@pytest.mark.skipif(os.name == "nt", reason="signals are sent otherwise on Windows")
@pytest.mark.parametrize(
    "work",
    [
        "sixfold.Mesh(points, faces).simplify(100)",
        "sixfold.pnp_ransac(points[:5000], pixels[:5000], camera, threshold_px=1e-3, max_iterations=2**40, min_iterations=2**40)",
    ],
)
def test_ctrl_c_is_heard(work):
    script = textwrap.dedent(
        f"""
        import signal
        import numpy as np
        import sixfold
        # A shell in the background has its children ignore Ctrl-C.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        rng = np.random.default_rng(0)
        side = 900
        x, y = np.meshgrid(np.arange(side), np.arange(side))
        points = np.stack([x, y, 5 * rng.random((side, side))], -1).reshape(-1, 3) * 1e-3
        a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
        faces = np.concatenate([np.stack([a, a + 1, a + side], 1), np.stack([a + 1, a + side + 1, a + side], 1)])
        pixels = rng.uniform(0, 480, (len(points), 2))
        camera = sixfold.Camera(500, 500, 320, 240, 640, 480)
        print("ready", flush=True)
        try:
            {work}
            print("finished")
        except KeyboardInterrupt:
            print("interrupted", flush=True)
            import os
            os._exit(0)
        """
    )
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline().strip() == "ready"
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=120)
    finally:
        process.kill()
    assert "interrupted" in out


def test_other_threads_run_meanwhile(camera, bumpy, pose):
    ticks, stop = [], threading.Event()

    def tick():
        while not stop.is_set():
            ticks.append(time.perf_counter())
            time.sleep(0.001)

    thread = threading.Thread(target=tick)
    thread.start()
    begin = time.perf_counter()
    sixfold.PpfModel(bumpy, sampling_step=0.03)
    end = time.perf_counter()
    stop.set()
    thread.join()
    during = [t for t in ticks if begin < t < end]
    assert len(during) > 5


def test_calls_from_many_threads_agree(camera, bumpy, pose):
    expected = sixfold.render(bumpy, pose, camera).depth
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        for drawn in pool.map(lambda _: sixfold.render(bumpy, pose, camera), range(32)):
            assert (drawn.depth == expected).all()


def test_arrays_may_be_changed_while_others_read(camera):
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (20000, 3))
    pixels = camera.project(points + [0, 0, 1])
    stop = threading.Event()

    def write():
        while not stop.is_set():
            points[:] += 0.0

    thread = threading.Thread(target=write)
    thread.start()
    for _ in range(5):
        assert sixfold.pnp_ransac(points, pixels, camera).inlier_count > 19000
    stop.set()
    thread.join()
