"""Splats in the layout of 3D Gaussian splatting (docs/reference/formats.md)."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ._files import read_file, read_start
from .errors import SegwildError

#: The constant spherical harmonic, ``1 / (2 sqrt(pi))``.
SH0 = 0.28209479177387814
#: Most bytes of a header.
_HEADER_LIMIT = 64 << 10
_REMEDY = "write it again with `segwild run` or `segwild bake`"
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2", "uint16": "<u2",
    "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4", "float32": "<f4", "double": "<f8",
    "float64": "<f8",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Splats:
    """Splats of a file; ``n`` is their number."""

    #: ``[n, 3]``, in units and axes of the reconstruction, less :attr:`offset`.
    means: NDArray[np.float32]
    #: Natural logarithms of the standard deviations, ``[n, 3]``, in units of the reconstruction.
    log_scales: NDArray[np.float32]
    #: Quaternions ``[n, 4]``, w first, as they stand in the file: of any length but 0.
    rotations: NDArray[np.float32]
    #: Logits of the opacities, ``[n]``.
    logits: NDArray[np.float32]
    #: Coefficients of the spherical harmonics, ``[n, (degree + 1)**2, 3]``; the last axis is red, green, blue.
    sh: NDArray[np.float32]
    #: The other properties of the file by their names, ``[n]`` each, such as ``label`` and ``object``.
    extra: dict[str, NDArray[np.generic]]
    #: Added to the means in double precision, it gives positions of the reconstruction, ``[3]``.
    offset: NDArray[np.float64]
    #: ``mip`` where a renderer has to lower opacities for its pixel filter, ``default`` where not; empty where unknown.
    render_mode: str

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return math.isqrt(self.sh.shape[1]) - 1

    @property
    def scales(self) -> NDArray[np.float32]:
        """Standard deviations, ``[n, 3]``."""
        return np.exp(self.log_scales)

    @property
    def opacities(self) -> NDArray[np.float32]:
        """Opacities, ``[n]``, 0 to 1."""
        # Without an overflow for a logit of any size.
        small = np.exp(-np.abs(self.logits))
        return (np.where(self.logits >= 0, 1.0, small) / (1.0 + small)).astype(np.float32)

    @property
    def colours(self) -> NDArray[np.float32]:
        """Colours without their view-dependent part, ``[n, 3]``, sRGB, 0 to 1."""
        colours: NDArray[np.float32] = np.clip(0.5 + np.float32(SH0) * self.sh[:, 0], 0.0, 1.0)
        return colours

    @property
    def rotation_matrices(self) -> NDArray[np.float32]:
        """Rotations from the splat's axes to the world's, ``[n, 3, 3]``."""
        w, x, y, z = (self.rotations / np.linalg.norm(self.rotations, axis=1, keepdims=True)).T
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        return np.moveaxis(np.array(rows, dtype=np.float32), 2, 0)


@dataclass(frozen=True)
class Header:
    """The header of a `.ply` of splats."""

    count: int
    dtype: np.dtype[np.void]
    comments: tuple[str, ...]
    #: Bytes of the header.
    size: int


def read_ply(path: str | os.PathLike[str]) -> Splats:
    """The splats of a binary `.ply`.

    Raises:
        SegwildError: When the file is damaged, or holds no splats in this layout.
    """
    path = Path(path)
    return splats_of(path, read_file(path, _REMEDY))


def splats_of(path: Path, data: bytes) -> Splats:
    """The same of the bytes of a file."""
    header = header_of(path, data, len(data))
    table = np.frombuffer(data, header.dtype, header.count, header.size)
    names = header.dtype.names or ()
    rest = sum(name.startswith("f_rest_") for name in names)
    ordered = {
        "means": ["x", "y", "z"],
        "dc": ["f_dc_0", "f_dc_1", "f_dc_2"],
        "rest": [f"f_rest_{k}" for k in range(rest)],
        "opacity": ["opacity"],
        "scales": ["scale_0", "scale_1", "scale_2"],
        "rotations": ["rot_0", "rot_1", "rot_2", "rot_3"],
    }
    missing = [name for group in ordered.values() for name in group if name not in names]
    if missing:
        raise SegwildError(path, f"it has no property `{missing[0]}` and holds no splats", _REMEDY)
    bands = rest // 3
    if rest % 3 or math.isqrt(bands + 1) ** 2 != bands + 1:
        raise SegwildError(path, f"{rest} f_rest properties are no whole degree of harmonics", _REMEDY)
    columns = {key: _columns(table, group) for key, group in ordered.items()}
    # The file has all coefficients of red, then of green, then of blue.
    sh = np.empty((header.count, bands + 1, 3), np.float32)
    sh[:, 0] = columns["dc"]
    sh[:, 1:] = columns["rest"].reshape(header.count, 3, bands).transpose(0, 2, 1)
    known = {name for group in ordered.values() for name in group} | {"nx", "ny", "nz"}
    return Splats(
        means=columns["means"],
        log_scales=columns["scales"],
        rotations=columns["rotations"],
        logits=columns["opacity"][:, 0],
        sh=sh,
        extra={name: table[name].copy() for name in names if name not in known},
        offset=_offset(path, header.comments),
        render_mode=next((c.split(":", 1)[1].strip() for c in header.comments if c.startswith("SplatRenderMode:")), ""),
    )


def _columns(table: NDArray[np.void], names: list[str]) -> NDArray[np.float32]:
    out = np.empty((len(table), len(names)), np.float32)
    for k, name in enumerate(names):
        out[:, k] = table[name]
    return out


def _offset(path: Path, comments: tuple[str, ...]) -> NDArray[np.float64]:
    for comment in comments:
        if comment.startswith("offset "):
            try:
                offset = np.array([float(number) for number in comment.split()[1:]])
            except ValueError:
                offset = np.empty(0)
            if offset.shape != (3,) or not np.isfinite(offset).all():
                raise SegwildError(path, "the offset in its header is damaged", _REMEDY)
            return offset
    return np.zeros(3)


def splat_count(path: Path) -> int:
    """Splats of a file by its header alone, after checking that the file has as many bytes as it names."""
    start, size = read_start(path, _REMEDY, _HEADER_LIMIT)
    return header_of(path, start, size).count


def header_of(path: Path, data: bytes, length: int) -> Header:
    """The header, after checking that the file, which has `length` bytes, has as many as it names."""

    def wrong(problem: str) -> SegwildError:
        return SegwildError(path, problem, _REMEDY)

    end = data.find(b"end_header\n", 0, _HEADER_LIMIT)
    if not data.startswith(b"ply\n") or end < 0:
        raise wrong("it is no .ply, or its header is damaged")
    lines = data[:end].decode("latin-1").split("\n")[1:-1]
    if not lines or lines[0].split() != ["format", "binary_little_endian", "1.0"]:
        raise wrong("it is no binary little-endian .ply")
    count, fields, comments, elements = 0, [], [], 0
    for line in lines[1:]:
        words = line.split()
        if words[:1] in (["comment"], ["obj_info"]):
            comments.append(line.partition(" ")[2])
        elif words[:1] == ["element"] and len(words) == 3:
            elements += 1
            if elements == 1:
                if words[1] != "vertex" or not words[2].isascii() or not words[2].isdigit() or len(words[2]) > 12:
                    raise wrong("its first element is no list of vertices")
                count = int(words[2])
        elif words[:1] == ["property"] and len(words) == 3 and words[1] in _TYPES:
            if elements == 1:
                fields.append((words[2], _TYPES[words[1]]))
        elif elements > 1 and words[:2] == ["property", "list"]:
            # Of an element after the vertices, which is not read.
            continue
        else:
            raise wrong(f"the line {line[:80]!r} of its header is not read here")
    if elements == 0 or not fields:
        raise wrong("it has no vertices")
    if len({name for name, _ in fields}) != len(fields):
        raise wrong("two of its properties have one name")
    try:
        dtype = np.dtype(fields)
    except (ValueError, TypeError) as error:
        raise wrong(f"its properties are damaged: {error}") from None
    size = end + len(b"end_header\n")
    needed = size + count * dtype.itemsize
    if needed > length:
        raise wrong(f"it is cut short: {length} of {needed} bytes")
    return Header(count, dtype, tuple(comments), size)
