"""`python -m segwild` is the program."""

from __future__ import annotations

import os
import subprocess
import sys

from ._binary import find_binary
from .errors import SegwildError


def main() -> int:
    try:
        binary = find_binary()
    except SegwildError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    arguments = [binary, *sys.argv[1:]]
    if sys.platform == "win32":
        # There `exec` would return to the shell before the program ends.
        try:
            return subprocess.run(arguments, check=False).returncode
        except KeyboardInterrupt:
            return 130
    os.execv(binary, arguments)


if __name__ == "__main__":
    sys.exit(main())
