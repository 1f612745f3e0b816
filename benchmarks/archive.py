"""An archive of 2,000 runs: out, into an empty and into a filled installation, and compared; then as a site.

    python benchmarks/archive.py [RUNS] [POSES]

A run of 4,000 poses has a folder of 600 kB. Prints seconds of wall time and of CPU time, and the largest memory use
of the process. Both depend on the machine, so it also prints the ratio to a plain copy. That packs and unpacks
the same folders with tarfile (gzip, level 1), with the SHA-256 of every file both times.
Asked: 2,000 runs out and in again in under 2 minutes.
"""

from __future__ import annotations

import hashlib
import os
import resource
import shutil
import sys
import tarfile
import tempfile
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from slamhive.base.tree import unpack_trusted
from slamhive.services.archive.exporting import ExportRequest, export_archive
from slamhive.services.archive.importing import ArchiveImport
from slamhive.services.archive.layout import CHECKSUMS
from slamhive.services.hive import Hive, open_hive
from slamhive.web.static_site import SiteRequest, StaticSite
from tests.services.archive_world import all_files, all_rows, make_runs
from tests.services.tiny_project import environment, make_dataset, make_project

CHECKOUT = Path(__file__).resolve().parents[1]
FILLED = 200


@dataclass(frozen=True)
class Took:
    """Seconds of wall clock and of CPU time."""

    wall_s: float
    cpu_s: float


def timed(what: str, work: Callable[[], object], plain: Took | None = None) -> Took:
    """Resources that ``work`` took; a line with them, and with the ratio to ``plain``."""
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    work()
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
    took = Took(time.perf_counter() - wall_s, time.process_time() - cpu_s)
    ratio = "" if plain is None else f"  {took.wall_s / plain.wall_s:5.2f} {took.cpu_s / plain.cpu_s:5.2f} of plain"
    print(f"{what:<44} {took.wall_s:8.1f} s wall {took.cpu_s:8.1f} s CPU {peak_mb:6.0f} MB{ratio}", flush=True)
    return took


def pack(folder: Path, path: Path) -> None:
    """The plain copy, out."""
    with tarfile.open(path, "w:gz", compresslevel=1) as archive:
        for file in sorted(entry for entry in folder.rglob("*") if entry.is_file()):
            hashlib.sha256(file.read_bytes())
            archive.add(file, str(file.relative_to(folder)))


def unpack(path: Path, folder: Path) -> None:
    """The plain copy, in."""
    with tarfile.open(path) as archive:
        unpack_trusted(archive, folder)
    for file in sorted(entry for entry in folder.rglob("*") if entry.is_file()):
        hashlib.sha256(file.read_bytes())


def hashes(hive: Hive) -> dict[str, str]:
    """The SHA-256 of every file of a run."""
    return {name: hashlib.sha256(content).hexdigest() for name, content in all_files(hive)}


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
        print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
        packing = timed("plain copy, packed", lambda: pack(hive.settings.runs_folder, root / "plain.tgz"))
        unpacking = timed("plain copy, unpacked", lambda: unpack(root / "plain.tgz", root / "plain"))
        shutil.rmtree(root / "plain")
        out = timed("exported", lambda: export_to(hive, path), packing)
        files, rows = hashes(hive), all_rows(hive)
        print(f"{len(files)} files; the archive has {path.stat().st_size / 1e6:.0f} MB")
        empty = open_at(root, "empty")
        into = timed("imported into an empty installation", lambda: import_into(empty, path), unpacking)
        print("equal:", all_rows(empty) == rows and hashes(empty) == files)
        print(f"out and in: {out.wall_s + into.wall_s:.0f} s wall, {out.cpu_s + into.cpu_s:.0f} s CPU")
        export_to(empty, root / "b.zip")
        print("exported again, equal:", checksums(root / "b.zip") == checksums(path))
        empty.close()
        filled = open_at(root, "filled")
        make_runs(filled, FILLED, salt=9)
        timed(f"imported into one with {FILLED} runs", lambda: import_into(filled, path), unpacking)
        there = all_rows(filled)
        same = all(set(rows[name]) <= set(there[name]) for name in ("runs", "events", "evaluations", "figures"))
        print("equal:", same and files.items() <= hashes(filled).items())
        timed("imported once more", lambda: import_into(filled, path), unpacking)
        site = StaticSite(hive, SiteRequest(root / "site"))
        first = timed("written as a site", lambda: site.write(lambda _done, _total: None))
        again = StaticSite(hive, SiteRequest(root / "site"))
        second = timed("written as a site again", lambda: again.write(lambda _done, _total: None))
        print(f"{again.kept} pages taken over, in {second.wall_s / first.wall_s:.2f} of the time")
        size = sum(entry.stat().st_size for entry in (root / "site").rglob("*") if entry.is_file())
        print(f"the site has {size / 1e6:.0f} MB")
        for opened in (hive, filled):
            opened.close()


def export_to(hive: Hive, path: Path) -> None:
    """Export all, without progress."""
    export_archive(hive.settings, hive.store, ExportRequest(path), lambda _done, _total: None)


def checksums(path: Path) -> bytes:
    """The checksums of the payload; the other members hold the time of the export."""
    with zipfile.ZipFile(path) as archive:
        return archive.read(f"{path.stem}/{CHECKSUMS}")


def import_into(hive: Hive, path: Path) -> None:
    """Import, without progress."""
    ArchiveImport(hive.settings, hive.store, hive.catalogue).carry_out(path, lambda _share, _text: None)


if __name__ == "__main__":
    main(*(int(text) for text in [*sys.argv[1:], *("2000", "4000")[len(sys.argv) - 1 :]]))
