"""The machines that execute runs: what runs where, how fast, and how disturbed; taking a node out of use and back."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, TypeVar

from slamhive.base.clock import monotonic_s, utc_now
from slamhive.base.errors import SlamHiveError, Unavailable, unknown
from slamhive.base.settings import Mode, Settings
from slamhive.documents.plain import (
    ConfigurationStanding,
    EngineDocument,
    MachineDocument,
    NodeDocument,
    NodeRunDocument,
    OverviewDocument,
)
from slamhive.domain.placement import Remaining
from slamhive.executors.base import EngineUnavailable, Executor, Node
from slamhive.executors.registry import AUTO
from slamhive.services.datasets import check_writable
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentService
from slamhive.store import RunRecord, Store
from slamhive.store.durations import NODE, MachineRuns


@dataclass(frozen=True, slots=True)
class _ActiveRun:
    """A run that a worker has claimed; ``cpu_model`` is what it recorded of its node, None if it has not."""

    shown: NodeRunDocument
    executor: str
    cpu_model: str | None


# Engines are asked in threads, so that one that does not answer holds nobody up for long.

PATIENCE_S = 5.0
"""How long anybody waits for an engine."""
KEPT_S = 5.0
"""How long an answer is given to all who ask."""

AnswerT = TypeVar("AnswerT")


class _Question:
    """One question, asked in a thread of its own. It ends with the process if it is never answered."""

    def __init__(self, ask: Callable[[], Any]) -> None:
        self.begun_s = monotonic_s()
        self.answered_s = 0.0
        self.done = threading.Event()
        self.answer: Any = None
        self.problem: SlamHiveError | None = None
        self._ask = ask
        threading.Thread(target=self._run, name="engine", daemon=True).start()

    def _run(self) -> None:
        try:
            self.answer = self._ask()
        except SlamHiveError as error:
            self.problem = error
        except Exception as error:  # noqa: BLE001 - the executor of a plug-in can raise anything
            self.problem = Unavailable(f"the engine cannot be asked: {type(error).__name__}: {error}")
        self.answered_s = monotonic_s()
        self.done.set()


class EngineAnswers:
    """Asks each engine one question at a time, and keeps the answer for a moment. Safe to share between threads.

    Args:
        patience_s: How long to wait for an answer.
        kept_s: How long an answer is kept.
    """

    def __init__(self, patience_s: float = PATIENCE_S, kept_s: float = KEPT_S) -> None:
        self._patience_s = patience_s
        self._kept_s = kept_s
        self._lock = threading.Lock()
        self._questions: dict[str, _Question] = {}

    def of(self, name: str, ask: Callable[[], AnswerT]) -> AnswerT:
        """Return or raise the answer of ``ask``, asked now or a moment ago. Raises Unavailable if it takes too long."""
        with self._lock:
            question = self._questions.get(name)
            if question is None or (question.done.is_set() and monotonic_s() - question.answered_s >= self._kept_s):
                question = self._questions[name] = _Question(ask)
        if not question.done.wait(max(0.0, question.begun_s + self._patience_s - monotonic_s())):
            raise Unavailable(f"{name} has not answered for {self._patience_s:g} s", "slamhive doctor examines it")
        if question.problem is not None:
            raise type(question.problem)(question.problem.message, question.problem.remedy)
        answer: AnswerT = question.answer
        return answer

    def forget(self, name: str) -> None:
        """Ask again next time: something has changed."""
        with self._lock:
            self._questions.pop(name, None)


HOURS = 24.0
"""Throughput and disturbance are those of this time."""


class Nodes:
    """The machines of one installation.

    Args:
        settings: Mode and executor.
        store: The database.
        executors: Whom to ask.
        experiments: For the time left.
        worker_alive: Whether a worker runs on this machine.
    """

    def __init__(
        self,
        settings: Settings,
        store: Store,
        executors: Executors,
        experiments: ExperimentService,
        worker_alive: Callable[[], bool],
    ) -> None:
        self._settings = settings
        self._store = store
        self._executors = executors
        self._experiments = experiments
        self._worker_alive = worker_alive
        self._answers = EngineAnswers()

    def overview(self) -> OverviewDocument:
        """Nodes, runs, throughput and time left. A view-only installation asks no engine."""
        now = utc_now()
        since = now - timedelta(hours=HOURS)
        active, queued = self._store.read(lambda t: (t.runs.active(), t.durations.queued()))
        measured = self._store.read(lambda t: t.durations.by_machine(since))
        asks = self._settings.mode is not Mode.VIEW_ONLY
        expected_s = self._store.read(lambda t: {run.id: t.placing.measured_s(run.configuration_id) for run in active})
        runs = [_run(record, expected_s[record.id], now) for record in active]
        names = {run.executor for run in runs} | set(queued)
        engines: list[EngineDocument] = []
        if asks:
            # The executors that have runs, and the one that new runs get.
            ended = self._store.read(lambda t: t.placing.ended_on(since))
            chosen = self._settings.executor
            try:
                chosen = self._answers.of(AUTO, self._executors.choose) if chosen == AUTO else chosen
            except SlamHiveError as error:
                engines.append(_without_nodes(chosen, (), str(error)))
            for name in sorted({*names, chosen} - {AUTO}):
                rates = {node: count / HOURS for (executor, node), count in ended.items() if executor == name}
                engines.append(self._engine(name, [run for run in runs if run.executor == name], rates))
        else:
            engines += [_without_nodes(name, [run for run in runs if run.executor == name]) for name in sorted(names)]
        left = self._left()
        return OverviewDocument(
            engines=tuple(engines),
            machines=tuple(_machine(entry) for entry in measured),
            queued=sum(queued.values()),
            left_s=left.seconds,
            low_s=left.low_s,
            high_s=left.high_s,
            asks_engines=asks,
        )

    def drain(self, executor: str, node: str, drained: bool) -> None:
        """Let no further run start on ``node``, or let runs start there again; active runs go on.

        Raises NotFound for an unknown executor or node, and InvalidInput if the executor cannot do it. Raises Forbidden
        in view-only mode or if the engine does not allow it, and Unavailable if the engine does not answer.
        """
        check_writable(self._settings)
        engine = self._executors.get(executor)
        known = [entry.name for entry in self._answers.of(executor, lambda: self._ask(engine))]
        if node not in known:
            raise unknown("node", node, known)
        question = f"the executor {executor}, asked to {'drain' if drained else 'undrain'} {node},"
        try:
            self._answers.of(question, lambda: engine.drain(node, drained))
        finally:
            self._answers.forget(question)
            self._answers.forget(executor)
        self._store.note_act()

    def _engine(self, name: str, runs: Sequence[_ActiveRun], rates: Mapping[str | None, float]) -> EngineDocument:
        try:
            executor = self._executors.get(name)
            nodes = self._answers.of(name, lambda: self._ask(executor))
        except SlamHiveError as error:
            return _without_nodes(name, runs, str(error))
        here = executor.capabilities.takes_cores_here
        views = [
            _node(
                node,
                [run for run in runs if here or run.shown.node == node.name],
                rates.get(None if here else node.name, 0.0),
            )
            for node in nodes
        ]
        placed = {run.id for view in views for run in view.runs}
        return EngineDocument(
            executor=name,
            nodes=tuple(views),
            elsewhere=tuple(run.shown for run in runs if run.shown.id not in placed),
            drains=executor.capabilities.drains,
            problem=None,
        )

    def _ask(self, executor: Executor) -> list[Node]:
        """The nodes of an executor. Only a running worker knows whether an engine of its own machine answers."""
        if not (executor.capabilities.takes_cores_here and self._worker_alive()):
            problem = executor.unavailable_because()
            if problem is not None:
                raise EngineUnavailable(problem)
        return executor.nodes()

    def _left(self) -> Remaining:
        active = [entry.name for entry in self._experiments.list() if entry.state is ConfigurationStanding.ACTIVE]
        found = (self._experiments.status(name).left for name in active)
        return sum((left for left in found if left is not None), Remaining(0.0))


def _run(record: RunRecord, expected_s: float | None, now: datetime) -> _ActiveRun:
    node = ((record.handle or {}).get("data") or {}).get(NODE)
    model = None if record.host is None or node is None else record.host.cpu_model
    left_s = None
    if expected_s is not None and record.started_at is not None:
        left_s = max(0.0, expected_s - (now - record.started_at).total_seconds())
    shown = NodeRunDocument(
        id=record.id,
        algorithm=record.algorithm,
        dataset=record.dataset,
        state=record.state,
        node=node,
        left_s=left_s,
    )
    return _ActiveRun(shown, record.executor, model)


def _without_nodes(executor: str, runs: Sequence[_ActiveRun], problem: str | None = None) -> EngineDocument:
    elsewhere = tuple(run.shown for run in runs)
    return EngineDocument(executor=executor, nodes=(), elsewhere=elsewhere, drains=False, problem=problem)


def _node(node: Node, runs: Sequence[_ActiveRun], runs_per_hour: float) -> NodeDocument:
    """``node`` with its runs. The CPU model is that of the engine, else what a run on the node has recorded."""
    return NodeDocument(
        name=node.name,
        state=node.state,
        takes_runs=node.takes_runs,
        drained=node.drained,
        cpu_count=node.cpu_count,
        memory_bytes=node.memory_bytes,
        cpu_model=node.cpu_model or next((run.cpu_model for run in runs if run.cpu_model), None),
        runs=tuple(run.shown for run in runs),
        runs_per_hour=runs_per_hour,
        left_s=max((run.shown.left_s for run in runs if run.shown.left_s is not None), default=None),
        cache=node.cache,
    )


def _machine(found: MachineRuns) -> MachineDocument:
    return MachineDocument(
        cpu_model=found.cpu_model,
        cpu_count=found.cpu_count,
        hours=HOURS,
        runs=found.runs,
        runs_per_hour=found.runs / HOURS,
        disturbed_fraction=found.disturbed / found.judged if found.judged else None,
    )
