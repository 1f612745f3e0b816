"""An archive of 2,000 runs: out, into an empty and into a filled installation, and compared; then as a site.

    python benchmarks/archive.py [RUNS] [POSES]

Prints seconds of wall clock and of CPU time, sizes, and the largest memory use of the process.
"""

from __future__ import annotations

import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from slamhive.services.archive.exporting import ExportRequest, export_archive
from slamhive.services.archive.importing import ArchiveImport
from slamhive.services.hive import Hive, open_hive
from slamhive.web.static_site import SiteRequest, StaticSite
from tests.services.archive_world import all_files, all_rows, make_runs
from tests.services.tiny_project import environment, make_dataset, make_project

T = TypeVar("T")
CHECKOUT = Path(__file__).resolve().parents[1]
FILLED = 200


def timed(what: str, work: Callable[[], T]) -> T:
    """What ``work`` returns; a line with what it took."""
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    result = work()
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    print(f"{what:<44} {wall_s:8.1f} s wall {cpu_s:8.1f} s CPU {peak_mb:8.0f} MB most", flush=True)
    return result


def open_at(root: Path, name: str) -> Hive:
    """An installation of the test project."""
    os.environ.update(environment(root / "project", root / name))
    return open_hive()


def main(runs: int, poses: int) -> None:
    """Print one line for each step."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        (make_project(root / "project") / "templates").rmdir()
        for name in ("templates", "static"):
            (root / "project" / name).symlink_to(CHECKOUT / name)
        make_dataset(root / "data")
        hive = open_at(root, "data")
        timed(f"{runs} runs of {poses} poses made and filed", lambda: make_runs(hive, runs, poses=poses))
        path = root / "a.zip"
        timed(
            "exported",
            lambda: export_archive(hive.settings, hive.store, ExportRequest(path), lambda _done, _total: None),
        )
        files = all_files(hive)
        print(f"{len(files)} files, {sum(map(len, files.values())) / 1e6:.0f} MB; {path.stat().st_size / 1e6:.0f} MB")
        rows = all_rows(hive)
        empty = open_at(root, "empty")
        timed("imported into an empty installation", lambda: import_into(empty, path))
        print("equal:", all_rows(empty) == rows and all_files(empty) == files)
        filled = open_at(root, "filled")
        make_runs(filled, FILLED, salt=9)
        timed(f"imported into one with {FILLED} runs", lambda: import_into(filled, path))
        there = all_rows(filled)
        same = all(set(rows[name]) <= set(there[name]) for name in ("runs", "events", "evaluations", "figures"))
        print("equal:", same and files.items() <= all_files(filled).items())
        timed("imported once more", lambda: import_into(filled, path))
        site = StaticSite(hive, SiteRequest(root / "site"))
        timed("written as a site", lambda: site.write(lambda _done, _total: None))
        size = sum(entry.stat().st_size for entry in (root / "site").rglob("*") if entry.is_file())
        print(f"the site has {size / 1e6:.0f} MB")
        for opened in (hive, empty, filled):
            opened.close()


def import_into(hive: Hive, path: Path) -> None:
    """Import, without progress."""
    ArchiveImport(hive.settings, hive.store, hive.catalogue).carry_out(path, lambda _share, _text: None)


if __name__ == "__main__":
    main(*(int(text) for text in [*sys.argv[1:], "2000", "600"][:2]))
