"""Records of segwild (docs/reference/formats.md#records)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ._files import AGAIN
from .errors import SegwildError

_MAGIC = b"\x89SGW\r\n\x1a\n"
_FORMAT = 1
_HASH = 32


def payload(path: Path, data: bytes, kind: str) -> memoryview:
    """The payload of a record of a kind.

    Its BLAKE3 hash is not compared, since Python's standard library has none: `segwild cache verify` does that.
    """

    def wrong(problem: str) -> SegwildError:
        return SegwildError(path, problem, AGAIN)

    if not data.startswith(_MAGIC) or len(data) < len(_MAGIC) + 3:
        raise wrong("it is no record of segwild")
    version = int.from_bytes(data[8:10], "little")
    if version != _FORMAT:
        raise wrong(f"it is a record of format {version}, and this package reads format {_FORMAT}")
    at = 11 + data[10]
    found = data[11:at].decode("latin-1")
    if found != kind:
        raise wrong(f"it holds `{found}` and not `{kind}`")
    length = int.from_bytes(data[at : at + 8], "little")
    start = at + 8 + _HASH
    if len(data) != start + length:
        raise wrong(f"it is cut short or too long: {len(data)} of {start + length} bytes")
    return memoryview(data)[start:]


def features_of(path: Path, data: bytes) -> NDArray[np.float32]:
    """The vectors of a feature field, ``[splats, channels]``: the first two fields of `features.bin`."""
    rest = payload(path, data, "features")
    channels, count = (int.from_bytes(rest[at : at + 8], "little") for at in (0, 8))
    if not channels or count % channels or len(rest) < 16 + 4 * count:
        raise SegwildError(path, f"it is damaged: {count} numbers of {channels} channels", AGAIN)
    return np.frombuffer(rest, "<f4", count, 16).reshape(-1, channels).astype(np.float32)
