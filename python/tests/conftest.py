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


@pytest.fixture(scope="session")
def demo():
    """The sample dataset of the repository."""
    folder = ROOT / "data/demo"
    if not folder.is_dir():
        pytest.skip("the repository's sample data is not at hand")
    return folder


@pytest.fixture(scope="session")
def weights():
    file = ROOT / "weights/pix2pose-lmo.safetensors"
    if not file.is_file():
        pytest.skip("the repository's weights are not at hand")
    return file


@pytest.fixture(scope="session")
def detector_weights():
    file = ROOT / "weights/detector-lmo.safetensors"
    if not file.is_file():
        pytest.skip("the repository's weights are not at hand")
    return file
