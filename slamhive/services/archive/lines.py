"""The rows of an archive as JSON lines, and back: what the folders do not contain."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from typing import Any, TypeVar

from slamhive.domain.names import check_name
from slamhive.domain.run import RunEvent
from slamhive.domain.visibility import Visibility
from slamhive.errors import InvalidInput
from slamhive.evaluation.job import Artefacts
from slamhive.schema.archive import (
    AnalysisLine,
    CellLine,
    ConfigurationLine,
    DatasetLine,
    EvaluationLine,
    ExperimentLine,
    RunLine,
    SearchLine,
)
from slamhive.schema.model import Document
from slamhive.schema.record import Outcome, RunFile
from slamhive.services.configurations import check_label
from slamhive.services.runs import begin_record, events_to_json
from slamhive.store.analysis_records import AnalysisRecord, AnalysisState
from slamhive.store.experiment_records import ExperimentRecord, ExperimentState, NewCell
from slamhive.store.filed_runs import EndedEvaluation
from slamhive.store.records import EvaluationState, RunRecord, RunSort, SavedSearchRecord

T = TypeVar("T")
Line = TypeVar("Line", bound=Document)


def read_line(kind: type[Line], content: Mapping[str, Any]) -> Line:
    """The line as it was exported; raises InvalidInput for anything else."""
    return _whole(kind, lambda: kind.read(content))


def run_to_line(
    run: RunRecord, retry_of: str | None, evaluations: Sequence[EndedEvaluation], record: dict[str, Any] | None
) -> dict[str, Any]:
    """One line of :data:`slamhive.services.archive.layout.RUNS`."""
    line = RunLine(
        id=run.id,
        uid=run.uid,
        attempt=run.attempt,
        retry_of=retry_of,
        experiment=run.experiment,
        current_protocol=None if run.protocol is None else run.protocol.fingerprint,
        record=record,
        evaluations=tuple(map(EvaluationLine.of, evaluations)),
        visibility=None if run.seen_by is Visibility.TEAM else run.seen_by,
    )
    return line.content


def evaluations_of(line: RunLine) -> tuple[EndedEvaluation, ...]:
    """The evaluations of a run, which have all ended; raises InvalidInput."""
    return tuple(_whole(EvaluationLine, lambda: _ended(entry)) for entry in line.evaluations)  # noqa: B023


def row_as_record(run: RunRecord, mode: str, events: list[RunEvent]) -> dict[str, Any]:
    """The record of a run that has no folder, out of its row; there are no metrics of such a run."""
    version = {} if run.version is None else asdict(run.version)
    return {
        **begin_record(run),
        **Outcome.of(run).content,
        "algorithm": {"package": run.package, "mode": mode, **version},
        "dataset": {"checksum": run.dataset_checksum},
        "trajectory": run.trajectory,
        "host": None if run.host is None else asdict(run.host),
        "events": events_to_json(events),
    }


def completed(record: dict[str, Any], run: RunRecord, events: list[RunEvent]) -> dict[str, Any]:
    """The record of a run whose folder was not sealed, completed from its row."""
    if record.get("state") == run.state.value:
        return record
    return {**record, **Outcome.of(run).content, "events": events_to_json(events)}


def without_handle(record: Mapping[str, Any]) -> dict[str, Any]:
    """The record of a run that has ended, without what its engine finds it by.

    A worker removes what it finds by a handle. One from outside may name a container or a job of somebody else.
    """
    return {**record, "handle": None} if record.get("handle") is not None else dict(record)


def check_record(record: Mapping[str, Any], line: RunLine) -> RunFile:
    """The record of a run; raises InvalidInput unless it is that of the ended run ``line``, and whole."""
    file = _whole(RunFile, lambda: RunFile.read(record), f"record of run {line.id}")
    check_name("algorithm", file.request.algorithm)
    check_name("dataset", file.request.dataset)
    if file.id != line.id or file.uid != line.uid or not file.state.ended:
        raise InvalidInput(f"the record of run {line.id} is that of another run, or of one that has not ended")
    evaluations_of(line)
    return file


def configuration_from_line(content: Mapping[str, Any]) -> ConfigurationLine:
    """The configuration of a line; raises InvalidInput for anything else."""
    line = read_line(ConfigurationLine, content)
    for name in (line.request.algorithm, line.request.dataset):
        check_name("algorithm or dataset", name)
    for name in (*line.groups, *([] if line.name is None else [line.name])):
        check_label("configuration or group", name)
    return line


def experiment_from_line(content: Mapping[str, Any]) -> ExperimentRecord:
    """The experiment of a line, its number 0; raises InvalidInput for anything else."""
    line = read_line(ExperimentLine, content)
    return _whole(
        ExperimentLine, lambda: ExperimentRecord(**{**dict(line), "id": 0, "state": ExperimentState(line.state)})
    )


def cell_from_line(content: Mapping[str, Any]) -> tuple[str, NewCell]:
    """Experiment and cell of a line; raises InvalidInput for anything else."""
    line = read_line(CellLine, content)
    return line.experiment, NewCell(line.number, line.name, line.configuration, line.values)


def dataset_from_line(content: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Name and columns of the dataset of a line; raises InvalidInput for anything else."""
    columns = dict(read_line(DatasetLine, content))
    return columns.pop("name"), {**columns, "sensors": list(columns["sensors"])}


def search_from_line(content: Mapping[str, Any]) -> tuple[SavedSearchRecord, datetime]:
    """The saved search of a line, and when it was saved; raises InvalidInput for anything else."""
    line = read_line(SearchLine, content)
    look = line.pinned, line.colours, line.sparks
    record = SavedSearchRecord(line.name, line.filter, line.columns, RunSort(*line.sort), line.grouped, *look)
    return record, line.created_at


def analysis_from_line(content: Mapping[str, Any]) -> tuple[AnalysisRecord, str]:
    """Analysis and file of a line; raises InvalidInput for anything else."""
    line = read_line(AnalysisLine, content)
    record = AnalysisRecord(
        token=line.token,
        name=line.name,
        state=AnalysisState.QUEUED,
        listed=True,
        visitor=False,
        created_at=line.created_at,
        visibility=line.visibility,
    )
    return record, line.source


def _ended(line: EvaluationLine) -> EndedEvaluation:
    state = EvaluationState(line.state)
    if state not in (EvaluationState.SUCCEEDED, EvaluationState.FAILED):
        raise ValueError(f"an evaluation is {state}")
    if line.ended_at is None:
        raise ValueError("an evaluation has no end")
    return EndedEvaluation(**{**dict(line), "state": state, "artefacts": Artefacts(line.artefacts)})


def _whole(kind: type[Document], read: Callable[[], T], what: str = "") -> T:
    """What ``read`` finds; raises InvalidInput that names the kind of line."""
    try:
        return read()
    except ValueError as error:
        detail = repr(error)
    except InvalidInput as error:
        detail = str(error)
    what = what or kind.__name__.removesuffix("Line").lower()
    raise InvalidInput(f"a {what} of the archive is not complete: {detail}", "export the archive again")
