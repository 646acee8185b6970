"""Where pip put the program."""

from __future__ import annotations

import os
import sys
import sysconfig
from pathlib import Path

from .errors import SegwildError


def find_binary() -> str:
    """The path of the `segwild` program that came with this package.

    Raises:
        SegwildError: When the package was installed without it.
    """
    name = "segwild" + (sysconfig.get_config_var("EXE") or "")
    user = sysconfig.get_preferred_scheme("user")
    package = Path(__file__).resolve().parent
    folders = [
        sysconfig.get_path("scripts"),
        # `pip install --user`.
        sysconfig.get_path("scripts", scheme=user),
        # `pip install --target FOLDER`: FOLDER/segwild and FOLDER/bin.
        str(package.parent / "bin"),
        # `pip install --prefix FOLDER`: FOLDER/lib/python3.x/site-packages/segwild and FOLDER/bin.
        *(str(package.parents[3] / "bin") for _ in package.parents[3:4]),
    ]
    for folder in folders:
        path = os.path.join(folder, name)
        if folder and os.path.isfile(path):
            return path
    raise SegwildError(
        os.path.join(folders[0], name),
        "the program is not there",
        "install the wheel with `pip install segwild`, or build it with `cargo install --path services/cli`",
    )
