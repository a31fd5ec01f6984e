from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .bop import Dataset

Path = str | PathLike[str]

def evaluate(
    ground_truth: Path | Mapping[str, Any] | Mapping[int, Path | Mapping[str, Any]] | Dataset,
    detections: Path | Sequence[Mapping[str, Any]],
    iou_type: Literal["bbox", "segm"] = "bbox",
    *,
    images: Sequence[tuple[int, int]] | None = None,
) -> dict[str, float | None]: ...
def read_detections(
    path: Path, *, image_size: tuple[int, int] | None = None, lenient: bool = False
) -> list[dict[str, Any]]: ...
def write_detections(path: Path, detections: Sequence[Mapping[str, Any]]) -> None: ...
def encode_mask(mask: ArrayLike) -> dict[str, Any]: ...
def decode_mask(rle: Mapping[str, Any]) -> NDArray[np.bool_]: ...
