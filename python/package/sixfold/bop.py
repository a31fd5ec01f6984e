"""Datasets, result files and single images of the BOP format. The files hold millimetres; what is returned is in metres,
except where a name says ``mm``.
"""

from ._sixfold import bop as _native

Dataset = _native.Dataset
Estimate = _native.Estimate
ground_truth_visibility = _native.ground_truth_visibility
pose_from_mm = _native.pose_from_mm
pose_to_mm = _native.pose_to_mm
read_depth = _native.read_depth
read_mask = _native.read_mask
read_results = _native.read_results
read_rgb = _native.read_rgb
write_depth = _native.write_depth
write_mask = _native.write_mask
write_results = _native.write_results
write_rgb = _native.write_rgb

__all__ = [
    "Dataset",
    "Estimate",
    "ground_truth_visibility",
    "pose_from_mm",
    "pose_to_mm",
    "read_depth",
    "read_mask",
    "read_results",
    "read_rgb",
    "write_depth",
    "write_mask",
    "write_results",
    "write_rgb",
]
