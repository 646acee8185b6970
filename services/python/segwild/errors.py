"""The one exception of the package."""

from __future__ import annotations

import os


class SegwildError(Exception):
    """A file or folder cannot be read.

    Attributes:
        path: The file or folder.
        problem: What is wrong with it.
        remedy: What to do.
    """

    def __init__(self, path: str | os.PathLike[str], problem: str, remedy: str) -> None:
        self.path = os.fspath(path)
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{_one_line(self.path)}: {_one_line(problem)}; {_one_line(remedy)}")


def _one_line(text: str) -> str:
    # Names come with a run folder and may hold what a terminal obeys.
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
