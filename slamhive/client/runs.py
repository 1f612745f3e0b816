"""Runs: searched, read, submitted and waited for."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, overload

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.client.backend import Backend, RunQuery
from slamhive.domain.finding import FoundAction
from slamhive.domain.metrics import CATALOGUE
from slamhive.filters.fields import PARAMETER_PREFIX

if TYPE_CHECKING:
    from slamhive.client.trajectory import RunTrajectory
    from slamhive.documents import run as run_schema
    from slamhive.documents.api import ActedOn
    from slamhive.documents.protocol import ProtocolSearchDocument
    from slamhive.documents.submission import Submission
    from slamhive.domain.accounts import Visibility
    from slamhive.domain.parameters import Value
    from slamhive.domain.run import RunState

ESTIMATE = "traj.txt"


class Run:
    """One run, as it was when it was read; :meth:`refresh` reads it again.

    ``document`` holds everything else that is known, as typed fields; ``docs/schemas/run.schema.json`` lists them.
    """

    def __init__(self, backend: Backend, document: run_schema.RunDocument) -> None:
        self._backend = backend
        self.document = document

    def __repr__(self) -> str:
        return f"<run {self.id}: {self.algorithm} on {self.dataset}, {self.state}>"

    @property
    def id(self) -> int:
        """Its number in this installation."""
        return self.document.id

    @property
    def algorithm(self) -> str:
        """The name of the algorithm."""
        return self.document.algorithm

    @property
    def dataset(self) -> str:
        """The name of the dataset."""
        return self.document.dataset

    @property
    def parameters(self) -> Mapping[str, Value]:
        """The values of all parameters."""
        return self.document.parameters

    @property
    def state(self) -> RunState:
        """Where the run is in its life."""
        return self.document.state

    @property
    def owner(self) -> str | None:
        """The account that it belongs to; None for nobody."""
        return self.document.owner

    @property
    def visibility(self) -> Visibility:
        """Audience of the run; admins always see it."""
        return self.document.visibility

    @property
    def metrics(self) -> dict[str, float]:
        """The metrics in stored units (see docs/metrics.md); those that the run does not have are left out."""
        return {key: entry["value"] for key, entry in self.document.metrics.items()}

    @property
    def files(self) -> tuple[str, ...]:
        """The keys of its files."""
        return self._backend.files(self.id)

    @property
    def log(self) -> str:
        """The end of its output so far."""
        return self._backend.log(self.id)

    def search_protocols(self, value: str, metric: str = "ate", unit: str | None = None) -> ProtocolSearchDocument:
        """Protocols under which this run gives the number ``value`` that a paper prints, the most usual first.

        Args:
            value: The number as text: its digits count, ``"0.016"``.
            metric: ``ate``, ``ate_rot``, ``rpe``, ``rpe_rot``, ``kitti`` or ``segment``.
            unit: ``m``, ``cm``, ``mm``, ``%``, ``deg`` or ``deg/m``; None for any that is usual.

        Raises:
            InvalidInput: One of them is none.
        """
        return self._backend.search_protocols(self.id, value, metric, unit)

    def file(self, key: str) -> bytes:
        """The content of one of its files; raises NotFound."""
        return self._backend.file(self.id, key)

    def trajectory(self, *, aligned: bool = False) -> RunTrajectory:
        """The estimated trajectory, in the frame of the algorithm or ``aligned`` to the ground truth.

        Raises NotFound if the run has none, or has not been evaluated.
        """
        return self._read(self._evaluated("traj.tum") if aligned else ESTIMATE)

    def groundtruth(self) -> RunTrajectory:
        """The ground truth at the times of the aligned trajectory; raises NotFound if it was not evaluated."""
        return self._read(self._evaluated("groundtruth.tum"))

    def refresh(self) -> Run:
        """The run as it is now."""
        return Run(self._backend, self._backend.run(self.id))

    def wait(self, *, progress: bool = True) -> Run:
        """Wait until it has ended and been evaluated; returns it as it is then."""
        return Batch(self._backend, [self]).wait(progress=progress)[0]

    @property
    def note(self) -> str:
        """Note that a user wrote about the run; empty if there is none."""
        return self.document.note or ""

    @property
    def tags(self) -> tuple[str, ...]:
        """Its tags."""
        return self.document.tags

    def annotate(self, note: str | None = None, tags: Sequence[str] | None = None) -> Run:
        """Replace its note and its tags; None keeps them. Raises InvalidInput naming what cannot be kept."""
        return Run(self._backend, self._backend.annotate(self.id, note, tags))

    def cancel(self) -> Run:
        """Cancel a queued run, or ask for the end of an active one."""
        return Run(self._backend, self._backend.cancel(self.id))

    def share(self, visibility: str) -> Run:
        """Choose who may see it: ``private``, ``team`` or ``public``. Raises Forbidden unless it is one's own."""
        from slamhive.domain.accounts import Visibility  # noqa: PLC0415 - reading needs none of this

        return Run(self._backend, self._backend.share(self.id, Visibility.named(visibility)))

    def retry(self) -> Run:
        """Queue the same again; returns the new run."""
        return Run(self._backend, self._backend.retry(self.id))

    def _evaluated(self, name: str) -> str:
        """The key of a file of the evaluation whose metrics are shown."""
        if self.document.protocol is None:
            raise NotFound(f"run {self.id} has not been evaluated", "evaluate it: slamhive evaluate")
        return f"{self.document.protocol.fingerprint}-{name}"

    def _read(self, key: str) -> RunTrajectory:

        from slamhive.client.trajectory import RunTrajectory  # noqa: PLC0415 - loads NumPy

        return RunTrajectory.of_tum(self.file(key), f"{key} of run {self.id}")


class Batch(Sequence[Run]):
    """Runs that were submitted together."""

    def __init__(self, backend: Backend, runs: Sequence[Run]) -> None:
        self._backend = backend
        self._runs = tuple(runs)

    def __repr__(self) -> str:
        return repr(list(self._runs))

    def __len__(self) -> int:
        return len(self._runs)

    @overload
    def __getitem__(self, place: int) -> Run: ...
    @overload
    def __getitem__(self, place: slice) -> Sequence[Run]: ...
    def __getitem__(self, place: int | slice) -> Run | Sequence[Run]:
        return self._runs[place]

    def wait(self, *, progress: bool = True) -> Batch:
        """Wait until all have ended and been evaluated; returns them as they are then.

        On a data root without a worker, this process works on the runs meanwhile. Interrupting it cancels nothing.
        """
        from slamhive.client.waiting import wait_for_runs  # noqa: PLC0415 - reading needs none of this

        ended = wait_for_runs(self._backend, [run.id for run in self], progress=progress)
        return Batch(self._backend, [Run(self._backend, document) for document in ended])


class RunList:
    """Runs that match a filter, in an order. Nothing is read before they are looked at."""

    def __init__(self, backend: Backend, query: RunQuery) -> None:
        self._backend = backend
        self._query = query

    def __repr__(self) -> str:
        return f"<runs of {self._backend.label}{f' where {self._query.where}' if self._query.where else ''}>"

    def __iter__(self) -> Iterator[Run]:
        return (Run(self._backend, document) for document in self._backend.runs(self._query))

    def __len__(self) -> int:
        return self._backend.count(self._query)

    def where(self, text: str) -> RunList:
        """Those that also match the filter ``text`` (see docs/search.md)."""
        both = f"({self._query.where}) and ({text})" if self._query.where else text
        return RunList(self._backend, replace(self._query, where=both))

    def sort(self, key: str, *, descending: bool = False) -> RunList:
        """The same ones in the order of a column, metric or parameter."""
        return RunList(self._backend, replace(self._query, sort=key, descending=descending))

    def evaluate(self, protocol: str | None = None) -> ActedOn:
        """Queue an evaluation of each that succeeded; None is the protocol that each was submitted with."""
        return self._act(FoundAction.EVALUATE, {"protocol": protocol})

    def retry(self) -> ActedOn:
        """Queue a new run for each that has ended."""
        return self._act(FoundAction.RETRY)

    def tag(self, add: Sequence[str] = (), remove: Sequence[str] = ()) -> ActedOn:
        """Add and remove tags."""
        return self._act(FoundAction.TAGS, {"add": list(add), "remove": list(remove)})

    def share(self, visibility: str) -> ActedOn:
        """Choose who may see them: ``private``, ``team`` or ``public``. Raises Forbidden for those of others."""
        return self._act(FoundAction.SHARE, {"visibility": visibility})

    def delete(self) -> ActedOn:
        """Move those that have ended to the trash; ``deleted_at`` of the answer restores them."""
        return self._act(FoundAction.DELETE)

    def _act(self, action: FoundAction, options: Mapping[str, Any] = MappingProxyType({})) -> ActedOn:
        """Do something to all of them. Those that it does not fit are left out, and the answer says why.

        Raises InvalidInput without a filter, and for more runs than a server changes in one request (2,000).
        """
        if not self._query.where:
            raise InvalidInput("all runs are meant, without a filter", "choose with where(...); id > 0 matches all")
        return self._backend.act(self._query, action, options)

    def to_pandas(self, columns: Sequence[str] = ()) -> Any:
        """A pandas data frame with a row for each run; see :func:`slamhive.client.runs.frame_of`."""
        return frame_of(self._backend, self._query, columns)


class Runs(RunList):
    """All runs of an installation, the newest first."""

    def __init__(self, backend: Backend) -> None:
        super().__init__(backend, RunQuery())

    def get(self, run_id: int) -> Run:
        """The run of a number; raises NotFound."""
        return Run(self._backend, self._backend.run(run_id))

    def restore(self, deleted_at: str) -> tuple[int, ...]:
        """Take what was deleted together out of the trash; returns the numbers of the runs. Raises NotFound."""
        return self._backend.restore(deleted_at)

    def submit(
        self, algorithm: str, dataset: str, parameters: Mapping[str, Value] | None = None, **options: Any
    ) -> Batch:
        """Queue runs of one configuration.

        ``options`` are the other fields of a submission, such as ``repeat``, ``seed`` and ``playback_mode``;
        ``docs/schemas/submission.schema.json`` lists them. Raises InvalidInput or NotFound naming the value.
        """
        asked = submission_of(algorithm, dataset, parameters, options)
        return Batch(self._backend, [Run(self._backend, run) for run in self._backend.submit(asked)])


def submission_of(
    algorithm: str, dataset: str, parameters: Mapping[str, Value] | None, options: Mapping[str, Any]
) -> Submission:
    """A submission of Python values; raises InvalidInput naming the field."""
    from slamhive.documents.model import load  # noqa: PLC0415 - reading needs none of this
    from slamhive.documents.submission import Submission  # noqa: PLC0415

    content = {"algorithm": algorithm, "dataset": dataset, "parameters": dict(parameters or {}), **options}
    return load(Submission, content)


# Runs as a pandas data frame.


_TIMES = ("created_at", "started_at", "ended_at")
_PARAMETERS = "parameters"
HEAD = (
    "id",
    "algorithm",
    "version",
    "dataset",
    "variant",
    "configuration",
    "experiment",
    "seed",
    "state",
    "reason",
    "verdict",
    "trust",
    "tags",
    *_TIMES,
    "protocol",
)


def frame_of(backend: Backend, query: RunQuery, columns: Sequence[str] = ()) -> Any:
    """A row for each run. ``columns`` are keys of columns, metrics and parameters.

    Without ``columns``: what says which run it is, its parameters as ``parameter.NAME``, and every metric that any of
    the runs has. Metrics are in stored units and missing ones NaN; times are UTC.
    """
    import pandas as pd  # noqa: PLC0415 - takes half a second to load

    wanted = tuple(columns) or (*HEAD, _PARAMETERS, *CATALOGUE)
    frame = pd.DataFrame(list(backend.table(query, wanted)), columns=list(wanted))
    numbers = [key for key in wanted if key in CATALOGUE]
    frame = frame.astype(dict.fromkeys(numbers, float))
    for key in _TIMES:
        if key in wanted:
            frame[key] = pd.to_datetime(frame[key], utc=True, format="ISO8601")
    if columns:
        return frame
    parameters = pd.DataFrame([json.loads(text) for text in frame[_PARAMETERS]], index=frame.index)
    metrics = frame[numbers].dropna(axis="columns", how="all")
    return pd.concat([frame[list(HEAD)], parameters.add_prefix(PARAMETER_PREFIX), metrics], axis="columns")
