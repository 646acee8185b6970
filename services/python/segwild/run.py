"""A run folder."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ._files import AGAIN, Fields, Folder
from ._record import features_of
from .camera import Camera
from .errors import SegwildError
from .objects import SceneObject, list_of
from .ply import Splats, splat_count, splats_of
from .png import mask_of
from .selection import Selection

_MAKE = "take a folder that `segwild run SCENE --out FOLDER` made"
_HISTORY = ("step", "loss", "psnr", "splats", "left_out")


@dataclass(frozen=True, eq=False)
class Photo:
    """A photo of a run."""

    #: Its name in the scene.
    name: str
    #: Its camera, at the photo's full size.
    camera: Camera
    #: Whether it was held out of the training.
    held_out: bool

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.camera.width, self.camera.height


@dataclass(frozen=True, eq=False)
class FeatureField:
    """A feature vector per splat of ``scene.ply``."""

    #: ``[splats, channels]``. A splat that no photo sees has zeros.
    values: NDArray[np.float32]

    def similarity(self, splat: int) -> NDArray[np.float32]:
        """Cosines between the feature of a splat and those of all, ``[splats]``; 0 where a feature is zero."""
        lengths = np.linalg.norm(self.values, axis=1)
        unit = self.values / np.where(lengths > 0, lengths, 1.0)[:, None]
        cosines: NDArray[np.float32] = unit @ unit[splat]
        return cosines


@dataclass(frozen=True)
class HeldOutScore:
    """Scores of a photo held out; ``nan`` where one cannot be computed."""

    photo: str
    #: PSNR in dB, and SSIM.
    psnr: float
    ssim: float
    #: PSNR in dB without the pixels that contradict the scene, and the share of the pixels that do.
    kept_psnr: float
    left_out: float


@dataclass(frozen=True)
class HeldOut:
    """`evaluation.json`: mean scores of the photos held out, and those of each."""

    #: How they were scored, in words. No figure is comparable without it.
    protocol: str
    psnr: float
    ssim: float
    kept_psnr: float
    left_out: float
    photos: tuple[HeldOutScore, ...]


class Run:
    """A run folder, opened for reading. Nothing outside of the folder is read, and nothing is written."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Opens a run.

        Raises:
            SegwildError: When the folder is no run.
        """
        self._folder = Folder(path)
        self.path: Path = self._folder.path
        scene = Fields(self._folder.within("scene.json"), self._folder.json("scene.json", _MAKE), AGAIN)
        #: Names of the photos held out of the training.
        self.held_out: tuple[str, ...] = scene.texts("held_out")
        #: The photos that cannot be used, with the reason.
        self.skipped: dict[str, str] = {s.text("name"): s.text("reason") for s in scene.objects("skipped")}
        #: Who made the masks, such as ``built-in``. A figure of masks has to name it. Empty where it was not recorded.
        self.provider: str = scene.text("provider") if scene.has("provider") else ""

    def __repr__(self) -> str:
        return f"segwild.Run({str(self.path)!r})"

    @cached_property
    def _cameras(self) -> Fields:
        remedy = f"a run of an earlier version has none: {AGAIN}"
        return Fields(self._folder.within("cameras.json"), self._folder.json("cameras.json", remedy), AGAIN)

    @cached_property
    def offset(self) -> NDArray[np.float64]:
        """Added to a position of ``scene.ply`` in double precision, it gives that of the reconstruction, ``[3]``."""
        return np.array(self._cameras.numbers("offset", 3))

    @cached_property
    def photos(self) -> tuple[Photo, ...]:
        """The photos that take part, in the order of the scene."""
        held_out = set(self.held_out)
        return tuple(
            Photo(p.text("photo"), self._camera(p), p.text("photo") in held_out) for p in self._cameras.objects("photos")
        )

    def _camera(self, p: Fields) -> Camera:
        rotation = np.array(p.rows("rotation", 3, 3))
        width, height = p.count("width", 1 << 20), p.count("height", 1 << 20)
        focal = p.number("fx"), p.number("fy")
        if not width or not height or min(focal) <= 0.0 or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
            raise SegwildError(self._folder.within("cameras.json"), "a camera of it is damaged", AGAIN)
        return Camera(
            width=width,
            height=height,
            fx=focal[0],
            fy=focal[1],
            cx=p.number("cx"),
            cy=p.number("cy"),
            rotation=rotation,
            translation=np.array(p.numbers("translation", 3)),
            distorted=p.flag("distorted"),
        )

    def photo(self, name: str) -> Photo:
        """A photo by its name.

        Raises:
            KeyError: When the run has none of this name.
        """
        for photo in self.photos:
            if photo.name == name:
                return photo
        raise KeyError(f"the run has no photo {name!r}: {', '.join(p.name for p in self.photos[:5])}, ...")

    @cached_property
    def _images(self) -> dict[str, str]:
        return {p.text("photo"): p.text("image") for p in self._cameras.objects("photos")}

    def _splat_count(self) -> int:
        return splat_count(self._folder.within("scene.ply"))

    def splats(self) -> Splats:
        """The trained scene: ``scene.ply``, in the scene's own appearance."""
        return splats_of(self._folder.within("scene.ply"), self._folder.bytes("scene.ply"))

    def features(self) -> FeatureField:
        """The feature field: ``features.bin``. Its hash is not compared; `segwild cache verify` does that.

        Raises:
            SegwildError: When the stage is not done, or the file is damaged or of another training.
        """
        path = self._folder.within("features.bin")
        values = features_of(path, self._folder.bytes("features.bin"))
        if len(values) != self._splat_count():
            raise SegwildError(path, f"it is of {len(values)} splats, and the scene has {self._splat_count()}", AGAIN)
        return FeatureField(values)

    @property
    def selections(self) -> tuple[str, ...]:
        """Names of the selections, sorted."""
        folder = self._folder.within("selections")
        try:
            names = sorted(entry.name for entry in os.scandir(folder) if not entry.name.startswith("."))
        except FileNotFoundError:
            return ()
        except OSError as error:
            raise SegwildError(folder, f"it cannot be read: {error.strerror}", _MAKE) from None
        # Without its prompts it is one that a killed process left.
        return tuple(name for name in names if (folder / name / "prompts.json").is_file())

    def selection(self, name: str = "object") -> Selection:
        """A selection by its name.

        Raises:
            KeyError: When the run has none of this name.
        """
        if name not in self.selections:
            raise KeyError(f"the run has no selection {name!r}: {', '.join(self.selections) or 'there is none yet'}")
        return Selection(self._folder, name, self._images, self._splat_count())

    @property
    def objects(self) -> tuple[SceneObject, ...]:
        """The scene's objects, found without a click; empty where they are not listed yet (`segwild objects RUN`)."""
        name = "objects/objects.json"
        if not self._folder.has(name):
            return ()
        return list_of(Fields(self._folder.within(name), self._folder.json(name), "`segwild objects RUN` lists them again"))

    def _image_file(self, folder: str, photo: str) -> str:
        if photo not in self._images:
            raise KeyError(f"the run has no photo {photo!r}")
        return f"{folder}/{self._images[photo]}"

    def transient_mask(self, photo: str) -> NDArray[np.bool_]:
        """What was left out of a photo as transient, ``[height, width]``: the photo as taken, at the size of the training.

        Raises:
            KeyError: When the run has no such photo.
            SegwildError: When it has no such mask, or it is damaged.
        """
        name = self._image_file("transients", photo)
        return mask_of(self._folder.within(name), self._folder.bytes(name))

    def held_out_render(self, photo: str) -> Path:
        """The file of the render of a photo held out, as it was scored: an RGB image for :func:`segwild.read_png`.

        Raises:
            KeyError: When the run has no such photo.
            SegwildError: When the photo was not scored.
        """
        name = self._image_file("held_out", photo)
        if not self._folder.has(name):
            raise SegwildError(self._folder.within(name), "the photo was not scored", "choose one of `run.held_out`")
        return self._folder.within(name)

    @property
    def evaluation(self) -> HeldOut | None:
        """Scores of the photos held out; `None` where none were scored."""
        if not self._folder.has("evaluation.json"):
            return None
        file = Fields(self._folder.within("evaluation.json"), self._folder.json("evaluation.json"))

        def scores(of: Fields) -> tuple[float, float, float, float]:
            return of.score("psnr"), of.score("ssim"), of.score("kept_psnr"), of.score("left_out")

        photos = tuple(HeldOutScore(p.text("photo"), *scores(p)) for p in file.objects("photos"))
        return HeldOut(file.text("protocol"), *scores(file), photos)

    @property
    def history(self) -> dict[str, NDArray[np.float64]]:
        """The training over its steps: ``step``, ``loss``, ``psnr`` in dB, ``splats``, ``left_out``; an array of each."""
        lines = []
        for line in self._folder.bytes("history.jsonl").splitlines():
            try:
                values = json.loads(line)
                lines.append([float(values[name]) for name in _HISTORY])
            # A line may be cut short, and a step of it may have no finite loss.
            except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
                continue
        table = np.array(lines, dtype=np.float64).reshape(-1, len(_HISTORY))
        return {name: table[:, k] for k, name in enumerate(_HISTORY)}

