"""Packs the supervisor and the modules that it needs into one file, which the Python of any image can run."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import slamhive

MODULES = (
    "executors/host_counters.py",
    "executors/kubernetes/pod_counters.py",
    "executors/kubernetes/supervisor.py",
    "executors/process/capped_log.py",
    "executors/process/exit_file.py",
    "runs/host_columns.py",
)
_MAIN = """\
import sys
from pathlib import Path
from slamhive.executors.kubernetes.supervisor import main
sys.exit(main(Path(sys.argv[1])))
"""
_ALWAYS_THE_SAME = (1980, 1, 1, 0, 0, 0)


def supervisor_archive() -> bytes:
    """A file for ``python3 FILE FOLDER``, the same bytes each time."""
    root = Path(slamhive.__file__).parent
    files = {f"slamhive/{name}": (root / name).read_text(encoding="utf-8") for name in MODULES}
    folders = {str(parent) for name in files for parent in Path(name).parents if parent != Path()}
    files |= {f"{folder}/__init__.py": "" for folder in folders}
    files["__main__.py"] = _MAIN
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, text in sorted(files.items()):
            archive.writestr(zipfile.ZipInfo(name, _ALWAYS_THE_SAME), text)
    return packed.getvalue()
