"""The door to the database: every access is a function run inside one transaction."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from typing import TypeVar

from sqlalchemy import Engine, create_engine, text
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from slamhive.clock import SYSTEM_CLOCK, Clock
from slamhive.errors import NotFound, SlamHiveError
from slamhive.store import migrate, statistics
from slamhive.store.analyses import AnalysisRepository
from slamhive.store.catalogue import CatalogueRepository
from slamhive.store.changes import CHANGES_KEY, Changes, Listener
from slamhive.store.configuration_book import ConfigurationBook
from slamhive.store.configurations import ConfigurationRepository
from slamhive.store.durations import DurationRepository
from slamhive.store.engine import WRITES, database_label, make_engine
from slamhive.store.evaluations import EvaluationRepository
from slamhive.store.experiment_counts import ExperimentCounts
from slamhive.store.experiments import ExperimentRepository
from slamhive.store.failures import explained, gave_up, is_transient, short
from slamhive.store.filed_runs import FiledRunRepository
from slamhive.store.leases import Lease
from slamhive.store.metrics import MetricRepository
from slamhive.store.queue import RunQueue
from slamhive.store.run_table import RunTableRepository
from slamhive.store.runs import RunRepository
from slamhive.store.searches import SearchRepository

T = TypeVar("T")
logger = logging.getLogger(__name__)

FIRST_PAUSE_S = 0.05
LONGEST_PAUSE_S = 2.0
WRITES_BETWEEN_LOOKS = 500
"""After so many transactions a writer asks whether the tables have grown; see :mod:`slamhive.store.statistics`."""


@dataclass(frozen=True)
class Transaction:
    """The repositories, all on the same transaction."""

    session: Session
    clock: Clock = SYSTEM_CLOCK

    def lease(self, owner: str, lasts_s: float) -> Lease:
        """A lease for ``owner`` from now on, by the clock that all workers of this database share.

        Workers on several machines share a MySQL server, so its clock decides; one machine has an SQLite file open, so
        its own does. A clock that was handed in decides everything.
        """
        now = self.clock.utc_now()
        shared = self.clock is SYSTEM_CLOCK and self.session.get_bind().dialect.name == "mysql"
        return Lease(owner, self._server_time() if shared else now, lasts_s, recorded_at=now)

    def _server_time(self) -> datetime:
        told: datetime = self.session.execute(text("SELECT UTC_TIMESTAMP(6)")).scalar_one()
        return told.replace(tzinfo=UTC)

    @cached_property
    def catalogue(self) -> CatalogueRepository:
        """Algorithms, versions, datasets, hosts, protocols."""
        return CatalogueRepository(self.session)

    @cached_property
    def configurations(self) -> ConfigurationRepository:
        """Configurations and their values."""
        return ConfigurationRepository(self.session)

    @cached_property
    def configuration_book(self) -> ConfigurationBook:
        """Lists of configurations, their names, notes and groups; deletion."""
        return ConfigurationBook(self.session)

    @cached_property
    def runs(self) -> RunRepository:
        """Runs: add, look at, list, move, cancel."""
        return RunRepository(self.session)

    @cached_property
    def run_table(self) -> RunTableRepository:
        """Runs column by column, for analyses."""
        return RunTableRepository(self.session)

    @cached_property
    def searches(self) -> SearchRepository:
        """What searches need besides lists of runs; saved searches."""
        return SearchRepository(self.session)

    @cached_property
    def queue(self) -> RunQueue:
        """Who works on which run: claims, leases, heartbeats."""
        return RunQueue(self.session)

    @cached_property
    def experiments(self) -> ExperimentRepository:
        """Experiments and their cells."""
        return ExperimentRepository(self.session)

    @cached_property
    def experiment_counts(self) -> ExperimentCounts:
        """How many runs of experiments are in which state."""
        return ExperimentCounts(self.session)

    @cached_property
    def analyses(self) -> AnalysisRepository:
        """Analyses and their queue."""
        return AnalysisRepository(self.session)

    @cached_property
    def durations(self) -> DurationRepository:
        """How long runs took."""
        return DurationRepository(self.session)

    @cached_property
    def evaluations(self) -> EvaluationRepository:
        """Evaluations and their queue."""
        return EvaluationRepository(self.session)

    @cached_property
    def filed_runs(self) -> FiledRunRepository:
        """Runs that are filed as their folders tell them."""
        return FiledRunRepository(self.session)

    @cached_property
    def metrics(self) -> MetricRepository:
        """Figures of runs."""
        return MetricRepository(self.session)


class Store:
    """Runs functions in transactions, and again while the database is locked or away.

    A function may therefore be called more than once: it must do nothing but database work, and take identifiers
    and times from outside. The repositories are made so that a repetition after a lost answer does no harm.

    Args:
        engine: From :func:`slamhive.store.engine.make_engine`.
        retry_s: How long to go on trying before Unavailable is raised.
        clock: The time; a test may hand in its own.
    """

    def __init__(self, engine: Engine, retry_s: float = 60.0, clock: Clock = SYSTEM_CLOCK) -> None:
        self.engine = engine
        self._writing = engine.execution_options(**{WRITES: True})
        self._retry_s = retry_s
        self._clock = clock
        self._written = 0
        self.listener: Listener | None = None
        """Called after each transaction that stored what no folder tells, with what that was."""

    @property
    def label(self) -> str:
        """The database in words, without secrets."""
        return database_label(self.engine)

    def read(self, work: Callable[[Transaction], T]) -> T:
        """What ``work`` returns, from one consistent view of the database. Waits for no writer on SQLite."""
        return self.retried(lambda: self._attempt(self.engine, work))

    def write(self, work: Callable[[Transaction], T]) -> T:
        """What ``work`` returns, once all it wrote is on disk; nothing of it is if it raises."""
        attempts: list[Changes] = []

        def attempt() -> T:
            changes = Changes()
            attempts.append(changes)
            return self._attempt(self._writing, work, changes)

        result = self.retried(attempt)
        self._tell(attempts)
        self._written += 1
        if self._written % WRITES_BETWEEN_LOOKS == 0:
            self._refresh_if_grown()
        return result

    @contextmanager
    def unheard(self) -> Iterator[None]:
        """The listener is told nothing during the block: what is stored comes from where it would write."""
        listener, self.listener = self.listener, None
        try:
            yield
        finally:
            self.listener = listener

    def recheck(self) -> None:
        """Tell the listener that more may have been stored than it was told of, after a bulk of rows was filed."""
        if self.listener is not None:
            self.listener(Changes(uncertain=True))

    def refresh_statistics(self) -> None:
        """Let the database look at its tables, after a bulk of rows was written."""
        self.retried(lambda: statistics.refresh(self.engine))

    def close(self) -> None:
        """Close all connections; the store can be used again after (a child process starts with this)."""
        if self._written:
            self._refresh_if_grown()
            self._written = 0
        self.engine.dispose()

    def _refresh_if_grown(self) -> None:
        """What was written is on disk: that the tables could not be looked at now is no failure of it."""
        try:
            statistics.refresh_if_grown(self.engine)
        except DBAPIError as error:
            logger.info("database %s: statistics stay as they are: %s", self.label, short(error))

    def _tell(self, attempts: Sequence[Changes]) -> None:
        """Tell the listener what the last attempt has stored."""
        changes = attempts[-1]
        changes.uncertain = len(attempts) > 1 and any(attempts)
        if self.listener is not None and changes:
            self.listener(changes)

    def _attempt(self, engine: Engine, work: Callable[[Transaction], T], changes: Changes | None = None) -> T:
        noted = {CHANGES_KEY: Changes() if changes is None else changes}
        with Session(engine, expire_on_commit=False, info=noted) as session, session.begin():
            return work(Transaction(session, self._clock))

    def retried(self, attempt: Callable[[], T]) -> T:
        """What ``attempt`` returns; it is called again while the database is locked or away."""
        began = self._clock.monotonic_s()
        pause_s = FIRST_PAUSE_S
        while True:
            try:
                result = attempt()
            except DBAPIError as error:
                self._raise_unless_worth_waiting(error, self._clock.monotonic_s() - began)
                if pause_s == FIRST_PAUSE_S:
                    logger.warning("database %s: %s; trying again", self.label, short(error))
                self._clock.sleep(pause_s)
                pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
            else:
                return result

    def _raise_unless_worth_waiting(self, error: DBAPIError, waited_s: float) -> None:
        if not is_transient(self.engine, error):
            raise (explained(self.engine, error) or error) from None
        if waited_s >= self._retry_s:
            raise gave_up(self.engine, error, waited_s) from None


class AbsentStore(Store):
    """Stands for a database that is not there: whoever wants something of it is told why.

    Args:
        reason: What every access raises.
    """

    def __init__(self, reason: SlamHiveError) -> None:
        super().__init__(create_engine("sqlite://"))
        self._reason = reason

    def retried(self, attempt: Callable[[], T]) -> T:  # noqa: ARG002 - the signature of every access
        """Raise the reason."""
        raise self._reason


def open_store(database_url: str, retry_s: float = 60.0, *, upgrade: bool = True, create: bool = True) -> Store:
    """A store on ``database_url`` whose tables are of this software's version.

    Args:
        database_url: ``sqlite:///file`` or ``mysql+pymysql://user:password@host/database``.
        retry_s: How long a locked or absent database is tried again (``DATABASE_RETRY_S``).
        upgrade: Create or upgrade the tables; otherwise raise Unavailable if that is needed.
        create: Where there are no tables at all, make them; otherwise raise NotFound, with nothing made.
    """
    store = Store(make_engine(database_url), retry_s)
    if not create and not store.retried(lambda: migrate.has_tables(store.engine)):
        store.close()
        remedy = "slamhive reindex makes one out of the run folders, slamhive serve or worker an empty one"
        raise NotFound(f"there is no database {store.label} yet", remedy)
    if upgrade:
        store.retried(lambda: migrate.upgrade(store.engine))
    else:
        store.retried(lambda: migrate.check_current(store.engine))
    return store
