#!/usr/bin/env python3
"""Says what the program consists of on a target: an SBOM (CycloneDX 1.5, JSON), or the licence texts that it comes with.

    .ci/sbom.py TARGET > segwild.cdx.json
    .ci/sbom.py TARGET --notices > THIRD-PARTY.txt

Read from `cargo tree` (which packages, with the features that the program turns on), `cargo metadata` (what they are) and
Cargo.lock (their checksums), in the folder that the command is run in. What is used while building only (build scripts,
procedural macros, and what these need) has the scope "excluded". $SOURCE_DATE_EPOCH is the date. The same input gives the
same bytes.
"""

import argparse
import datetime
import hashlib
import json
import os
import pathlib
import re
import subprocess
import sys
import tomllib
import uuid

PROGRAM = "segwild-cli"
# The file names of licences and notices, in any case.
NOTICE = re.compile(r"(licen[cs]e|copying|copyright|notice|unlicense)([-._].*)?", re.IGNORECASE)


def cargo(*words):
    """What cargo prints, never asking the network for another Cargo.lock."""
    command = [os.environ.get("CARGO", "cargo"), *words, "--locked"]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=False)
    if done.returncode:
        sys.exit(f"`{' '.join(command)}` failed: run this in the folder of Cargo.toml, with a Cargo.lock that fits it")
    return done.stdout.decode()


def listed(target, edges):
    """Names and versions of the packages that the program reaches over these edges."""
    tree = cargo("tree", "--package", PROGRAM, "--target", target, "--edges", edges, "--prefix", "none")
    lines = (line.split() for line in tree.splitlines() if line.strip())
    return {(words[0], words[1].removeprefix("v")) for words in lines}


def purl(package):
    """A package's URL, as every tool for SBOMs writes it."""
    return f"pkg:cargo/{package['name']}@{package['version'].replace('+', '%2B')}"


def component(package, checksums, scope):
    """A package as a component."""
    made = {
        "type": "library",
        "bom-ref": purl(package),
        "name": package["name"],
        "version": package["version"],
        "scope": scope,
        "purl": purl(package),
    }
    if package["license"]:
        # Older packages write a slash for "or".
        made["licenses"] = [{"expression": re.sub(r"\s*/\s*", " OR ", package["license"])}]
    checksum = checksums.get((package["name"], package["version"]))
    if checksum:
        made["hashes"] = [{"alg": "SHA-256", "content": checksum}]
    if package["repository"]:
        made["externalReferences"] = [{"type": "vcs", "url": package["repository"]}]
    # SQLite's C file comes inside of a package, and advisories name it by its own version.
    header = pathlib.Path(package["manifest_path"]).parent / "sqlite3/sqlite3.h"
    if header.is_file():
        version = re.search(r'#define SQLITE_VERSION\s+"([^"]+)"', header.read_text(encoding="utf-8"))
        made["components"] = [
            {
                "type": "library",
                "bom-ref": f"pkg:generic/sqlite@{version[1]}",
                "name": "sqlite",
                "version": version[1],
                "cpe": f"cpe:2.3:a:sqlite:sqlite:{version[1]}:*:*:*:*:*:*:*",
                "purl": f"pkg:generic/sqlite@{version[1]}",
            }
        ]
    return made


def sbom(target, used, linked, resolved):
    """The whole document. `used`: the packages by id; `linked`: names and versions of those inside of the program."""
    lock = tomllib.loads(pathlib.Path("Cargo.lock").read_text(encoding="utf-8"))
    checksums = {(p["name"], p["version"]): p.get("checksum") for p in lock["package"]}
    program = next(package for package in used.values() if package["name"] == PROGRAM)
    packages = sorted(used.values(), key=purl)
    components = []
    for package in packages:
        if package is not program:
            inside = (package["name"], package["version"]) in linked
            components.append(component(package, checksums, "required" if inside else "excluded"))
    edges = []
    for package in packages:
        needs = {d["pkg"]: d["dep_kinds"] for d in resolved[package["id"]]["deps"] if d["pkg"] in used}
        built = [i for i, uses in needs.items() if any(use["kind"] != "dev" for use in uses)]
        edges.append({"ref": purl(package), "dependsOn": sorted(purl(used[i]) for i in built)})
    date = datetime.datetime.fromtimestamp(int(os.environ.get("SOURCE_DATE_EPOCH", "0")), datetime.timezone.utc)
    body = {
        "metadata": {
            "timestamp": date.strftime("%Y-%m-%dT%H:%M:%SZ"),
            "component": {
                "type": "application",
                "bom-ref": purl(program),
                "name": "segwild",
                "version": program["version"],
                "licenses": [{"expression": program["license"]}],
                "purl": purl(program),
                "externalReferences": [{"type": "vcs", "url": program["repository"]}],
            },
            "properties": [{"name": "rust:target", "value": target}],
        },
        "components": components,
        "dependencies": edges,
    }
    # The same document has the same number.
    digest = hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()
    head = {
        "$schema": "http://cyclonedx.org/schema/bom-1.5.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_URL, digest)}",
        "version": 1,
    }
    return json.dumps(head | body, indent=1)


def notices(used, linked):
    """The licence files of the packages inside of the program; texts that several share stand once."""
    texts = {}
    for package in sorted(used.values(), key=purl):
        if package["source"] is None or (package["name"], package["version"]) not in linked:
            continue
        folder = pathlib.Path(package["manifest_path"]).parent
        found = sorted(file for file in folder.iterdir() if file.is_file() and NOTICE.fullmatch(file.name))
        named = f"{package['name']} {package['version']} ({package['license']})"
        for file in found:
            text = file.read_text(encoding="utf-8", errors="replace").strip()
            texts.setdefault(text, []).append(named)
        if not found:
            texts.setdefault(f"(no licence file; source: {package['repository']})", []).append(named)
    parts = ["segwild contains these packages. Their licence texts follow."]
    for text, names in texts.items():
        parts += ["=" * 80, "\n".join(dict.fromkeys(names)), text]
    return "\n\n".join(parts)


def main():
    """Reads the command line, and prints."""
    parser = argparse.ArgumentParser(description="What the program consists of on a target.")
    parser.add_argument("target", metavar="TARGET", help="a target of rustc, such as x86_64-unknown-linux-gnu")
    parser.add_argument("--notices", action="store_true", help="print the licence texts instead")
    args = parser.parse_args()
    every = listed(args.target, "normal,build")
    linked = listed(args.target, "normal,no-proc-macro")
    metadata = json.loads(cargo("metadata", "--format-version", "1", "--filter-platform", args.target))
    used = {p["id"]: p for p in metadata["packages"] if (p["name"], p["version"]) in every}
    resolved = {node["id"]: node for node in metadata["resolve"]["nodes"]}
    print(notices(used, linked) if args.notices else sbom(args.target, used, linked, resolved))


if __name__ == "__main__":
    main()
