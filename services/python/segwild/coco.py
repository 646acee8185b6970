"""Masks of `coco.json`: COCO instance annotations with compressed run lengths."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ._files import JSON_LIMIT, Fields, parse_json, read_file
from .errors import SegwildError
from .png import PIXEL_LIMIT

_REMEDY = "write it again with `segwild objects RUN --out FOLDER`"


def decode_rle(counts: str | bytes, height: int, width: int) -> NDArray[np.bool_]:
    """A mask ``[height, width]`` of COCO's compressed run lengths, which go down the columns.

    Raises:
        ValueError: When the runs do not fill the size exactly.
    """
    size = height * width
    if height < 0 or width < 0 or size > PIXEL_LIMIT:
        raise ValueError(f"a mask of {height} x {width} pixels is larger than {PIXEL_LIMIT} pixels")
    text = counts.encode("ascii", "replace") if isinstance(counts, str) else counts
    runs: list[int] = []
    total, value, shift = 0, 0, 0
    for byte in text:
        group = byte - 48
        if not 0 <= group < 64:
            raise ValueError("the run lengths have an unknown sign")
        value |= (group & 0x1F) << shift
        shift += 5
        if group & 0x20:
            if shift > 60:
                raise ValueError("a run length is longer than any mask")
            continue
        if group & 0x10:
            value -= 1 << shift
        # From the fourth on it is the difference to the one before the last.
        run = value + (runs[-2] if len(runs) > 2 else 0)
        if not 0 <= run <= size - total:
            raise ValueError("the run lengths do not fit the mask's size")
        total += run
        runs.append(run)
        value, shift = 0, 0
    if shift or total != size:
        raise ValueError("the run lengths do not fit the mask's size")
    inside = np.arange(len(runs)) % 2 == 1
    return np.repeat(inside, runs).reshape(width, height).T


class CocoMasks:
    """The masks of objects on photos."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Reads a `coco.json`.

        Raises:
            SegwildError: When the file cannot be read or is damaged.
        """
        self.path = Path(path)
        text = read_file(self.path, _REMEDY, JSON_LIMIT)
        file = Fields(self.path, parse_json(self.path, text, _REMEDY), _REMEDY)
        images = {i.count("id"): (i.text("file_name"), i.count("height"), i.count("width")) for i in file.objects("images")}
        large = next((name for name, height, width in images.values() if height * width > PIXEL_LIMIT), None)
        if large is not None:
            raise self._wrong(f"the photo {large} has more than {PIXEL_LIMIT} pixels")
        names = {c.count("id"): c.text("name") for c in file.objects("categories")}
        #: Names of the photos, in the file's order.
        self.photos: tuple[str, ...] = tuple(name for name, _, _ in images.values())
        #: Names of the objects by their numbers.
        self.objects: dict[int, str] = names
        self._sizes = {name: (height, width) for name, height, width in images.values()}
        self._runs: dict[tuple[str, int], str] = {}
        for annotation in file.objects("annotations"):
            image, number = annotation.count("image_id"), annotation.count("category_id")
            if image not in images or number not in names:
                raise self._wrong(f"a mask is of image {image} and category {number}, which are not listed")
            name, height, width = images[image]
            runs = annotation.object("segmentation")
            if runs.numbers("size", 2) != (height, width):
                raise self._wrong(f"a mask of {name} has another size than the photo")
            self._runs[name, number] = runs.text("counts")

    def _wrong(self, problem: str) -> SegwildError:
        return SegwildError(self.path, f"it is damaged: {problem}", _REMEDY)

    def number(self, obj: int | str) -> int:
        """The number of an object, by its number or name.

        Raises:
            KeyError: When there is no such object.
        """
        for number, name in self.objects.items():
            if obj in (number, name):
                return number
        raise KeyError(f"there is no object {obj!r}: {', '.join(self.objects.values())}")

    def __iter__(self) -> Iterator[tuple[str, int]]:
        """The photo and the object's number of each mask."""
        return iter(self._runs)

    def __len__(self) -> int:
        return len(self._runs)

    def mask(self, photo: str, obj: int | str) -> NDArray[np.bool_]:
        """The mask of an object on a photo as taken, ``[height, width]``; empty where the photo does not show it.

        Raises:
            KeyError: When there is no such object or photo.
            SegwildError: When the mask is damaged.
        """
        number = self.number(obj)
        if photo not in self._sizes:
            raise KeyError(f"there is no photo {photo!r}")
        if (photo, number) not in self._runs:
            return np.zeros(self._sizes[photo], bool)
        try:
            return decode_rle(self._runs[photo, number], *self._sizes[photo])
        except ValueError as error:
            raise self._wrong(f"the mask of object {number} on {photo}: {error}") from None
