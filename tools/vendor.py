"""Keeps the scripts of others that no Python package carries: ``static/vendor``, listed in ``vendored.json``.

    python tools/vendor.py            # every file is there and has the SHA-256 of the list; works offline
    python tools/vendor.py --fetch    # take the listed versions from npm again, and write files and list

A new version: change ``version`` and ``integrity`` (``npm view NAME@VERSION dist.integrity``) in the list, then fetch.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import json
import re
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[1] / "static" / "vendor"
LIST = "vendored.json"
# Pages allow no import map, since it would be an inline script; so modules name their neighbours by address.
_BARE_IMPORT = re.compile(r"(?<=\bfrom )(['\"])three\1")
_RELATIVE_IMPORT = "'./three.module.min.js'"


def main() -> None:
    """Check the files, or fetch them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fetch", action="store_true", help="take the listed versions from npm")
    arguments = parser.parse_args()
    if arguments.fetch:
        fetch(FOLDER)
    problems = check(FOLDER)
    for problem in problems:
        print(problem, file=sys.stderr)
    if problems:
        raise SystemExit(1)
    print(f"{FOLDER}: every file is as listed")


def check(folder: Path) -> list[str]:
    """Differences between the files and the list, one line each."""
    problems = []
    expected = {LIST}
    for package, entry in _read(folder).items():
        for name, file in entry["files"].items():
            expected.add(f"{package}/{name}")
            path = folder / package / name
            if not path.is_file():
                problems.append(f"{path} is missing; run tools/vendor.py --fetch")
            elif _sha256(path.read_bytes()) != file["sha256"]:
                problems.append(f"{path} differs from {LIST}; run tools/vendor.py --fetch")
    found = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    return problems + [
        f"{folder / name} is not listed in {LIST}; list or remove it" for name in sorted(found - expected)
    ]


def fetch(folder: Path) -> None:
    """Take every listed file from the package of the listed version."""
    listed = _read(folder)
    for package, entry in listed.items():
        (folder / package).mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory() as scratch:
            archive = _packed(package, entry, Path(scratch))
            for name, file in entry["files"].items():
                content = adapted(_member(archive, file["from"]), name)
                (folder / package / name).write_bytes(content)
                file["sha256"] = _sha256(content)
    (folder / LIST).write_text(json.dumps(listed, indent=1) + "\n", encoding="utf-8")


def adapted(content: bytes, name: str) -> bytes:
    """A file as pages need it: modules import three by a relative address. Nothing else is changed."""
    if not name.endswith(".js"):
        return content
    return _BARE_IMPORT.sub(_RELATIVE_IMPORT, content.decode("utf-8")).encode("utf-8")


def _packed(package: str, entry: dict[str, Any], scratch: Path) -> Path:
    """The package as npm has it; ends the program if its content is not the listed one.

    It is called as its folder, unless the list says what npm calls it.
    """
    wanted = f"{entry.get('npm', package)}@{entry['version']}"
    subprocess.run(["npm", "pack", wanted, "--silent"], cwd=scratch, check=True, stdout=subprocess.DEVNULL)
    (archive,) = scratch.glob("*.tgz")
    found = "sha512-" + base64.b64encode(hashlib.sha512(archive.read_bytes()).digest()).decode()
    if found != entry["integrity"]:
        raise SystemExit(f"{wanted} has the integrity {found}, listed is {entry['integrity']}")
    return archive


def _member(archive: Path, name: str) -> bytes:
    with tarfile.open(archive) as packed:
        stream = packed.extractfile(f"package/{name}")
        if stream is None:
            raise SystemExit(f"{archive.name} has no file {name}")
        return stream.read()


def _read(folder: Path) -> dict[str, dict[str, Any]]:
    content: dict[str, dict[str, Any]] = json.loads((folder / LIST).read_text(encoding="utf-8"))
    return content


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


if __name__ == "__main__":
    main()
