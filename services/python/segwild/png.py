"""PNG images by the standard library alone: grey of 1 to 8 bits, and colours of 8 bits, as segwild writes them."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ._files import read_file
from .errors import SegwildError

#: Most pixels of an image, as in segwild itself.
PIXEL_LIMIT = 200_000_000
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
#: Samples per pixel by colour type: grey, RGB, grey with alpha, RGB with alpha.
_SAMPLES = {0: 1, 2: 3, 4: 2, 6: 4}
_REMEDY = "write it again, as an 8-bit grey PNG without interlacing"


class _PngFault(Exception):
    """What is wrong with an image."""


def read_png(path: str | os.PathLike[str]) -> NDArray[np.uint8]:
    """An image: ``[height, width]`` of grey, ``[height, width, samples]`` of colours, 0 to 255.

    Raises:
        SegwildError: When the file is damaged, or of a kind that segwild does not write.
    """
    path = Path(path)
    return _decoded(path, read_file(path, _REMEDY))


def read_mask(path: str | os.PathLike[str]) -> NDArray[np.bool_]:
    """A mask ``[height, width]``: white is true.

    Raises:
        SegwildError: When the file is damaged, or has colours.
    """
    path = Path(path)
    return mask_of(path, read_file(path, _REMEDY))


def mask_of(path: Path, data: bytes) -> NDArray[np.bool_]:
    """The same of the bytes of a file."""
    image = _decoded(path, data)
    if image.ndim != 2:
        raise SegwildError(path, "it has colours and is no mask", _REMEDY)
    mask: NDArray[np.bool_] = image > 127
    return mask


def _decoded(path: Path, data: bytes) -> NDArray[np.uint8]:
    try:
        return _decode(data)
    except _PngFault as fault:
        raise SegwildError(path, str(fault), _REMEDY) from None


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = len(_SIGNATURE)
    while True:
        length = int.from_bytes(data[at : at + 4], "big")
        kind, end = data[at + 4 : at + 8], at + 12 + length
        if len(kind) < 4 or end > len(data):
            raise _PngFault("it is cut short")
        content = data[at + 8 : end - 4]
        if zlib.crc32(content, zlib.crc32(kind)) != int.from_bytes(data[end - 4 : end], "big"):
            raise _PngFault("it is damaged: a check sum does not fit")
        if kind == b"IEND":
            return
        yield kind, content
        at = end


def _decode(data: bytes) -> NDArray[np.uint8]:
    if not data.startswith(_SIGNATURE):
        raise _PngFault("it is no PNG")
    head, packed = b"", []
    for kind, content in _chunks(data):
        if kind == b"IHDR":
            head = content
        elif kind == b"IDAT":
            packed.append(content)
        elif kind[0] & 0x20 == 0 and kind != b"PLTE":
            raise _PngFault(f"it needs the chunk {kind!r}, which is not read here")
    if len(head) != 13:
        raise _PngFault("it has no header")
    width, height = int.from_bytes(head[:4], "big"), int.from_bytes(head[4:8], "big")
    depth, colour, compression, filtering, interlacing = head[8:]
    samples = _SAMPLES.get(colour, 0)
    if samples == 0 or depth not in ((1, 2, 4, 8) if colour == 0 else (8,)) or interlacing:
        raise _PngFault("palettes, 16 bits and interlacing are not read here")
    if compression or filtering or not width or not height or width * height > PIXEL_LIMIT:
        raise _PngFault(f"its header is damaged, or it has more than {PIXEL_LIMIT} pixels")
    stride = (width * samples * depth + 7) // 8
    size = height * (1 + stride)
    inflate = zlib.decompressobj()
    try:
        # Never more than the header's size, whatever the stream would become.
        raw = inflate.decompress(b"".join(packed), size + 1)
    except zlib.error as error:
        raise _PngFault(f"it is damaged: {error}") from None
    if len(raw) != size:
        raise _PngFault("its pixels do not fit its size")
    rows = np.frombuffer(raw, np.uint8).reshape(height, 1 + stride)
    pixels = _unfiltered(rows[:, 0], rows[:, 1:], max(1, samples * depth // 8))
    if depth < 8:
        pixels = _unpacked(pixels, width, depth)
    return pixels if samples == 1 else pixels.reshape(height, width, samples)


def _unpacked(rows: NDArray[np.uint8], width: int, depth: int) -> NDArray[np.uint8]:
    """Samples of fewer than 8 bits, spread over 0 to 255."""
    shifts = np.arange(8 - depth, -1, -depth, dtype=np.uint8)
    top = (1 << depth) - 1
    samples = (rows[:, :, None] >> shifts) & np.uint8(top)
    spread: NDArray[np.uint8] = samples.reshape(len(rows), -1)[:, :width] * np.uint8(255 // top)
    return spread


def _unfiltered(filters: NDArray[np.uint8], rows: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
    """Undoes the filters of rows; ``step`` is the bytes of a pixel. Sums wrap at 256, as bytes do."""
    out = np.zeros((len(rows) + 1, rows.shape[1]), np.uint8)
    for y, kind in enumerate(filters.tolist()):
        row, above = rows[y], out[y]
        if kind == 0:
            out[y + 1] = row
        elif kind == 1:
            for k in range(step):
                out[y + 1, k::step] = np.cumsum(row[k::step], dtype=np.uint8)
        elif kind == 2:
            out[y + 1] = row + above
        elif kind == 3:
            out[y + 1] = _averaged(row.tolist(), above.tolist(), step)
        elif kind == 4:
            # Where a row and the one above are empty, as most of a mask's are, nothing is predicted.
            if row.any() or above.any():
                out[y + 1] = _paeth(row.tolist(), above.tolist(), step)
        else:
            raise _PngFault(f"it is damaged: there is no filter {kind}")
    return out[1:]


def _averaged(row: list[int], above: list[int], step: int) -> list[int]:
    before = [0] * step
    for i, value in enumerate(row):
        before.append((value + (before[i] + above[i]) // 2) & 255)
    return before[step:]


def _paeth(row: list[int], above: list[int], step: int) -> list[int]:
    before, corner = [0] * step, [0] * step + above
    for i, value in enumerate(row):
        a, b, c = before[i], above[i], corner[i]
        pa, pb, pc = abs(b - c), abs(a - c), abs(a + b - c - c)
        nearest = a if pa <= pb and pa <= pc else b if pb <= pc else c
        before.append((value + nearest) & 255)
    return before[step:]
