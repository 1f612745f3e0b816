"""Packs what a pod executes, with the modules that it needs, into one file, which the Python of any image can run."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import slamhive

SUPERVISOR_MODULES = (
    "executors/host_counters.py",
    "executors/kubernetes/pod_counters.py",
    "executors/kubernetes/pod_files.py",
    "executors/kubernetes/supervisor.py",
    "executors/process/exit_file.py",
    "base/errors.py",
    "run_folder/host_columns.py",
)
_ON_NODE = "executors/node_store/on_node"
COURIER_MODULES = (
    "executors/kubernetes/courier.py",
    "executors/kubernetes/pod_files.py",
    *(f"{_ON_NODE}/{name}.py" for name in ("cache", "connection", "making", "results", "run")),
    "executors/packing.py",
    "executors/process/exit_file.py",
    "base/tree.py",
)
_MAIN = """\
import sys
from pathlib import Path
from slamhive.executors.kubernetes.{module} import main
sys.exit(main({argument}))
"""
_ALWAYS_THE_SAME = (1980, 1, 1, 0, 0, 0)


def supervisor_archive() -> bytes:
    """A file for ``python3 FILE FOLDER``, the same bytes each time."""
    return _pack(SUPERVISOR_MODULES, _MAIN.format(module="supervisor", argument="Path(sys.argv[1])"))


def courier_archive() -> bytes:
    """A file for ``python3 FILE (fetch|report)``, the same bytes each time."""
    return _pack(COURIER_MODULES, _MAIN.format(module="courier", argument="sys.argv[1]"))


def _pack(modules: tuple[str, ...], main: str) -> bytes:
    root = Path(slamhive.__file__).parent
    files = {f"slamhive/{name}": (root / name).read_text(encoding="utf-8") for name in modules}
    folders = {str(parent) for name in files for parent in Path(name).parents if parent != Path()}
    files |= {f"{folder}/__init__.py": "" for folder in folders}
    files["__main__.py"] = main
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in sorted(files.items()):
            archive.writestr(zipfile.ZipInfo(name, _ALWAYS_THE_SAME), text, zipfile.ZIP_DEFLATED)
    return packed.getvalue()
