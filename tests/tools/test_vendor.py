"""``static/vendor``: what is listed is there, unchanged, and loads nothing by a bare name."""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tools"))

import vendor  # noqa: E402

LISTED = json.loads((vendor.FOLDER / vendor.LIST).read_text())


def test_every_file_is_as_listed():
    assert vendor.check(vendor.FOLDER) == []
    for package, entry in LISTED.items():
        assert entry["version"]
        assert entry["licence"] in {"MIT", "BSD-3-Clause", "Apache-2.0", "ISC"}, "compatible with the GPL"
        assert entry["licence"] in (vendor.FOLDER / package / "LICENSE").read_text()[:40]


def test_a_changed_a_missing_and_an_unknown_file_are_named(tmp_path: Path):
    folder = tmp_path / "vendor"
    shutil.copytree(vendor.FOLDER, folder)
    (folder / "three" / "OrbitControls.js").write_text("changed")
    (folder / "three" / "LineMaterial.js").unlink()
    (folder / "other.js").write_text("")
    told = "\n".join(vendor.check(folder))
    for words in ("OrbitControls.js differs", "LineMaterial.js is missing", "other.js is not listed in vendored.json"):
        assert words in told
    assert len(told.splitlines()) == 3


WITHOUT_IMPORTS = {"three.core.min.js", "_u64.js", "utils.js", "uPlot.iife.min.js"}


def test_no_module_needs_an_import_map():
    """The pages' policy forbids inline scripts, and an import map is one."""
    for script in vendor.FOLDER.rglob("*.js"):
        imports = re.findall(r"""^(?:import|\}).*?\bfrom ?['"]([^'"]+)['"]""", script.read_text(), re.MULTILINE)
        assert imports or script.name in WITHOUT_IMPORTS
        assert all(address.startswith("./") for address in imports), (script, imports)


@pytest.mark.parametrize("quote", ["'", '"'])
def test_only_the_bare_import_is_rewritten(quote: str):
    text = f"import {{ A }} from {quote}three{quote};\n// a three, from 'threes'\n".encode()
    assert vendor.adapted(text, "x.js") == b"import { A } from './three.module.min.js';\n// a three, from 'threes'\n"
    assert vendor.adapted(text, "LICENSE") == text
