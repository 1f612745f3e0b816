"""Challenges with known ground truths, and an evaluation of submissions in this process."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from slamhive.base.budget import BudgetShare
from slamhive.base.settings import Settings
from slamhive.documents.challenge import ChallengeSubmission
from slamhive.evaluation.job import EvaluationResult, EvaluationTask
from slamhive.services.challenges import ChallengeJudge, ChallengeService, Entrant

NOW = datetime(2026, 5, 4, 12, 0, 7, tzinfo=UTC)
START_S, RATE_HZ, POSES = 1000.0, 100.0, 300
OFFSET_M = (417.318529, -286.771043, 53.903217)
"""Where the ground truths lie: numbers that are nowhere else."""
FRAMES = 230

Array = np.ndarray[Any, np.dtype[np.float64]]


@dataclass
class Clock:
    """A clock that tests move."""

    now: datetime = NOW

    def __call__(self) -> datetime:
        return self.now

    def forward(self, **amount: float) -> None:
        self.now += timedelta(**amount)


class InThisProcess:
    """The evaluation engine without its process, which takes seconds to start."""

    def __init__(self) -> None:
        self.seen: list[str] = []

    def measure(
        self, tasks: Sequence[EvaluationTask], scratch: Path, stopping: threading.Event, cores: Any = None
    ) -> list[EvaluationResult]:
        from slamhive.evaluation.engine import evaluate  # noqa: PLC0415 - loads evo
        from slamhive.evaluation.references import References  # noqa: PLC0415

        if stopping.is_set():
            return []
        self.seen += [task.id for task in tasks]
        found = [evaluate(task, References()) for task in tasks]
        return [entry if isinstance(entry, EvaluationResult) else entry.result for entry in found]


def kept(folder: Path, files: Mapping[str, bytes]) -> dict[str, Path]:
    """The files of a submission by name, written into a new folder below ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    place = Path(tempfile.mkdtemp(dir=folder))
    for name, content in files.items():
        (place / name).write_bytes(content)
    return {name: place / name for name in files}


class ChallengesOfBytes(ChallengeService):
    """Challenges that take the contents of files, as tests make them."""

    def __init__(self, folder: Path, settings: Settings, clock: Clock) -> None:
        super().__init__(settings, clock)
        self._sent = folder / "sent"

    def submit(
        self,
        name: str,
        entrant: Entrant,
        files: Mapping[str, Any],
        phase: str | None = None,
        share: BudgetShare | None = None,
    ) -> ChallengeSubmission:
        return super().submit(name, entrant, kept(self._sent, files), phase, share)

    def check(self, name: str, files: Mapping[str, Any], phase: str | None = None) -> list[str]:
        return super().check(name, kept(self._sent, files), phase)


@dataclass
class World:
    """An empty data root with a clock of its own."""

    folder: Path
    clock: Clock = field(default_factory=Clock)

    def __post_init__(self) -> None:
        self.settings = Settings(data=self.folder / "data")
        self.settings.data.mkdir(parents=True, exist_ok=True)

    @property
    def challenges(self) -> ChallengesOfBytes:
        """As a process that has just started has them."""
        return ChallengesOfBytes(self.folder, self.settings, self.clock)

    def judge(self, stopping: threading.Event | None = None) -> int:
        """Evaluate what waits, and let the minute pass after which results are shown."""
        made: Any = InThisProcess()
        judge = ChallengeJudge(self.settings, made, self.clock)
        done = 0
        while more := judge.work_once(stopping or threading.Event()):
            done += more
        self.clock.forward(minutes=1)
        return done


def truth(number: int = 0, rate_hz: float = RATE_HZ) -> Array:
    """A TUM trajectory of shape (POSES, 8) that differs for each number."""
    count = POSES
    phase = np.linspace(0, 2 * np.pi, count) + number
    positions = np.stack([4 * np.sin(phase), 2 * np.sin(2 * phase), np.cos(phase)], axis=1) + OFFSET_M
    turned = np.stack([np.zeros(count), np.zeros(count), np.sin(phase / 4), np.cos(phase / 4)], axis=1)
    return np.column_stack([START_S + np.arange(count) / rate_hz, positions, turned])


def noisy(rows: Array, sigma_m: float, seed: int = 0) -> Array:
    """The trajectory with noise on its positions, moved to the origin as estimates are."""
    found = rows.copy()
    found[:, 1:4] += np.random.default_rng(seed).normal(0, sigma_m, (len(rows), 3)) - rows[0, 1:4]
    return found


def road(drift: float = 0.0) -> Array:
    """Rows of KITTI poses: FRAMES frames, a metre apart, whose heading drifts by so many rad in all."""
    heading = drift * np.linspace(0, 1, FRAMES)
    steps = np.stack([np.sin(heading), np.zeros(FRAMES), np.cos(heading)], axis=1)
    positions = np.cumsum(steps, axis=0) - steps[0]
    rows = np.zeros((FRAMES, 3, 4))
    rows[:, 0, 0] = rows[:, 2, 2] = np.cos(heading)
    rows[:, 0, 2], rows[:, 2, 0], rows[:, 1, 1] = np.sin(heading), -np.sin(heading), 1.0
    rows[:, :, 3] = positions
    return rows.reshape(FRAMES, 12)


def text(rows: Array) -> bytes:
    """The bytes of a text file of these rows."""
    stream = BytesIO()
    np.savetxt(stream, rows, fmt="%.9f")
    return stream.getvalue()


def rooms(count: int = 7, **more: Any) -> dict[str, Any]:
    """A challenge of so many rooms, with an open phase and a hidden one."""
    return {
        "format": 1,
        "name": "rooms",
        "title": "Rooms",
        "preset": "mean",
        "protocol": "evo",
        "metric": "ate.rmse",
        "worst": 1.0,
        "sequences": [
            {"name": f"room-{number}", "groundtruth": f"truth-{number}.txt", "time_range_s": [999.5, 1003.5]}
            for number in range(count)
        ],
        "phases": [
            {"name": "public", "ends": "2026-06-01T00:00:00+00:00"},
            {"name": "final", "begins": "2026-06-01T00:00:00+00:00", "scores": "at_end"},
        ],
        **more,
    }


def write_challenge(folder: Path, content: Mapping[str, Any]) -> Path:
    """The file of a challenge, with a ground truth for each of its sequences that names one."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, entry in enumerate(content["sequences"]):
        if "groundtruth" in entry and not (folder / entry["groundtruth"]).exists():
            rows = road() if content["preset"] == "kitti" else truth(number)
            (folder / entry["groundtruth"]).write_bytes(text(rows))
    path = folder / f"{content['name']}.yaml"
    path.write_text(yaml.safe_dump(dict(content), sort_keys=False))
    return path


def entry_of(count: int, sigma_m: float, seed: int = 0, wobble: float = 0.0) -> dict[str, bytes]:
    """The files of a submission to :func:`rooms`. With ``wobble`` every second room is better, and the others worse."""
    return {
        f"room-{number}.txt": text(
            noisy(truth(number), sigma_m * (1 + 0.1 * number) * (1 + wobble * (-1) ** number), 100 * seed + number)
        )
        for number in range(count)
    }
