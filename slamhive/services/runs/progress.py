"""The progress of a running run, from the files of its player and sampler."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.run import RunState
from slamhive.runs.folder import RunFolder
from slamhive.runs.untrusted import measured_number, read_regular_file, read_untrusted_json
from slamhive.store.records import RunRecord

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


def run_progress(run: RunRecord, folder: RunFolder, now: datetime, duration_s: float | None) -> RunProgress | None:
    """The progress of ``run``; None if no worker is executing it.

    ``duration_s`` is the duration of the recording, the lower bound of the time left in real-time playback.
    """
    if not run.state.active:
        return None
    elapsed_s = None if run.started_at is None else (now - run.started_at).total_seconds()
    fraction = _fraction(folder)
    cpu_cores, memory_bytes = _last_sample(folder)
    return RunProgress(
        fraction=fraction,
        elapsed_s=elapsed_s,
        left_s=_left_s(run, fraction, elapsed_s, duration_s),
        cpu_cores=cpu_cores,
        memory_bytes=memory_bytes,
        text=_doing(run, folder) if fraction is None else f"{fraction:.0%} of the recording",
    )


def untracked_s(folder: RunFolder) -> float | None:
    """How long the algorithm has found no pose, in s of the recording; None if it does not report that."""
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


def _left_s(run: RunRecord, fraction: float | None, elapsed_s: float | None, duration_s: float | None) -> float | None:
    if fraction is None or elapsed_s is None:
        return None
    if run.playback.mode is PlaybackMode.REALTIME and duration_s is not None:
        return (1 - fraction) * duration_s / run.playback.rate
    return elapsed_s * (1 / fraction - 1) if fraction > 0.01 else None


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
