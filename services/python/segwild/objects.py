"""Objects of a scene that were found without a click."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ._files import Fields, Folder
from .coco import CocoMasks
from .errors import SegwildError
from .ply import Splats, splats_of

_REMEDY = "write it again with `segwild objects RUN --out FOLDER`"


@dataclass(frozen=True)
class SceneObject:
    """An object of the list."""

    #: 1 and up; the property ``object`` of ``labels.ply`` has it.
    number: int
    #: Empty where no person named it.
    name: str
    #: How many splats it has.
    splats: int
    #: Its share of the light that all photos see, 0 to 1.
    light: float
    #: Expected IoU with a thing that a person would click.
    expected_iou: float
    #: Photos that show it.
    photos: int
    #: The photo that shows it best, and a pixel (x, y) in it there, as taken, at full size.
    photo: str
    pixel: tuple[float, float]

    @property
    def label(self) -> str:
        """Its name, or its number where it has none: its files have it."""
        return self.name or f"object-{self.number}"


def list_of(file: Fields) -> tuple[SceneObject, ...]:
    """The objects of an `objects.json`."""
    found = []
    for o in file.objects("objects"):
        x, y = o.numbers("pixel", 2)
        found.append(
            SceneObject(
                number=o.count("number"),
                name=o.text("name"),
                splats=o.count("splats"),
                light=o.number("light"),
                expected_iou=o.number("expected_iou"),
                photos=o.count("photos"),
                photo=o.text("photo"),
                pixel=(x, y),
            )
        )
    return tuple(found)


class ObjectFolder:
    """The folder of `segwild objects RUN --out FOLDER`: all objects with their splats and masks."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Opens the folder.

        Raises:
            SegwildError: When it is none, or damaged.
        """
        self._folder = Folder(path)
        self.path = self._folder.path
        listed = Fields(self._folder.within("objects.json"), self._folder.json("objects.json", _REMEDY), _REMEDY)
        #: The objects, by their numbers.
        self.objects: tuple[SceneObject, ...] = list_of(listed)

    def labelled_scene(self) -> tuple[Splats, NDArray[np.uint8]]:
        """All splats of the scene, and for each the number of its object, 0 for none, ``[splats]``."""
        path = self._folder.within("labels.ply")
        splats = splats_of(path, self._folder.bytes("labels.ply", _REMEDY))
        numbers = splats.extra.get("object")
        if numbers is None or numbers.dtype != np.uint8:
            raise SegwildError(path, "it has no property `uchar object`", _REMEDY)
        return splats, numbers.astype(np.uint8)

    def labels(self) -> NDArray[np.uint8]:
        """The number of the object of each splat of ``scene.ply``, 0 for none, ``[splats]``."""
        return self.labelled_scene()[1]

    def masks(self) -> CocoMasks:
        """The masks of all objects on all photos."""
        return CocoMasks(self._folder.within("coco.json"))
