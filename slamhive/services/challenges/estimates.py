"""The trajectories of a submission that can be evaluated, and why others cannot."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from slamhive.domain.challenge import Format, RunFailure
from slamhive.errors import InvalidInput, NotFound
from slamhive.runs.folder import RunFolder
from slamhive.schema.challenge import StoredRun
from slamhive.services.challenges.checking import check_trajectory
from slamhive.services.challenges.definition import Definition
from slamhive.services.challenges.folder import ChallengeFolder, SubmissionFolder
from slamhive.trajectory.table import read_bounded


@dataclass(frozen=True, slots=True)
class Estimate:
    """A trajectory to evaluate; ``frames`` is the same in the KITTI format."""

    id: str
    sequence: str
    path: Path
    frames: Path | None = None


@dataclass
class Estimates:
    """What there is of a submission: trajectories, and by sequence why others do not count."""

    found: list[Estimate] = field(default_factory=list)
    failures: dict[str, list[RunFailure]] = field(default_factory=dict)

    def fail(self, sequence: str, failure: RunFailure) -> None:
        """One trajectory of ``sequence`` does not count."""
        self.failures.setdefault(sequence, []).append(failure)


def estimates_of(folder: ChallengeFolder, found: SubmissionFolder) -> Estimates:
    """The trajectories of a submission; of an image whose runs have ended, those that they left."""
    made = Estimates()
    if found.sent.image is not None:
        ended = folder.ended_runs(found.root.name)
        assert ended is not None  # it is asked for only then
        runs = folder.installation(found.root.name) / "runs"
        for run in ended.runs:
            _add_run(made, folder.full_definition, found.sent.id, runs, run)
        return made
    kitti = folder.definition.preset.format is Format.KITTI
    for name, facts in found.sent.files.items():
        if facts.enough:
            frames = found.root / f"{name}.kitti" if kitti else None
            made.found.append(Estimate(f"{found.sent.id}/{name}", name, found.root / f"{name}.tum", frames))
        else:
            made.fail(name, RunFailure.TOO_LITTLE)
    return made


def _add_run(made: Estimates, definition: Definition, submission_id: str, runs: Path, run: StoredRun) -> None:
    if run.failure is not None or run.run is None:
        made.fail(run.sequence, _known(run.failure))
        return
    path = RunFolder(runs / str(run.run)).trajectory
    try:
        enough = check_trajectory(definition, definition.sequences[run.sequence], path.name, read_bounded(path)).enough
    except (InvalidInput, NotFound):
        made.fail(run.sequence, RunFailure.NO_TRAJECTORY)
        return
    if enough:
        made.found.append(Estimate(f"{submission_id}/{run.sequence}/{run.run}", run.sequence, path))
    else:
        made.fail(run.sequence, RunFailure.TOO_LITTLE)


def _known(failure: str | None) -> RunFailure:
    return next((entry for entry in RunFailure if entry == failure), RunFailure.ORGANISER)
