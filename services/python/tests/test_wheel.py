"""The wheel of a release (.ci/wheel.py): what is in it, as pip reads it."""

from __future__ import annotations

import base64
import csv
import hashlib
import io
import os
import subprocess
import sys
import tomllib
import unittest
import zipfile
from email import message_from_bytes
from pathlib import Path

from .support import temporary_folder

ROOT = Path(__file__).resolve().parents[3]


class WheelTest(unittest.TestCase):
    def wheel(self, program: Path) -> Path:
        out = temporary_folder()
        command = [sys.executable, str(ROOT / ".ci/wheel.py"), str(program), "manylinux_2_28_x86_64", str(out)]
        environment = os.environ | {"SOURCE_DATE_EPOCH": "1700000000"}
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True)
        made = Path(done.stdout.decode().strip())
        self.assertEqual(made.parent, out)
        return made

    def test_a_wheel_has_the_program_the_package_and_their_checksums(self) -> None:
        # Any file can be packed; a small one is packed fast.
        program = ROOT / ".ci/release"
        version = tomllib.loads((ROOT / "Cargo.toml").read_text())["workspace"]["package"]["version"]
        wheel = self.wheel(program)
        self.assertEqual(wheel.name, f"segwild-{version}-py3-none-manylinux_2_28_x86_64.whl")
        with zipfile.ZipFile(wheel) as archive:
            files = {entry.filename: archive.read(entry) for entry in archive.infolist()}
            self.assertEqual(len(files), len(archive.infolist()))
            script = archive.getinfo(f"segwild-{version}.data/scripts/segwild")
            self.assertEqual(script.external_attr >> 16, 0o100755)
        self.assertEqual(files[script.filename], program.read_bytes())
        for source in (ROOT / "services/python/segwild").glob("*.py"):
            self.assertEqual(files[f"segwild/{source.name}"], source.read_bytes())
        self.assertIn("segwild/py.typed", files)
        self.assertFalse([name for name in files if "tests/" in name or "__pycache__" in name])
        info = f"segwild-{version}.dist-info"
        record = {row[0]: row[1:] for row in csv.reader(io.StringIO(files[f"{info}/RECORD"].decode()))}
        self.assertEqual(record.keys(), files.keys())
        for name, content in files.items():
            digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
            own = name == f"{info}/RECORD"
            self.assertEqual(record[name], ["", ""] if own else [f"sha256={digest}", str(len(content))], name)
        metadata = message_from_bytes(files[f"{info}/METADATA"])
        project = tomllib.loads((ROOT / "services/python/pyproject.toml").read_text())["project"]
        self.assertEqual((metadata["Name"], metadata["Version"]), ("segwild", version))
        needed = metadata.get_all("Requires-Dist") or []
        self.assertEqual([line for line in needed if "extra" not in line], project["dependencies"])
        for licence in metadata.get_all("License-File") or []:
            self.assertEqual(files[f"{info}/licenses/{licence}"], (ROOT / licence).read_bytes())
        self.assertIn("Tag: py3-none-manylinux_2_28_x86_64", files[f"{info}/WHEEL"].decode())

    def test_the_same_files_make_the_same_wheel(self) -> None:
        program = ROOT / ".ci/release"
        self.assertEqual(self.wheel(program).read_bytes(), self.wheel(program).read_bytes())


if __name__ == "__main__":
    unittest.main()
