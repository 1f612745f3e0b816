"""The nodes of all executors in use, and draining one."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from datetime import datetime, timedelta

from slamhive.clock import utc_now
from slamhive.domain.remaining import Remaining
from slamhive.errors import SlamHiveError, unknown
from slamhive.executors.base import EngineUnavailable, Executor
from slamhive.executors.nodes import Node
from slamhive.executors.registry import AUTO
from slamhive.services.datasets import check_writable
from slamhive.services.executors import Executors
from slamhive.services.experiments import Experiments, Standing
from slamhive.services.nodes.answers import EngineAnswers
from slamhive.services.nodes.views import Engine, Machine, NodeRun, NodeView, Overview
from slamhive.settings import Mode, Settings
from slamhive.store import RunRecord, Store
from slamhive.store.placing import NODE

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
        experiments: Experiments,
        worker_alive: Callable[[], bool],
    ) -> None:
        self._settings = settings
        self._store = store
        self._executors = executors
        self._experiments = experiments
        self._worker_alive = worker_alive
        self._answers = EngineAnswers()

    def overview(self) -> Overview:
        """Nodes, runs, throughput and time left. A view-only installation asks no engine."""
        now = utc_now()
        since = now - timedelta(hours=HOURS)
        active, queued = self._store.read(lambda t: (t.runs.active(), t.durations.queued()))
        measured = self._store.read(lambda t: t.durations.by_machine(since))
        asks = self._settings.mode is not Mode.VIEW_ONLY
        expected_s = self._store.read(lambda t: {run.id: t.placing.measured_s(run.configuration_id) for run in active})
        runs = [_run(record, expected_s[record.id], now) for record in active]
        names = {run.executor for run in runs} | set(queued)
        return Overview(
            engines=tuple(self._engines(names, runs, since)) if asks else tuple(_unasked(names, runs)),
            machines=tuple(Machine.of(entry, HOURS) for entry in measured),
            queued=sum(queued.values()),
            left=self._left(),
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

    def _engines(self, names: Collection[str], runs: Sequence[NodeRun], since: datetime) -> Iterator[Engine]:
        """The executors that have runs, and the one that new runs get."""
        ended = self._store.read(lambda t: t.placing.ended_on(since))
        chosen = self._settings.executor
        try:
            chosen = self._answers.of(AUTO, self._executors.choose) if chosen == AUTO else chosen
        except SlamHiveError as error:
            yield Engine(chosen, (), problem=str(error))
        for name in sorted({*names, chosen} - {AUTO}):
            rates = {node: count / HOURS for (executor, node), count in ended.items() if executor == name}
            yield self._engine(name, [run for run in runs if run.executor == name], rates)

    def _engine(self, name: str, runs: Sequence[NodeRun], rates: Mapping[str | None, float]) -> Engine:
        try:
            executor = self._executors.get(name)
            nodes = self._answers.of(name, lambda: self._ask(executor))
        except SlamHiveError as error:
            return Engine(name, (), tuple(runs), problem=str(error))
        here = executor.capabilities.takes_cores_here
        views = [
            NodeView.of(
                node,
                (run for run in runs if here or run.node == node.name),
                rates.get(None if here else node.name, 0.0),
            )
            for node in nodes
        ]
        placed = {run.id for view in views for run in view.runs}
        elsewhere = tuple(run for run in runs if run.id not in placed)
        return Engine(name, tuple(views), elsewhere, executor.capabilities.drains)

    def _ask(self, executor: Executor) -> list[Node]:
        """The nodes of an executor. Only a running worker knows whether an engine of its own machine answers."""
        if not (executor.capabilities.takes_cores_here and self._worker_alive()):
            problem = executor.unavailable_because()
            if problem is not None:
                raise EngineUnavailable(problem)
        return executor.nodes()

    def _left(self) -> Remaining:
        active = [entry.name for entry in self._experiments.list() if entry.standing is Standing.ACTIVE]
        found = (self._experiments.status(name).left for name in active)
        return sum((left for left in found if left is not None), Remaining(0.0))


def _unasked(names: Collection[str], runs: Sequence[NodeRun]) -> Iterator[Engine]:
    for name in sorted(names):
        yield Engine(name, (), tuple(run for run in runs if run.executor == name))


def _run(record: RunRecord, expected_s: float | None, now: datetime) -> NodeRun:
    node = ((record.handle or {}).get("data") or {}).get(NODE)
    model = None if record.host is None or node is None else record.host.cpu_model
    left_s = None
    if expected_s is not None and record.started_at is not None:
        left_s = max(0.0, expected_s - (now - record.started_at).total_seconds())
    return NodeRun(record.id, record.algorithm, record.dataset, record.state, record.executor, node, model, left_s)
