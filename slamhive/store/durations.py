"""How long runs took, to tell how long others will take."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import ColumnElement, and_, func, select
from sqlalchemy.orm import Session

from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.run import RunState
from slamhive.store.experiment_records import KnownConfiguration
from slamhive.store.models import MEASURED_PROTOCOL_ID, Algorithm, Configuration, Dataset, Metric, MetricValue, Run
from slamhive.store.rows import chunks

DURATION = "duration"
_PAIRING = (Algorithm.name, Dataset.name, Configuration.playback_mode, Configuration.playback_rate)
_ENDED = tuple(state for state in RunState if state.ended)
Pairing = tuple[str, str, PlaybackMode, float]
"""Algorithm, dataset, playback mode and rate."""


class DurationRepository:
    """Means of the metric ``duration``, in s."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def of_configurations(self, content_hashes: Sequence[str]) -> dict[str, KnownConfiguration]:
        """What is known of those configurations that are stored, by content hash."""
        found: dict[str, KnownConfiguration] = {}
        for part in chunks(content_hashes):
            query = (
                select(
                    Configuration.content_hash,
                    func.count(Run.id).label("runs"),
                    func.count(MetricValue.value).label("measured"),
                    func.avg(MetricValue.value).label("duration_s"),
                )
                .outerjoin(Run, Run.configuration_id == Configuration.id)
                .outerjoin(MetricValue, self._is_duration())
                .where(Configuration.content_hash.in_(part))
                .group_by(Configuration.content_hash)
            )
            for row in self._session.execute(query):
                found[row.content_hash] = KnownConfiguration(row.runs, row.measured, row.duration_s)
        return found

    def of_pairings(self, experiment_id: int | None = None) -> dict[Pairing, float]:
        """Mean of each algorithm on each dataset, of all runs or of those of an experiment."""
        among = [] if experiment_id is None else [Run.experiment_id == experiment_id]
        query = (
            select(*_PAIRING, func.avg(MetricValue.value))
            .select_from(Run)
            .join(MetricValue, self._is_duration())
            .join(Configuration, Configuration.id == Run.configuration_id)
            .join(Algorithm, Algorithm.id == Configuration.algorithm_id)
            .join(Dataset, Dataset.id == Configuration.dataset_id)
            .where(*among)
            .group_by(*_PAIRING)
        )
        return {(row[0], row[1], row[2], row[3]): row[4] for row in self._session.execute(query)}

    def unfinished(self, experiment_id: int) -> dict[Pairing, int]:
        """How many runs of an experiment have not ended, of each algorithm on each dataset."""
        query = (
            select(*_PAIRING, func.count())
            .select_from(Run)
            .join(Configuration, Configuration.id == Run.configuration_id)
            .join(Algorithm, Algorithm.id == Configuration.algorithm_id)
            .join(Dataset, Dataset.id == Configuration.dataset_id)
            .where(Run.experiment_id == experiment_id, Run.state.not_in(_ENDED))
            .group_by(*_PAIRING)
        )
        return {(row[0], row[1], row[2], row[3]): row[4] for row in self._session.execute(query)}

    def _is_duration(self) -> ColumnElement[bool]:
        metric_id = select(Metric.id).where(Metric.key == DURATION).scalar_subquery()
        return and_(
            MetricValue.run_id == Run.id,
            MetricValue.metric_id == metric_id,
            MetricValue.protocol_id == MEASURED_PROTOCOL_ID,
        )
