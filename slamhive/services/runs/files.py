"""The files of a run folder that can be downloaded: known names only, never a path from a request."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import BinaryIO

from slamhive.base.errors import NotFound
from slamhive.documents.run import EvaluationDocument, RunWith, ShownEvent
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.protocol import TrajectoryKind
from slamhive.domain.run import RunEvent, RunState
from slamhive.run_folder.folder import EVALUATION_FILES, RunFolder
from slamhive.run_folder.point_cloud import MapCloud, map_size, sampled_cloud, thinned_cloud
from slamhive.run_folder.untrusted import (
    FloatArray,
    measured_number,
    open_regular_file,
    read_regular_file,
    read_untrusted_json,
)
from slamhive.services.evaluations import evaluation_notes
from slamhive.services.kept_answers import KeptViews
from slamhive.store.records import EvaluationRecord, EvaluationState, RunRecord
from slamhive.trajectory.alignment import Similarity

_MEDIA_TYPES = {
    ".json": "application/json",
    ".tum": "text/plain; charset=utf-8",
    ".csv": "text/csv; charset=utf-8",
    ".zip": "application/zip",
    ".png": "image/png",
}


@dataclass(frozen=True, slots=True)
class Download:
    """One existing file. ``key`` is its name in the URL, ``name`` its name on the user's disk."""

    key: str
    name: str
    path: Path
    media_type: str
    size_bytes: int


def list_downloads(folder: RunFolder, fingerprints: Iterable[str]) -> tuple[Download, ...]:
    """The known files of the run that exist and are regular files, not links."""
    found = []
    for key, path, media_type in _known(folder, fingerprints):
        try:
            status = os.lstat(path)
        except OSError:
            continue
        if stat.S_ISREG(status.st_mode):
            found.append(Download(key, path.name, path, media_type, status.st_size))
    return tuple(found)


def open_download(folder: RunFolder, fingerprints: Iterable[str], key: str) -> tuple[Download, BinaryIO]:
    """Open the file with this key, without following links; raises NotFound."""
    for download in list_downloads(folder, fingerprints):
        if download.key == key:
            stream = open_regular_file(download.path)
            if stream is None:
                break
            return download, stream
    raise NotFound(f"there is no file {key!r} in this run", "its page lists the files")


def _known(folder: RunFolder, fingerprints: Iterable[str]) -> list[tuple[str, Path, str]]:
    text = "text/plain; charset=utf-8"
    table = "text/csv; charset=utf-8"
    known = [
        (path.name, path, media_type)
        for path, media_type in (
            (folder.record, "application/json"),
            (folder.config, "application/yaml"),
            (folder.log, text),
            (folder.trajectory, text),
            *((folder.trajectory_of(kind), text) for kind in TrajectoryKind),
            (folder.frames, table),
            (folder.profiling, table),
            (folder.host, table),
            (folder.gpu, table),
            (folder.profiling_cpu_plot, "image/png"),
            (folder.profiling_ram_plot, "image/png"),
            (folder.playback, "application/json"),
            (folder.about, "application/json"),
            (folder.map, "application/octet-stream"),
            (folder.grid, "image/png"),
        )
    ]
    for fingerprint in fingerprints:
        place = folder.evaluation(fingerprint)
        known += [(f"{fingerprint}-{name}", place / name, _MEDIA_TYPES[Path(name).suffix]) for name in EVALUATION_FILES]
    return known


# Saved maps for a screen, thinned on demand.


_CACHE_BYTES = 32_000_000
REFERENCE_POINTS = 500_000
"""A reference map is thinned to so many points before a map is compared with it."""


@dataclass(frozen=True, slots=True)
class _Key:
    """A file as it is now, and what was made of it."""

    path: Path
    modified_ns: int
    size_bytes: int
    what: str


class MapViews:
    """Points of saved maps.

    Those shown last are kept in memory, up to 32 MB: folders of runs are records, and an archive may be read-only. At
    most two maps are read at once, so visitors wait, and runs keep their CPU.
    """

    def __init__(self) -> None:
        self._kept: KeptViews[_Key, MapCloud] = KeptViews(_CACHE_BYTES, lambda cloud: cloud.size_bytes)

    def size(self, path: Path, name: str) -> int:
        """Number of points of the map at ``path``, from its header.

        Raises NotFound without the file, InvalidInput for one that cannot be used.
        """
        return map_size(path, name)

    def sample(self, path: Path, name: str) -> MapCloud:
        """A quick sample of its points; raises as :meth:`size`."""
        return self._cloud(path, name, "sample", sampled_cloud)

    def thinned(self, path: Path, name: str) -> MapCloud:
        """At most one point in each voxel; raises as :meth:`size`."""
        return self._cloud(path, name, "thinned", thinned_cloud)

    def compared(self, path: Path, name: str, reference: Path, to_reference: Similarity) -> MapCloud:
        """The thinned points with their distance to the nearest point of the reference map.

        ``to_reference`` moves the map to the frame of the reference. Raises as :meth:`size`, also for the reference.
        """
        thinned = self.thinned(path, name)
        against = _key(reference, reference.name, to_reference.matrix.tobytes().hex())

        def read(_path: Path, _name: str) -> MapCloud:
            known = thinned_cloud(reference, reference.name, REFERENCE_POINTS).positions_m
            from scipy.spatial import cKDTree  # noqa: PLC0415 - slow to load, and few maps have a reference

            # From each point to the nearest of the reference, shape (n,).
            errors_m: FloatArray = cKDTree(known).query(to_reference.points(thinned.positions_m))[0]
            return replace(thinned, errors_m=errors_m)

        return self._cloud(path, name, str(against), read)

    def _cloud(self, path: Path, name: str, what: str, read: Callable[[Path, str], MapCloud]) -> MapCloud:
        return self._kept.get(_key(path, name, what), lambda: read(path, name))


def _key(path: Path, name: str, what: str) -> _Key:
    try:
        status = os.lstat(path)
    except OSError:
        raise NotFound(f"there is no file {name}") from None
    return _Key(path, status.st_mtime_ns, status.st_size, what)


# The documents of a run that need its folder.


def run_in_full(
    run: RunRecord, folder: RunFolder, evaluations: Sequence[EvaluationRecord], events: Sequence[RunEvent]
) -> RunWith:
    """A run with its moves and evaluations."""
    return RunWith.of(
        run,
        evaluations=[evaluation_document(entry, folder) for entry in evaluations],
        events=[ShownEvent.of(event) for event in events],
    )


def evaluation_document(evaluation: EvaluationRecord, folder: RunFolder) -> EvaluationDocument:
    """One evaluation. Its hints lie in the run folder, for the last evaluation under a protocol."""
    succeeded = evaluation.state is EvaluationState.SUCCEEDED
    notes = evaluation_notes(folder, evaluation.protocol.fingerprint if succeeded else None)
    return EvaluationDocument.of(evaluation, hints=notes.hints)


# The progress of a running run, from the files of its player and sampler.


_PROGRESS_LIMIT_BYTES = 4096
_TAIL_BYTES = 400


@dataclass(frozen=True, slots=True)
class RunProgress:
    """Progress of one active run. ``fraction`` is None while the recording has not started to play."""

    fraction: float | None
    elapsed_s: float | None
    left_s: float | None
    cpu_cores: float | None
    memory_bytes: int | None
    text: str
    dropped: int | None = None
    """Frames that were dropped so far; None before the recording plays."""


def run_progress(run: RunRecord, folder: RunFolder, now: datetime, duration_s: float | None) -> RunProgress | None:
    """The progress of ``run``; None if no worker is executing it.

    ``duration_s`` is the duration of the recording, the lower bound of the time left in real-time playback.
    """
    if not run.state.active:
        return None
    elapsed_s = None if run.started_at is None else (now - run.started_at).total_seconds()
    fraction = _fraction(folder)
    left_s = None
    if fraction is not None and elapsed_s is not None:
        if run.playback.mode is PlaybackMode.REALTIME and duration_s is not None:
            left_s = (1 - fraction) * duration_s / run.playback.rate
        elif fraction > 0.01:
            left_s = elapsed_s * (1 / fraction - 1)
    cpu_cores, memory_bytes = _last_sample(folder)
    dropped = measured_number((read_untrusted_json(folder.progress, _PROGRESS_LIMIT_BYTES) or {}).get("dropped"))
    return RunProgress(
        fraction=fraction,
        elapsed_s=elapsed_s,
        left_s=left_s,
        cpu_cores=cpu_cores,
        memory_bytes=memory_bytes,
        text=_doing(run, folder) if fraction is None else f"{fraction:.0%} of the recording",
        dropped=None if dropped is None else int(dropped),
    )


def untracked_s(folder: RunFolder) -> float | None:
    """Time without a pose, in s of the recording; None if the algorithm does not report that."""
    content = read_untrusted_json(folder.progress, _PROGRESS_LIMIT_BYTES) or {}
    return measured_number(content.get("untracked_s"))


def _doing(run: RunRecord, folder: RunFolder) -> str:
    """The activity of a run whose recording does not play yet."""
    line = read_regular_file(folder.preparation, _TAIL_BYTES) if run.state is RunState.PREPARING else None
    text = "".join(letter for letter in (line or b"").decode(errors="replace").strip() if letter.isprintable())
    return f"{run.state.value}: {text}" if text else run.state.value


def _fraction(folder: RunFolder) -> float | None:
    content = read_untrusted_json(folder.progress, _PROGRESS_LIMIT_BYTES) or {}
    fraction = measured_number(content.get("fraction"))
    return None if fraction is None else min(fraction, 1.0)


def _last_sample(folder: RunFolder) -> tuple[float | None, int | None]:
    """CPU (cores) and memory (bytes) from the last complete line of ``profiling.csv``."""
    try:
        with folder.profiling.open("rb") as stream:
            stream.seek(0, 2)
            stream.seek(max(0, stream.tell() - _TAIL_BYTES))
            lines = stream.read().split(b"\n")[:-1]
    except OSError:
        return None, None
    for line in reversed(lines):
        parts = line.split(b",")
        try:
            return float(parts[1]), int(float(parts[2]))
        except (ValueError, IndexError, OverflowError):
            continue
    return None, None
