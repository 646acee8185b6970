#!/usr/bin/env python3
"""Packs a program that is built already, and the package of services/python, as a wheel.

    .ci/wheel.py PROGRAM PLATFORM OUT [NOTICES]      (PLATFORM: manylinux_2_28_x86_64, musllinux_1_2_aarch64, ..)

maturin, by which `pip` builds the package from source, would compile the program a second time; here it is the same file
as in the other archives. What a wheel is: https://packaging.python.org/en/latest/specifications/binary-distribution-format/.
$SOURCE_DATE_EPOCH is the date of all files. The same input gives the same bytes. Prints the wheel's path.
"""

import base64
import hashlib
import os
import pathlib
import sys
import time
import tomllib
import zipfile

ROOT = pathlib.Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "services/python"


def toml(path):
    """A file of settings."""
    return tomllib.loads(path.read_text(encoding="utf-8"))


def metadata(project, version, licences):
    """The METADATA of the wheel: what pyproject.toml says, and the page of the package."""
    lines = [
        "Metadata-Version: 2.4",
        f"Name: {project['name']}",
        f"Version: {version}",
        f"Summary: {project['description']}",
        f"License-Expression: {project['license']}",
        *(f"License-File: {name}" for name in licences),
        f"Requires-Python: {project['requires-python']}",
        *(f"Project-URL: {name}, {url}" for name, url in project["urls"].items()),
        *(f"Requires-Dist: {needed}" for needed in project["dependencies"]),
    ]
    for extra, needs in project["optional-dependencies"].items():
        lines.append(f"Provides-Extra: {extra}")
        lines += (f"Requires-Dist: {needed} ; extra == '{extra}'" for needed in needs)
    lines += ["Description-Content-Type: text/markdown", "", (PACKAGE / project["readme"]).read_text(encoding="utf-8")]
    return "\n".join(lines)


def main():
    """Reads the command line, and writes the wheel."""
    if len(sys.argv) not in (4, 5):
        sys.exit(__doc__.split("\n\n")[1].strip())
    program, platform, out = pathlib.Path(sys.argv[1]), sys.argv[2], pathlib.Path(sys.argv[3])
    project = toml(PACKAGE / "pyproject.toml")["project"]
    version = toml(ROOT / "Cargo.toml")["workspace"]["package"]["version"]
    name = f"{project['name']}-{version}"
    info = f"{name}.dist-info"
    sources = PACKAGE / project["name"]
    files = {
        f"{project['name']}/{file.relative_to(sources).as_posix()}": file.read_bytes()
        for file in sorted(sources.rglob("*"))
        if file.is_file() and "__pycache__" not in file.parts
    }
    script = f"{name}.data/scripts/segwild"
    files[script] = program.read_bytes()
    licences = {file: (ROOT / file).read_bytes() for file in ("LICENSE-APACHE", "LICENSE-MIT")}
    if len(sys.argv) == 5:
        licences["THIRD-PARTY.txt"] = pathlib.Path(sys.argv[4]).read_bytes()
    files |= {f"{info}/licenses/{file}": text for file, text in licences.items()}
    files[f"{info}/METADATA"] = metadata(project, version, licences).encode()
    tag = f"py3-none-{platform}"
    files[f"{info}/WHEEL"] = (
        f"Wheel-Version: 1.0\nGenerator: segwild .ci/wheel.py\nRoot-Is-Purelib: false\nTag: {tag}\n".encode()
    )
    record = []
    for path, content in files.items():
        digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
        record.append(f"{path},sha256={digest},{len(content)}\n")
    files[f"{info}/RECORD"] = "".join([*record, f"{info}/RECORD,,\n"]).encode()
    # A date before 1980 has no form in a zip.
    date = time.gmtime(max(int(os.environ.get("SOURCE_DATE_EPOCH", "0")), 315532800))[:6]
    wheel = out / f"{name}-{tag}.whl"
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for path, content in files.items():
            entry = zipfile.ZipInfo(path, date)
            entry.create_system, entry.compress_type = 3, zipfile.ZIP_DEFLATED
            entry.external_attr = (0o100755 if path == script else 0o100644) << 16
            archive.writestr(entry, content)
    print(wheel)


if __name__ == "__main__":
    main()
