"""Reads the run folders of segwild: cameras, splats, selections, masks, features and scores as numpy arrays.

    import segwild
    run = segwild.Run("runs/mine")
    statue = run.selection("statue")
    means = run.splats().means[statue.labels()]

Arrays of splats have the order of ``scene.ply``. Positions are in units and axes of the reconstruction less ``run.offset``.
Masks are ``[height, width]`` arrays of bool, in pixels of the photo as taken.
"""

from ._binary import find_binary
from .camera import Camera
from .coco import CocoMasks, decode_rle
from .errors import SegwildError
from .measures import boundary_iou, iou
from .objects import ObjectFolder, SceneObject
from .ply import Splats, read_ply
from .png import read_mask, read_png
from .run import (
    FeatureField,
    HeldOut,
    HeldOutScore,
    Photo,
    Run,
)
from .selection import Box, Click, PhotoPrompts, Selection

__all__ = [
    "Box",
    "Camera",
    "Click",
    "CocoMasks",
    "FeatureField",
    "HeldOut",
    "HeldOutScore",
    "ObjectFolder",
    "Photo",
    "PhotoPrompts",
    "Run",
    "SceneObject",
    "SegwildError",
    "Selection",
    "Splats",
    "boundary_iou",
    "decode_rle",
    "find_binary",
    "iou",
    "read_mask",
    "read_ply",
    "read_png",
]
