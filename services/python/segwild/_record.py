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


#: Kinds of the records of feature fields: with numbers of 16 bits, and of 32 as earlier versions wrote them.
_FEATURES, _WIDE_FEATURES = "features/2", "features"


def payload(path: Path, data: bytes, kinds: tuple[str, ...]) -> tuple[str, memoryview]:
    """The kind and the payload of a record of one of these kinds, of which the first is the newest.

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
    if found not in kinds:
        raise wrong(f"it holds `{found}` and not `{kinds[0]}`")
    length = int.from_bytes(data[at : at + 8], "little")
    start = at + 8 + _HASH
    if len(data) != start + length:
        raise wrong(f"it is cut short or too long: {len(data)} of {start + length} bytes")
    return found, memoryview(data)[start:]


def features_of(path: Path, data: bytes) -> NDArray[np.float32]:
    """The vectors of a feature field, ``[splats, channels]``: what `features.bin` starts with."""
    kind, rest = payload(path, data, (_FEATURES, _WIDE_FEATURES))
    wide = kind == _WIDE_FEATURES
    # Numbers of 16 bits have a unit, in front of their count.
    count_at, size = (8, 4) if wide else (12, 2)
    start = count_at + 8
    channels, count = (int.from_bytes(rest[at : at + 8], "little") for at in (0, count_at))
    if not channels or count % channels or len(rest) < start + size * count:
        raise SegwildError(path, f"it is damaged: {count} numbers of {channels} channels", AGAIN)
    values = np.frombuffer(rest, "<f4" if wide else "<f2", count, start).reshape(-1, channels).astype(np.float32)
    if wide:
        return values
    unit = np.frombuffer(rest, "<f4", 1, 8)[0]
    # A power of two, so that the product is exact.
    if not (np.isfinite(unit) and unit > 0.0 and np.frexp(unit)[0] == 0.5) or not np.isfinite(values).all():
        raise SegwildError(path, "it is damaged: its numbers have no unit, or are not finite", AGAIN)
    with np.errstate(over="ignore", under="ignore"):
        values *= unit
    if not np.isfinite(values).all():
        raise SegwildError(path, "it is damaged: its numbers times their unit are not finite", AGAIN)
    return values
