"""Modules of a package whose ``__init__`` needs what is not installed."""

from __future__ import annotations

import sys

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.runtime.bare_package import import_bare

pytestmark = pytest.mark.quick


def test_a_module_is_imported_without_its_package_running(tmp_path, monkeypatch):
    package = tmp_path / "heavy_package"
    package.mkdir()
    (package / "__init__.py").write_text("import a_module_that_is_not_installed\n")
    (package / "native.py").write_text("value = 7\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert import_bare("heavy_package", "native").value == 7
    for name in ("heavy_package", "heavy_package.native"):
        del sys.modules[name]


def test_a_package_that_is_not_installed_is_said(monkeypatch):
    with pytest.raises(InvalidInput, match="the Python package no_such_package is not installed"):
        import_bare("no_such_package", "native")
