"""What earlier runs tell about the nodes of a cluster, and about how long a run takes."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import func, select

from slamhive.domain.run import RunState
from slamhive.store.durations import DURATION
from slamhive.store.models import MEASURED_PROTOCOL_ID, Dataset, Host, Metric, MetricValue, Run
from slamhive.store.rows import Repository

NODE = "node"
"""Where executors on several machines note the node of a run, in its handle."""
_LATEST = 1000
"""So many of the latest runs of an executor are looked at."""


@dataclass(frozen=True, slots=True)
class NodeSeen:
    """A run that was on a node: the CPU model there, and the affinity of the run."""

    node: str
    cpu_model: str
    affinity: str


class PlacingRepository(Repository):
    """Read before a run is handed to the engine of a cluster."""

    def seen(self, executor: str) -> list[NodeSeen]:
        """The nodes of the latest runs of an executor, the newest first."""
        query = (
            select(Run.handle, Host.cpu_model, Run.affinity)
            .join(Host, Host.id == Run.host_id)
            .where(Run.executor == executor, Run.started_at.is_not(None))
            .order_by(Run.id.desc())
            .limit(_LATEST)
        )
        found = []
        for handle, cpu_model, affinity in self._connection.execute(query):
            node = ((handle or {}).get("data") or {}).get(NODE)
            if node:
                found.append(NodeSeen(str(node), cpu_model, affinity))
        return found

    def ended_on(self, since: datetime) -> dict[tuple[str, str | None], int]:
        """{(executor, node): runs that succeeded or failed after ``since``}; the node is None where none is noted."""
        node = func.json_extract(Run.handle, f"$.data.{NODE}")
        query = (
            select(Run.executor, node, func.count())
            .where(Run.ended_at >= since, Run.state.in_((RunState.SUCCEEDED, RunState.FAILED)), Run.handle.is_not(None))
            .group_by(Run.executor, node)
        )
        # MySQL gives the JSON of a text, SQLite the text.
        return {
            (row[0], None if row[1] is None else row[1].strip('"')): row[2] for row in self._connection.execute(query)
        }

    def measured_s(self, configuration_id: int) -> float | None:
        """The mean duration of the runs of a configuration; None if none was measured."""
        metric_id = select(Metric.id).where(Metric.key == DURATION).scalar_subquery()
        query = (
            select(func.avg(MetricValue.value))
            .join(Run, Run.id == MetricValue.run_id)
            .where(Run.configuration_id == configuration_id)
            .where(MetricValue.metric_id == metric_id, MetricValue.protocol_id == MEASURED_PROTOCOL_ID)
        )
        return self._connection.scalar(query)

    def recording_s(self, dataset: str) -> float:
        """The duration of a dataset's recording."""
        return float(self._connection.execute(select(Dataset.duration_s).where(Dataset.name == dataset)).scalar_one())
