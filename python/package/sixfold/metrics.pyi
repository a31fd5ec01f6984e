from collections.abc import Sequence
from os import PathLike
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import Camera, Mesh
from .bop import Dataset, Estimate

Path = str | PathLike[str]
Model = Mesh | ArrayLike

def add(model: Model, estimate: ArrayLike, ground_truth: ArrayLike) -> float: ...
def adi(model: Model, estimate: ArrayLike, ground_truth: ArrayLike) -> float: ...
def mssd(model: Model, estimate: ArrayLike, ground_truth: ArrayLike, symmetries: ArrayLike | None = None) -> float: ...
def mspd(
    model: Model, estimate: ArrayLike, ground_truth: ArrayLike, camera: Camera, symmetries: ArrayLike | None = None
) -> float: ...
def projection_error(model: Model, estimate: ArrayLike, ground_truth: ArrayLike, camera: Camera) -> float: ...
def rotation_error(estimate: ArrayLike, ground_truth: ArrayLike, symmetries: ArrayLike | None = None) -> float: ...
def translation_error(estimate: ArrayLike, ground_truth: ArrayLike, symmetries: ArrayLike | None = None) -> float: ...
def vsd(
    mesh: Mesh,
    estimate: ArrayLike,
    ground_truth: ArrayLike,
    depth: ArrayLike,
    camera: Camera,
    *,
    taus: ArrayLike | None = None,
    delta: float = 0.015,
    diameter: float | None = None,
) -> NDArray[np.float64]: ...
def vsd_of_depth(
    depth_estimate: ArrayLike,
    depth_ground_truth: ArrayLike,
    depth: ArrayLike,
    camera: Camera,
    diameter: float,
    *,
    taus: ArrayLike | None = None,
    delta: float = 0.015,
) -> NDArray[np.float64]: ...
def average_precision(right: Sequence[bool], positives: int) -> float | None: ...
def area_under_accuracy(errors: Sequence[float], largest: float = 0.1) -> float | None: ...
def recall_below(errors: Sequence[float], threshold: float) -> float | None: ...
def bop19(
    dataset: Dataset | Path,
    results: Sequence[Estimate] | Path,
    *,
    split: str = "test",
    targets: Path | None = None,
    vsd: bool = True,
    visib_gt_min: float | None = None,
    models: Literal["eval", "rendering"] = "eval",
    curves: Path | None = None,
) -> dict[str, Any]: ...
def bop24(
    dataset: Dataset | Path,
    results: Sequence[Estimate] | Path,
    *,
    split: str = "test",
    targets: Path | None = None,
    visib_gt_min: float | None = None,
    models: Literal["eval", "rendering"] = "eval",
) -> dict[str, Any]: ...
