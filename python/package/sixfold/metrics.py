"""Pose errors and scores: single errors in metres, pixels and radians, and whole result files as the BOP Challenge scores
them.
"""

from ._sixfold import metrics as _native

add = _native.add
adi = _native.adi
area_under_accuracy = _native.area_under_accuracy
average_precision = _native.average_precision
bop19 = _native.bop19
bop24 = _native.bop24
mspd = _native.mspd
mssd = _native.mssd
projection_error = _native.projection_error
recall_below = _native.recall_below
rotation_error = _native.rotation_error
translation_error = _native.translation_error
vsd = _native.vsd
vsd_of_depth = _native.vsd_of_depth

__all__ = [
    "add",
    "adi",
    "area_under_accuracy",
    "average_precision",
    "bop19",
    "bop24",
    "mspd",
    "mssd",
    "projection_error",
    "recall_below",
    "rotation_error",
    "translation_error",
    "vsd",
    "vsd_of_depth",
]
