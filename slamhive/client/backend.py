"""Interface between the client and an installation. One reads a data root, one talks to a server."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from slamhive.documents import experiment as experiment_schema
    from slamhive.documents import run as run_schema
    from slamhive.documents.api import ActedOn, AnalysisDocument, AnalysisWithFile
    from slamhive.documents.catalogue import AlgorithmDocument, DatasetDocument
    from slamhive.documents.challenge import ChallengeSubmission
    from slamhive.documents.claims import ClaimsAnswer
    from slamhive.documents.experiment import Decision, SearchStanding
    from slamhive.documents.imports import ImportedDocument
    from slamhive.documents.plain import ExperimentStatusDocument
    from slamhive.documents.protocol import ProtocolSearchDocument
    from slamhive.documents.submission import Submission
    from slamhive.domain.accounts import Visibility
    from slamhive.domain.finding import FoundAction

LOG_BYTES = 200_000
"""How much of the end of a log is read."""


def text_of(file: Path | str) -> str:
    """The text of a file that is given by its path, or as its text. Raises InvalidInput if it cannot be read."""
    from slamhive.base import strict_yaml  # noqa: PLC0415 - reading needs none of this

    return strict_yaml.read_text(file) if isinstance(file, Path) else file


class RequestedChange(StrEnum):
    """Actions on an experiment that was started."""

    PAUSE = "pause"
    RESUME = "resume"
    CANCEL = "cancel"
    RETRY_FAILED = "retry-failed"


@dataclass(frozen=True, slots=True)
class RunQuery:
    """Selection and order of runs. ``sort`` is a column, metric or parameter."""

    where: str = ""
    sort: str = "id"
    descending: bool = True


class Backend(Protocol):
    """One installation.

    Both backends answer the same request with equal documents, and refuse it with the same errors.
    """

    @property
    def label(self) -> str:
        """The data root, or the address of the server."""

    def runs(self, query: RunQuery) -> Iterator[run_schema.RunDocument]:
        """All matching runs, read in pages. Raises InvalidInput for a filter that is not valid."""

    def count(self, query: RunQuery) -> int:
        """Number of matching runs."""

    def table(self, query: RunQuery, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
        """A row of values for each matching run; raises NotFound for an unknown column."""

    def run(self, run_id: int) -> run_schema.RunWith:
        """One run; raises NotFound."""

    def files(self, run_id: int) -> tuple[str, ...]:
        """The keys of the files of a run."""

    def file(self, run_id: int, key: str) -> bytes:
        """One file of a run; raises NotFound."""

    def log(self, run_id: int) -> str:
        """The last :data:`LOG_BYTES` of the output of a run."""

    def search_protocols(self, run_id: int, value: str, metric: str, unit: str | None) -> ProtocolSearchDocument:
        """Protocols under which a run gives a printed number; raises InvalidInput for what is none."""

    def activity(self, run_id: int) -> str:
        """Current activity of a run, in words."""

    def submit(self, submission: Submission) -> tuple[run_schema.RunDocument, ...]:
        """Queue runs. Raises NotFound or InvalidInput naming the value, Forbidden where nothing may change."""

    def cancel(self, run_id: int) -> run_schema.RunDocument:
        """Cancel a queued run, or ask for the end of an active one."""

    def share(self, run_id: int, visibility: Visibility) -> run_schema.RunDocument:
        """Choose who may see a run. Raises Forbidden unless it is one's own."""

    def retry(self, run_id: int) -> run_schema.RunDocument:
        """Queue the same again as a new run."""

    def annotate(self, run_id: int, note: str | None, tags: Sequence[str] | None) -> run_schema.RunDocument:
        """Replace the note and the tags of a run; None keeps them. Raises InvalidInput naming what cannot be kept."""

    def act(self, query: RunQuery, action: FoundAction, options: Mapping[str, Any]) -> ActedOn:
        """Do something to all matching runs. ``options`` are the other fields of the request for the action.

        Raises InvalidInput for a bad filter or option, Forbidden where nothing may change.
        """

    def restore(self, deleted_at: str) -> tuple[int, ...]:
        """Take what was deleted together out of the trash; returns the numbers of the runs. Raises NotFound."""

    def experiments(self) -> tuple[ExperimentStatusDocument, ...]:
        """All experiments, the newest first."""

    def experiment(self, name: str) -> ExperimentStatusDocument:
        """One experiment; raises NotFound."""

    def decision(self, name: str) -> Decision:
        """State of an experiment that finds out which candidate is best; raises InvalidInput for any other one."""

    def search(self, name: str) -> SearchStanding:
        """State of an experiment that searches for the best candidate; raises InvalidInput for any other one."""

    def cells(self, name: str) -> Iterator[experiment_schema.CellDocument]:
        """The configurations of an experiment with their runs and metrics, read in pages."""

    def start(self, text: str, executor: str | None) -> ExperimentStatusDocument:
        """Queue the runs of an experiment file. The same text again completes an interrupted start."""

    def change(self, name: str, change: RequestedChange) -> ExperimentStatusDocument:
        """Pause, resume or cancel an experiment, or queue its failed runs again."""

    def datasets(self) -> tuple[DatasetDocument, ...]:
        """All datasets, by name."""

    def dataset(self, name: str) -> DatasetDocument:
        """One dataset; raises NotFound."""

    def algorithms(self) -> tuple[AlgorithmDocument, ...]:
        """All algorithms, by name."""

    def algorithm(self, name: str) -> AlgorithmDocument:
        """One algorithm; raises NotFound."""

    def analyses(self) -> tuple[AnalysisDocument, ...]:
        """The listed analyses, the newest first."""

    def analysis(self, token: str) -> AnalysisWithFile:
        """One analysis; raises NotFound."""

    def analysis_report(self, token: str) -> dict[str, Any]:
        """The report of an analysis as data; raises NotFound before it is done."""

    def analysis_file(self, token: str, name: str) -> bytes:
        """One file of the report; raises NotFound."""

    def create_analysis(self, text: str, *, listed: bool) -> AnalysisDocument:
        """Queue an analysis file. Raises InvalidInput naming the line."""

    def recompute_analysis(self, token: str) -> AnalysisDocument:
        """Queue an analysis again."""

    def share_analysis(self, token: str, visibility: Visibility) -> AnalysisDocument:
        """Choose who may see an analysis. Raises Forbidden unless it is one's own."""

    def delete_analysis(self, token: str) -> None:
        """Delete an analysis for good."""

    def import_dataset(self, path: Path, options: Mapping[str, Any], *, progress: bool) -> ImportedDocument:
        """Make a dataset of a recording on this machine. ``options`` are those of :class:`RecordingFacts`.

        ``groundtruth`` and ``calibration`` are paths here. Raises InvalidInput or Conflict naming the value.
        """

    def import_runs(self, path: Path, options: Mapping[str, Any], *, progress: bool) -> ImportedDocument:
        """Import the trajectories in a folder on this machine. ``options`` are those of :class:`RunsUpload`."""

    def submit_image(
        self, challenge: str, path: Path | None, options: Mapping[str, Any], *, progress: bool
    ) -> ChallengeSubmission:
        """Submit an image on this machine, or the package that the options name, to a challenge.

        ``options`` are those of :class:`ImageEntry`. Raises NotFound, InvalidInput, Conflict or TooManyRequests.
        """

    def claims(self) -> tuple[ClaimsAnswer, ...]:
        """The last answers about claims of papers, by name."""

    def challenge_submissions(self, challenge: str) -> tuple[ChallengeSubmission, ...]:
        """The caller's submissions to a challenge, the newest first; raises NotFound."""

    def working(self, what: Sequence[int] | str) -> AbstractContextManager[Callable[[], None]]:
        """While somebody waits for runs, or for the experiment of a name: work on them if nobody else does.

        Yields a function that raises what ended this work, if anything did.
        """

    def computing(self) -> AbstractContextManager[object]:
        """While somebody waits for an analysis: compute those that are queued, if this process may."""

    def close(self) -> None:
        """Close what was opened."""
