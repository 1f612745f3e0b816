"""The process that computes one analysis, or previews of one: ``python -m slamhive.services.analysis_process FOLDER``.

It reads the settings from the first line of its input, limits its own resources, and prints the result as one line of
JSON. It ends when its input closes, because the process that started it is gone then.

It lies outside the packages of use cases and imports inside functions, so that the limits hold for its imports, too.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import sys
import threading
from pathlib import Path
from typing import Any

from slamhive.base.clock import monotonic_s

MAX_FILE_BYTES = 1_000_000_000
PROGRESS_INTERVAL_S = 0.3
UNMAPPED = "failed to map segment"
"""What the dynamic loader says of a library for which there is no memory. Much may be left: the library is large."""


def main() -> int:
    """Compute the analysis; returns 0 if there is a report, 1 if there is an error."""
    asked = json.loads(sys.stdin.readline())
    limit_process(asked["memory_bytes"], asked["time_limit_s"])

    def end_with_input() -> None:
        sys.stdin.read()
        os._exit(2)

    threading.Thread(target=end_with_input, daemon=True).start()
    too_large = f"the analysis needs more than {asked['memory_bytes'] // 10**6} MB of memory"
    try:
        make = _preview if "preview_runs" in asked else _compute
        outcome = {"content_hash": make(asked, Path(sys.argv[1]))}
    except MemoryError:
        outcome = {"error": too_large}
    except Exception as error:
        from slamhive.base.errors import SlamHiveError  # noqa: PLC0415 - the limits hold for what is imported, too

        if isinstance(error, SlamHiveError):
            outcome = {"error": str(error)}
        elif _memory_ran_out(error, asked["memory_bytes"]):
            outcome = {"error": too_large}
        else:
            raise
    sys.stdout.write(json.dumps(outcome) + "\n")
    return int("error" in outcome)


def limit_process(memory_bytes: int, time_limit_s: float) -> None:
    """Limit address space, CPU time and file sizes, and lower the priority."""
    cpu_s = int(2 * time_limit_s) + 10
    for kind, most in (
        (resource.RLIMIT_AS, memory_bytes),
        (resource.RLIMIT_CPU, cpu_s),
        (resource.RLIMIT_FSIZE, MAX_FILE_BYTES),
        (resource.RLIMIT_CORE, 0),
    ):
        _, hard = resource.getrlimit(kind)
        allowed = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (allowed, allowed))
    os.nice(10)


def _opened(asked: dict[str, Any]) -> tuple[Any, Any, Any]:
    """Settings, store, and what computes analyses."""
    from slamhive.base.settings_sources import load_settings  # noqa: PLC0415
    from slamhive.services.analysis import AnalysisService  # noqa: PLC0415
    from slamhive.services.datasets import Catalogue  # noqa: PLC0415
    from slamhive.services.searches import Searches  # noqa: PLC0415
    from slamhive.store.store import open_store  # noqa: PLC0415

    settings = load_settings(Path(asked["project_root"]), environment={}, options=asked["settings"])
    store = open_store(settings.effective_database_url, settings.database_retry_s, upgrade=False)
    catalogue = Catalogue(settings, Path(asked["project_root"]))
    return settings, store, AnalysisService(settings, store, catalogue, Searches(settings, store, catalogue))


def _preview(asked: dict[str, Any], root: Path) -> str:
    """Small pictures of the first plots, over some of the runs that the viewer may see."""
    from slamhive.base.files import write_aside  # noqa: PLC0415
    from slamhive.domain.accounts import Viewer  # noqa: PLC0415
    from slamhive.services.analysis import AnalysisLimits, previews_of  # noqa: PLC0415
    from slamhive.services.stored_analyses import PREVIEWS, AnalysisFolder  # noqa: PLC0415

    settings, store, analyses = _opened(asked)
    limits = AnalysisLimits(settings.analysis_max_runs, asked["time_limit_s"], sample=asked["preview_runs"])
    with store.seen_by(None if asked["viewer"] is None else Viewer(**asked["viewer"]), asked["owner"]):
        analysis = analyses.read(AnalysisFolder(root).source).first(asked["preview_plots"])
        write_aside(root / PREVIEWS, json.dumps(previews_of(analyses.compute(analysis, limits))))
    return ""


def _compute(asked: dict[str, Any], root: Path) -> str:
    from slamhive.domain.accounts import viewer_of  # noqa: PLC0415
    from slamhive.packages.published.knowledge import HERE  # noqa: PLC0415
    from slamhive.services.analysis import AnalysisLimits, figures_json, page_of  # noqa: PLC0415
    from slamhive.services.stored_analyses import FIGURES, PAGE, REPORT, AnalysisFolder  # noqa: PLC0415

    folder = AnalysisFolder(root)
    settings, store, analyses = _opened(asked)
    tell = _Teller(folder)
    tell(0.0, "reading the file")
    # Its numbers were checked when it was stored; analyses of older versions say nothing about them.
    analysis = analyses.read(folder.source, ids={HERE: HERE})
    # It shows what each of its readers may see.
    audience = asked["audience"]
    with store.seen_by(None if audience is None else viewer_of(audience), asked["owner"]):
        digest = hashlib.sha256(f"{asked['version']}\n{analyses.fingerprint(analysis)}\n".encode())
        digest.update(analysis.source.encode())
        content_hash = digest.hexdigest()
        for token in store.read(lambda t: t.analyses.same(content_hash)):
            other = AnalysisFolder(root.parent / token)
            if token != root.name and other.whole:
                folder.link_results(other)
                return content_hash
        limits = AnalysisLimits(settings.analysis_max_runs, settings.analysis_time_limit_s)
        report = analyses.compute(analysis, limits, lambda share, doing: tell(0.8 * share, doing))
        tell(0.8, "drawing")
        folder.write_result(FIGURES, figures_json(report))
        tell(0.9, "storing")
        folder.write_result(PAGE, page_of(report).content)
        folder.write_result(REPORT, report.content)
        return content_hash


class _Teller:
    """Writes the progress at most every `PROGRESS_INTERVAL_S`."""

    def __init__(self, folder: Any) -> None:
        self._folder = folder
        self._next_s = 0.0

    def __call__(self, share: float, doing: str) -> None:
        if monotonic_s() >= self._next_s:
            self._next_s = monotonic_s() + PROGRESS_INTERVAL_S
            self._folder.write_progress(share, doing)


def _memory_ran_out(error: BaseException, memory_bytes: int) -> bool:
    """Tell if the process lacked memory: the dynamic loader says so, or the process has come close to its limit.

    An import that finds no memory may raise anything, and pandas puts an error of its own before that of the loader.
    """
    behind: BaseException | None = error
    while behind is not None:
        if UNMAPPED in str(behind):
            return True
        behind = behind.__cause__ or behind.__context__
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return False
    peak_kb = next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmPeak:")), 0)
    return peak_kb * 1024 > 0.9 * memory_bytes


if __name__ == "__main__":
    sys.exit(main())
