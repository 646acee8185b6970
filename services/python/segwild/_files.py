"""Files of a run folder. Another person may have made it: nothing outside of it is read, and a file is never trusted."""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .errors import SegwildError

#: Most bytes of a JSON file.
JSON_LIMIT = 256 << 20
#: Most bytes of any other file: segwild's own limit of a record is 1 GiB, and a scene of 10 million splats has 2.5.
FILE_LIMIT = 16 << 30
AGAIN = "run `segwild run SCENE --out RUN` again: it keeps what is whole and writes the rest"


def read_file(path: Path, remedy: str, limit: int = FILE_LIMIT) -> bytes:
    """The bytes of a plain file. A pipe or a device in its stead is refused, for it might never end."""
    data, size = read_start(path, remedy, limit + 1)
    if size > limit:
        raise SegwildError(path, f"it has {size} bytes, the limit is {limit}", remedy)
    return data


def read_start(path: Path, remedy: str, most: int) -> tuple[bytes, int]:
    """The first bytes of a plain file, at most so many, and how many it has."""
    try:
        # A pipe that nobody writes to would block the call otherwise.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with os.fdopen(handle, "rb") as file:
            about = os.fstat(handle)
            if not stat.S_ISREG(about.st_mode):
                raise SegwildError(path, "it is no plain file", "remove it")
            return file.read(min(most, about.st_size)), about.st_size
    except FileNotFoundError:
        raise SegwildError(path, "there is no such file", remedy) from None
    except (OSError, ValueError) as error:
        raise SegwildError(path, f"it cannot be read: {getattr(error, 'strerror', None) or error}", remedy) from None


class Folder:
    """A folder from which only files within it are read."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._whole = os.path.realpath(self.path)

    def within(self, name: str, base: str = "") -> Path:
        """The path of a file by its name in the folder, ``/`` between the parts; ``base`` is a sub-folder.

        Raises:
            SegwildError: When the name or a link leads out of the folder.
        """
        parts = [part for part in base.split("/") if part] + name.split("/")
        odd = any(part in ("", ".", "..") or "\\" in part or "\0" in part or ":" in part for part in parts)
        path = self.path / "/".join(part.replace("\0", "") for part in parts)
        remedy = "take a run folder that segwild wrote"
        if odd or os.path.isabs(name):
            raise SegwildError(self.path, f"it names the file {name[:120]!r}, which may lie outside of it", remedy)
        if not (os.path.realpath(path) + os.sep).startswith(self._whole.rstrip(os.sep) + os.sep):
            raise SegwildError(path, "a link leads out of the folder", remedy)
        return path

    def bytes(self, name: str, remedy: str = AGAIN) -> bytes:
        """The bytes of a file."""
        return read_file(self.within(name), remedy)

    def json(self, name: str, remedy: str = AGAIN) -> Any:
        """A JSON file."""
        path = self.within(name)
        return parse_json(path, read_file(path, remedy, JSON_LIMIT), remedy)

    def has(self, name: str) -> bool:
        """Whether there is a plain file of this name."""
        return self.within(name).is_file()


def parse_json(path: Path, text: bytes, remedy: str) -> Any:
    """The value of a JSON text."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SegwildError(path, f"it is no JSON: {error}", remedy) from None


class Fields:
    """The fields of a JSON object, each with its type checked."""

    def __init__(self, path: Path, value: Any, remedy: str = AGAIN) -> None:
        self._path, self._remedy = path, remedy
        if not isinstance(value, Mapping):
            raise self._wrong("an object is missing")
        self._value: Mapping[str, Any] = value

    def _wrong(self, problem: str) -> SegwildError:
        return SegwildError(self._path, f"it is damaged: {problem}", self._remedy)

    def _get(self, name: str) -> Any:
        if name not in self._value:
            raise self._wrong(f"the field `{name}` is missing")
        return self._value[name]

    def has(self, name: str) -> bool:
        """Whether the field is there and not null."""
        return self._value.get(name) is not None

    def text(self, name: str) -> str:
        value = self._get(name)
        if not isinstance(value, str):
            raise self._wrong(f"`{name}` is no text")
        return value

    def flag(self, name: str) -> bool:
        value = self._get(name)
        if not isinstance(value, bool):
            raise self._wrong(f"`{name}` is neither true nor false")
        return value

    def count(self, name: str, most: int = 1 << 40) -> int:
        value = self._get(name)
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= most:
            raise self._wrong(f"`{name}` is no number from 0 to {most}")
        return value

    def number(self, name: str) -> float:
        return self._finite(name, self._get(name))

    def score(self, name: str) -> float:
        """A number; ``nan`` where the file has null, as for a score that cannot be computed."""
        return float("nan") if self._get(name) is None else self.number(name)

    def _finite(self, name: str, value: Any) -> float:
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            try:
                number = float(value)
            except OverflowError:
                number = float("inf")
            if number - number == 0.0:
                return number
        raise self._wrong(f"`{name}` is no finite number")

    def numbers(self, name: str, length: int) -> tuple[float, ...]:
        values = self._get(name)
        if not isinstance(values, list) or len(values) != length:
            raise self._wrong(f"`{name}` is no list of {length} numbers")
        return tuple(self._finite(name, value) for value in values)

    def rows(self, name: str, rows: int, columns: int) -> tuple[tuple[float, ...], ...]:
        values = self._get(name)
        if not isinstance(values, list) or len(values) != rows:
            raise self._wrong(f"`{name}` has not {rows} rows")
        return tuple(Fields(self._path, {name: row}, self._remedy).numbers(name, columns) for row in values)

    def texts(self, name: str) -> tuple[str, ...]:
        values = self._get(name)
        if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
            raise self._wrong(f"`{name}` is no list of texts")
        return tuple(values)

    def objects(self, name: str) -> list[Fields]:
        """A list of objects; none where the field is missing or null."""
        values = self._value.get(name)
        if values is None:
            return []
        if not isinstance(values, list):
            raise self._wrong(f"`{name}` is no list")
        return [Fields(self._path, value, self._remedy) for value in values]

    def object(self, name: str) -> Fields:
        return Fields(self._path, self._get(name), self._remedy)
