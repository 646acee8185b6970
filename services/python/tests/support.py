"""What the tests share: the program, a run that it made, and changed bytes.

`SEGWILD` names the program. `SEGWILD_TEST_SCENE` and `SEGWILD_TEST_RUN` name a synthetic scene and a run of it, which may be
written into; without them both are made here.
"""

from __future__ import annotations

import atexit
import json
import os
import random
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

PROGRAM = os.environ.get("SEGWILD", "")
NEEDS_PROGRAM = "the variable SEGWILD names no program"
QUICK = (
    "--size 96 --steps 60 --splats 2000 --refine-steps 4 --prompt-budget 24 --appearance-model affine".split()
)


def segwild(*arguments: str) -> str:
    """What the program prints."""
    done = subprocess.run([PROGRAM, *arguments], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise AssertionError(f"segwild {' '.join(arguments)}: {done.stderr}")
    return done.stdout


def temporary_folder() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="segwild-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@cache
def scene_and_run() -> tuple[Path, Path]:
    """The folder of a synthetic scene, and of a run on it."""
    if "SEGWILD_TEST_RUN" in os.environ:
        return Path(os.environ["SEGWILD_TEST_SCENE"]), Path(os.environ["SEGWILD_TEST_RUN"])
    folder = temporary_folder()
    segwild("demo", "--photos-only", "--out", str(folder))
    scene, run = folder / "scene", folder / "run"
    segwild("run", str(scene), "--out", str(run), *QUICK)
    return scene, run


@cache
def truth() -> dict[str, Any]:
    """`truth.json` of the scene."""
    found: dict[str, Any] = json.loads((scene_and_run()[0] / "truth.json").read_text())
    return found


@cache
def selected() -> tuple[str, dict[str, Any]]:
    """Selects the object that photos show largest. Returns its name in the truth, and what the program printed."""
    things = [thing for thing in truth()["objects"] if thing["name"] != "ground" and thing["clicks"]]
    thing = max(things, key=lambda thing: thing["clicks"][0]["visible"])
    click = thing["clicks"][0]
    at = f"{click['x']},{click['y']}"
    run = str(scene_and_run()[1])
    printed = segwild("segment", run, "--photo", click["photo"], "--positive", at, "--name", "it", "--json")
    return thing["name"], json.loads(printed)


@cache
def exported() -> tuple[Path, dict[str, Any]]:
    """Writes all objects of the scene. Returns the folder, and what the program printed."""
    out = temporary_folder() / "all"
    printed = segwild("objects", str(scene_and_run()[1]), "--rename", "1=first", "--out", str(out), "--json")
    return out, json.loads(printed)


def changed(good: bytes, count: int, seed: int) -> Iterator[bytes]:
    """Bytes as a bad disk or a bad person may leave them: bits flipped, parts cut out, repeated or overwritten."""
    random_source = random.Random(seed)
    for _ in range(count):
        data = bytearray(good)
        # Headers decide how the rest is read: half of the changes are there.
        ends = [len(data), min(len(data), 400)]
        for _ in range(random_source.randint(1, 4)):
            if not data:
                break
            at = random_source.randrange(min(random_source.choice(ends), len(data)))
            way = random_source.randrange(5)
            if way == 0:
                data[at] ^= 1 << random_source.randrange(8)
            elif way == 1:
                del data[at:]
            elif way == 2:
                del data[at : at + random_source.randint(1, 64)]
            elif way == 3:
                data[at : at + 8] = random_source.choice([b"\xff" * 8, b"\0" * 8, b"99999999", b"\x7f" + b"\xff" * 7])
            else:
                data[at:at] = data[max(0, at - 32) : at]
        yield bytes(data)
