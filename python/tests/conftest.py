"""What the tests share: a camera, meshes made here, a pose, and the sample data where it is at hand."""

import pathlib

import pytest

import sixfold
from scenes import box_mesh, bumpy_mesh, posed

ROOT = pathlib.Path(__file__).resolve().parents[2]


@pytest.fixture
def camera():
    return sixfold.Camera(572.4, 573.6, 325.3, 242.0, 640, 480)


@pytest.fixture
def box():
    return box_mesh()


@pytest.fixture(scope="session")
def bumpy():
    return bumpy_mesh()


@pytest.fixture
def pose():
    return posed((0.02, -0.03, 0.7), (0.6, -0.4, 0.3))


def at_hand(name, what):
    """A file or folder of the repository; without it the test is skipped."""
    path = ROOT / name
    if not path.exists():
        pytest.skip(f"the repository's {what} are not at hand")
    return path


@pytest.fixture(scope="session")
def demo():
    """The sample dataset of the repository."""
    return at_hand("data/demo", "sample data")


@pytest.fixture(scope="session")
def weights():
    return at_hand("weights/pix2pose-lmo.safetensors", "weights")


@pytest.fixture(scope="session")
def dgcm_weights():
    return at_hand("weights/dgcm.safetensors", "weights")


@pytest.fixture(scope="session")
def detector_weights():
    return at_hand("weights/detector-lmo.safetensors", "weights")


@pytest.fixture(scope="session")
def mttm_weights():
    return at_hand("crates/sixfold-mttm/weights/mttm-compact.safetensors", "weights")
