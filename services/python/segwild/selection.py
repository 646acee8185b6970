"""Selections of a run: what clicks selected, as labels of splats and as masks of photos."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ._files import Fields, Folder
from .errors import SegwildError
from .ply import Splats, splats_of
from .png import mask_of

MaskKind = Literal["visible", "amodal", "prompted"]
_FOLDERS = {"visible": "masks", "amodal": "amodal", "prompted": "prompted"}


@dataclass(frozen=True)
class Click:
    """A click, in pixels of the photo as taken, at full size."""

    x: float
    y: float
    #: Whether it lies in the object.
    inside: bool


@dataclass(frozen=True)
class Box:
    """A box around the object, in the same pixels."""

    x0: float
    y0: float
    x1: float
    y1: float


@dataclass(frozen=True)
class PhotoPrompts:
    """The prompts on a photo."""

    photo: str
    clicks: tuple[Click, ...]
    boxes: tuple[Box, ...]
    #: 0 is the finest part under the clicks, 1 the largest object; `None` is automatic.
    granularity: float | None


class Selection:
    """A selection of a run; :meth:`segwild.Run.selection` opens it."""

    def __init__(self, folder: Folder, name: str, images: dict[str, str], splats: int) -> None:
        self._folder, self._images, self._splats = folder, images, splats
        #: Its name.
        self.name = name

    def _again(self) -> str:
        prompts = f"RUN/selections/{self.name}/prompts.json"
        return f"`segwild segment RUN --name {self.name} --prompts {prompts}` makes the selection again"

    def _file(self, name: str) -> str:
        return f"selections/{self.name}/{name}"

    def _ply(self, name: str) -> Splats:
        path = self._folder.within(self._file(name))
        return splats_of(path, self._folder.bytes(self._file(name), self._again()))

    def labels(self) -> NDArray[np.bool_]:
        """Whether each splat of ``scene.ply`` belongs to the object, ``[splats]``, after the spike cut.

        Raises:
            SegwildError: When the file is damaged, or the scene has been trained again since.
        """
        return self.labelled_scene()[1]

    def labelled_scene(self) -> tuple[Splats, NDArray[np.bool_]]:
        """All splats of the scene after the spike cut, which shortens some of them, with :meth:`labels`."""
        path = self._folder.within(self._file("labels.ply"))
        splats = self._ply("labels.ply")
        if "label" not in splats.extra:
            raise SegwildError(path, "it has no property `label`", self._again())
        if len(splats) != self._splats:
            problem = f"it has {len(splats)} splats and the scene {self._splats}: the scene was trained again since"
            raise SegwildError(path, problem, self._again())
        labels: NDArray[np.bool_] = splats.extra["label"] == 1
        return splats, labels

    def splats(self) -> Splats:
        """The object's splats alone, after the spike cut."""
        return self._ply("object.ply")

    def mask(self, photo: str, kind: MaskKind = "visible") -> NDArray[np.bool_]:
        """The object's mask on a photo as taken, ``[height, width]``.

        Args:
            photo: Name of the photo.
            kind: ``visible``: with the scene occluding the object. ``amodal``: what it would cover if nothing occluded it.
                ``prompted``: what the prompts on this photo were taken to mean; only prompted photos have it.

        Raises:
            KeyError: When the run has no such photo.
            SegwildError: When there is no such mask, or it is damaged.
        """
        name = self._file(f"{_FOLDERS[kind]}/{self._image(photo)}")
        path = self._folder.within(name)
        return mask_of(path, self._folder.bytes(name, self._again()))

    def _image(self, photo: str) -> str:
        if photo not in self._images:
            raise KeyError(f"the run has no photo {photo!r}")
        return self._images[photo]

    def masks(self, kind: MaskKind = "visible") -> Iterator[tuple[str, NDArray[np.bool_]]]:
        """The photos with their masks of a kind, one after the other: masks are large."""
        for photo, image in self._images.items():
            if self._folder.has(self._file(f"{_FOLDERS[kind]}/{image}")):
                yield photo, self.mask(photo, kind)

    @property
    def prompts(self) -> tuple[PhotoPrompts, ...]:
        """The prompts; none where an object of the list was selected."""
        path = self._folder.within(self._file("prompts.json"))
        value = self._folder.json(self._file("prompts.json"), self._again())
        # A bare list will do, as for the program.
        file = Fields(path, {"prompts": value} if isinstance(value, list) else value, self._again())
        found = []
        for p in file.objects("prompts"):
            clicks = tuple(Click(c.number("x"), c.number("y"), c.flag("inside")) for c in p.objects("points"))
            boxes = tuple(Box(*(b.number(side) for side in ("x0", "y0", "x1", "y1"))) for b in p.objects("boxes"))
            granularity = p.number("granularity") if p.has("granularity") else None
            found.append(PhotoPrompts(p.text("photo"), clicks, boxes, granularity))
        return tuple(found)

    @property
    def summary(self) -> dict[str, Any]:
        """`summary.json` as it is: provider, counts, agreement, alternatives, confidence, warnings, seconds."""
        name = self._file("summary.json")
        value = self._folder.json(name, self._again())
        if not isinstance(value, dict):
            raise SegwildError(self._folder.within(name), "it is damaged: an object is missing", self._again())
        return value
