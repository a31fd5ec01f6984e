"""Datasets, result files and single images of the BOP format. The files hold millimetres; what is returned is in metres,
except where a name says ``mm``.
"""

from ._sixfold import bop as _native

Dataset = _native.Dataset
Estimate = _native.Estimate
SceneWriter = _native.SceneWriter
ground_truth_visibility = _native.ground_truth_visibility
pose_from_mm = _native.pose_from_mm
pose_to_mm = _native.pose_to_mm
read_depth = _native.read_depth
read_mask = _native.read_mask
read_results = _native.read_results
read_rgb = _native.read_rgb
set_max_pixels = _native.set_max_pixels
write_camera = _native.write_camera
write_depth = _native.write_depth
write_mask = _native.write_mask
write_models = _native.write_models
write_results = _native.write_results
write_rgb = _native.write_rgb
write_targets = _native.write_targets

__all__ = [
    "Dataset",
    "Estimate",
    "SceneWriter",
    "ground_truth_visibility",
    "pose_from_mm",
    "pose_to_mm",
    "read_depth",
    "read_mask",
    "read_results",
    "read_rgb",
    "set_max_pixels",
    "write_camera",
    "write_depth",
    "write_mask",
    "write_models",
    "write_results",
    "write_rgb",
    "write_targets",
]
