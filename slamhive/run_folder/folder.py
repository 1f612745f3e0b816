"""The run folder: the only place that knows its file names.

``<data>/runs/<id>/`` belongs to the controller; ``result/`` below it is what the container may write to. They are
apart so that an algorithm can neither forge its provenance nor break a sealed record.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slamhive.base.bounds import read_record
from slamhive.base.errors import NotFound, Unavailable
from slamhive.base.files import write_aside
from slamhive.domain.accounts import Sharing
from slamhive.domain.protocol import TrajectoryKind
from slamhive.domain.run import NO_NOTES, RunNotes
from slamhive.runtime.localisation import LOCALISATION_FILE
from slamhive.runtime.paths import TRAJECTORY_FILES

_FINGERPRINT_CHARACTERS = 32

EVALUATION_FILES = (
    "result.json",
    "traj.tum",
    "groundtruth.tum",
    "errors.csv",
    "ape.zip",
    "rpe.zip",
    *(f"traj_{kind}.png" for kind in ("trajectories", "xyz", "rpy", "speeds")),
    *(f"{kind}_{name}.png" for kind in ("ape", "rpe") for name in ("raw", "map")),
)
"""What an evaluation writes beside ``protocol.json``, which it is asked with."""
TRAVELLING = frozenset(
    {
        "run.json",
        "notes.json",
        "config.yaml",
        "log.txt",
        "profiling.csv",
        "energy.csv",
        "host.csv",
        "gpu.csv",
        "profiling_cpu.png",
        "profiling_ram.png",
        "preparation.txt",
        "kitti_poses.txt",
    }
)
"""The files of a run folder that archives hold, besides the result and the evaluations."""
STAYING = frozenset({"sharing.json", "work"})
"""What never leaves an installation or comes into one: who owns and sees the run, and what its executor works with."""
_EVALUATION = re.compile(r"evaluations/(?:current|[0-9a-f]{12}/(?P<file>[^/]+))")


def travels(name: str) -> bool:
    """Return whether archives hold the file called ``name`` below a run folder: a closed list, on the way out and in.

    What an algorithm left in its result may have any name.
    """
    if name in TRAVELLING or name.startswith("result/"):
        return True
    evaluation = _EVALUATION.fullmatch(name)
    return evaluation is not None and evaluation["file"] in (None, "protocol.json", *EVALUATION_FILES)


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Paths of one run. Creating the value touches nothing; :meth:`create` makes the folders."""

    root: Path

    @property
    def record(self) -> Path:
        """``run.json``: request, provenance and outcome; enough to rebuild the database row."""
        return self.root / "run.json"

    @property
    def notes(self) -> Path:
        """``notes.json``: note and tags that people gave the run."""
        return self.root / "notes.json"

    @property
    def sharing(self) -> Path:
        """``sharing.json``: owner and visibility. What it does not state, the experiment of the run does."""
        return self.root / "sharing.json"

    @property
    def config(self) -> Path:
        """``config.yaml``: the exact bytes mounted into the container."""
        return self.root / "config.yaml"

    @property
    def log(self) -> Path:
        """``log.txt``: what the run printed."""
        return self.root / "log.txt"

    @property
    def profiling(self) -> Path:
        """``profiling.csv``: ``time,cpu_usage,memory_usage`` in s since start, cores, bytes."""
        return self.root / "profiling.csv"

    @property
    def energy(self) -> Path:
        """``energy.csv``: ``time,package,energy_uj,range_uj``: the machine's energy counters, or why there are none."""
        return self.root / "energy.csv"

    @property
    def host(self) -> Path:
        """``host.csv``: the load of the machine during the run, see :mod:`slamhive.run_folder.profiling`."""
        return self.root / "host.csv"

    @property
    def gpu(self) -> Path:
        """``gpu.csv``: ``time,memory_bytes,utilisation`` of the run's GPU, or why it is not measured."""
        return self.root / "gpu.csv"

    @property
    def profiling_cpu_plot(self) -> Path:
        """``profiling_cpu.png``."""
        return self.root / "profiling_cpu.png"

    @property
    def profiling_ram_plot(self) -> Path:
        """``profiling_ram.png``."""
        return self.root / "profiling_ram.png"

    @property
    def preparation(self) -> Path:
        """``preparation.txt``: the last line of what is built or made for the run, while it is prepared."""
        return self.root / "preparation.txt"

    @property
    def work(self) -> Path:
        """Scratch space of the executor; may be removed once the run has ended."""
        return self.root / "work"

    @property
    def kitti_poses(self) -> Path:
        """``kitti_poses.txt``: the estimate of a run that was imported from KITTI format, as that file has it."""
        return self.root / "kitti_poses.txt"

    @property
    def result(self) -> Path:
        """The folder that the container sees as ``/slamhive/result``."""
        return self.root / "result"

    @property
    def trajectory(self) -> Path:
        """``result/traj.txt``: the estimate, TUM format."""
        return self.result / "traj.txt"

    def trajectory_of(self, kind: TrajectoryKind) -> Path:
        """The file of a further trajectory: ``traj.live.txt``, ``traj.final.txt`` or ``keyframe.txt``."""
        return self.result / TRAJECTORY_FILES[kind]

    @property
    def covariances(self) -> Path:
        """``result/covariances.txt``: the covariance of each pose, if the algorithm gives any."""
        return self.result / "covariances.txt"

    @property
    def map(self) -> Path:
        """``result/Map.pcd``: the map, if the algorithm saves one."""
        return self.result / "Map.pcd"

    @property
    def localisation(self) -> Path:
        """``result/localisation.json``: how a run that started with a map has found itself in it."""
        return self.result / LOCALISATION_FILE

    @property
    def finished(self) -> Path:
        """``result/finished``: the algorithm says that nothing more will be written."""
        return self.result / "finished"

    @property
    def frames(self) -> Path:
        """``result/frames.csv``: ``timestamp,received,done,dropped`` per input message."""
        return self.result / "frames.csv"

    @property
    def playback(self) -> Path:
        """``result/playback.json``: what the player sent, dropped, its lag and its own CPU time."""
        return self.result / "playback.json"

    @property
    def progress(self) -> Path:
        """``result/progress.json``: how far the player is, while it plays."""
        return self.result / "progress.json"

    @property
    def about(self) -> Path:
        """``result/about.json``: what the algorithm says of itself (vocabulary used, package version)."""
        return self.result / "about.json"

    @property
    def grid(self) -> Path:
        """``result/grid.png``: a picture of the map, if the algorithm gives one."""
        return self.result / "grid.png"

    @property
    def contract_files(self) -> tuple[Path, ...]:
        """The files in ``result/`` that the container contract names, the most important first."""
        own = (self.trajectory, self.finished, self.about, self.playback, self.progress, self.frames)
        further = (self.trajectory_of(kind) for kind in TrajectoryKind)
        return (*own, self.covariances, *further, self.grid, self.map)

    @property
    def watched_files(self) -> tuple[Path, ...]:
        """The files in ``result/`` that are read while the run goes on."""
        return (self.finished, self.progress, self.frames)

    def evaluation(self, fingerprint: str) -> Path:
        """The folder of the evaluation under the protocol with this fingerprint."""
        return self.root / "evaluations" / fingerprint

    @property
    def current_protocol(self) -> Path:
        """``evaluations/current``: the fingerprint of the protocol whose metrics pages show for the run."""
        return self.root / "evaluations" / "current"

    def create(self) -> None:
        """Make the folders; fine if they exist. Raises Unavailable if the disk refuses."""
        try:
            for folder in (self.root, self.result, self.work):
                folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise Unavailable(f"{self.root} cannot be made: {error.strerror}", "check space and rights") from None

    def write_record(self, record: dict[str, Any]) -> None:
        """Replace ``run.json`` in one step."""
        write_aside(self.record, self.record_text(record))

    @staticmethod
    def record_text(record: dict[str, Any]) -> str:
        """The content of ``run.json`` for ``record``."""
        return json.dumps(record, indent=1, allow_nan=False) + "\n"

    def write_notes(self, notes: RunNotes) -> None:
        """Replace ``notes.json`` in one step."""
        write_aside(self.notes, json.dumps(notes.content, indent=1, ensure_ascii=False) + "\n")

    def read_notes(self) -> RunNotes:
        """Note and tags; empty without the file. Raises InvalidInput for a file that cannot be used."""
        return RunNotes.of(read_record(self.notes)) if self.notes.exists() else NO_NOTES

    def write_sharing(self, sharing: Sharing) -> None:
        """Replace ``sharing.json`` in one step."""
        write_aside(self.sharing, json.dumps(sharing.content, indent=1) + "\n")

    def read_sharing(self) -> Sharing | None:
        """Owner and visibility; None without the file. Raises InvalidInput for a file that cannot be used."""
        return Sharing.of(read_record(self.sharing)) if self.sharing.exists() else None

    def write_current_protocol(self, fingerprint: str) -> None:
        """Replace ``evaluations/current`` in one step."""
        write_aside(self.current_protocol, fingerprint + "\n")

    def read_current_protocol(self) -> str | None:
        """The fingerprint in ``evaluations/current``; None if there is none that can be read."""
        try:
            return self.current_protocol.read_text(encoding="utf-8")[:_FINGERPRINT_CHARACTERS].strip()
        except (OSError, UnicodeDecodeError):
            return None

    def read_record(self) -> dict[str, Any]:
        """The content of ``run.json``; raises NotFound or InvalidInput."""
        if not self.record.exists():
            raise NotFound(f"{self.record} does not exist")
        return read_record(self.record)
