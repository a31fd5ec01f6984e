"""Detections in COCO's JSON: reading, writing, masks as run lengths, and average precision as pycocotools computes it."""

from ._sixfold import coco as _native

decode_mask = _native.decode_mask
encode_mask = _native.encode_mask
evaluate = _native.evaluate
read_detections = _native.read_detections
write_detections = _native.write_detections

__all__ = [
    "decode_mask",
    "encode_mask",
    "evaluate",
    "read_detections",
    "write_detections",
]
