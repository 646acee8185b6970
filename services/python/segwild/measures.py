"""Measures of masks, as `segwild eval` computes them (docs/method.md, section 10)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray


def _pair(a: ArrayLike, b: ArrayLike) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    one, other = np.asarray(a, dtype=bool), np.asarray(b, dtype=bool)
    if one.shape != other.shape:
        raise ValueError(f"masks of different shapes: {one.shape} and {other.shape}")
    return one, other


def iou(a: ArrayLike, b: ArrayLike) -> float:
    """Intersection over union of two masks, or of two arrays of labels; 1 where both are empty."""
    one, other = _pair(a, b)
    union = int(np.count_nonzero(one | other))
    return int(np.count_nonzero(one & other)) / union if union else 1.0


def boundary_iou(a: ArrayLike, b: ArrayLike, fraction: float = 0.02) -> float:
    """IoU of the pixels near the outlines of two masks ``[height, width]``.

    A pixel is near when it lies in the mask and at most ``fraction`` of the diagonal, in chessboard distance, from the outline.
    The frame's border counts as outline (Cheng et al., Boundary IoU, CVPR 2021).
    """
    one, other = _pair(a, b)
    if one.ndim != 2:
        raise ValueError(f"a mask has two dimensions, not {one.ndim}")
    width = max(1, math.floor(math.hypot(*one.shape) * fraction + 0.5))
    return iou(_boundary(one, width), _boundary(other, width))


def _boundary(mask: NDArray[np.bool_], width: int) -> NDArray[np.bool_]:
    inner = mask
    for axis in (0, 1):
        inner = _eroded(inner, width, axis)
    return mask & ~inner


def _eroded(mask: NDArray[np.bool_], width: int, axis: int) -> NDArray[np.bool_]:
    """What has `width` pixels of the mask on either side along an axis."""
    pad = [(0, 0), (0, 0)]
    pad[axis] = (width + 1, width)
    sums = np.cumsum(np.pad(mask, pad), axis=axis, dtype=np.int64)
    length, window = mask.shape[axis], 2 * width + 1
    after = np.take(sums, np.arange(window, window + length), axis=axis)
    before = np.take(sums, np.arange(length), axis=axis)
    eroded: NDArray[np.bool_] = after - before == window
    return eroded
