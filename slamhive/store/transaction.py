"""One transaction: the repositories, and the snapshot that several reads can share."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from typing import TypeVar

from sqlalchemy import Engine, text
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session

from slamhive.clock import SYSTEM_CLOCK, Clock
from slamhive.store.accounts import AccountRepository
from slamhive.store.analyses import AnalysisRepository
from slamhive.store.archives import ArchiveRepository
from slamhive.store.audit import AuditRepository
from slamhive.store.catalogue import CatalogueRepository
from slamhive.store.configuration_book import ConfigurationBook
from slamhive.store.configurations import ConfigurationRepository
from slamhive.store.deleted_runs import DeletedRunRepository
from slamhive.store.durations import DurationRepository
from slamhive.store.evaluations import EvaluationRepository
from slamhive.store.experiment_counts import ExperimentCounts
from slamhive.store.experiments import ExperimentRepository
from slamhive.store.filed_runs import FiledRunRepository
from slamhive.store.imports import ImportRepository
from slamhive.store.leases import Lease
from slamhive.store.ledger import LedgerRepository
from slamhive.store.metrics import MetricRepository
from slamhive.store.notes import NoteRepository
from slamhive.store.placing import PlacingRepository
from slamhive.store.queue import RunQueue
from slamhive.store.run_table import RunTableRepository
from slamhive.store.runs import RunRepository
from slamhive.store.same_cpu import SameCpu
from slamhive.store.searches import SearchRepository
from slamhive.store.versions import VersionRepository

T = TypeVar("T")


class Transaction:
    """The repositories, all on the same transaction. Nothing outside the store makes one, or sees its session."""

    def __init__(self, session: Session, clock: Clock = SYSTEM_CLOCK) -> None:
        self.session = session
        self._clock = clock
        # What is run, and with what.
        self.catalogue = CatalogueRepository(session)
        self.versions = VersionRepository(session)
        self.configurations = ConfigurationRepository(session)
        self.configuration_book = ConfigurationBook(session)
        self.experiments = ExperimentRepository(session)
        self.experiment_counts = ExperimentCounts(session)
        # Runs, and what waits for a worker.
        self.runs = RunRepository(session)
        self.queue = RunQueue(session)
        self.same_cpu = SameCpu(session)
        self.placing = PlacingRepository(session)
        self.evaluations = EvaluationRepository(session)
        self.analyses = AnalysisRepository(session)
        # What came out.
        self.metrics = MetricRepository(session)
        self.run_table = RunTableRepository(session)
        self.notes = NoteRepository(session)
        self.durations = DurationRepository(session)
        self.searches = SearchRepository(session)
        # What comes from folders and files, and goes there.
        self.filed_runs = FiledRunRepository(session)
        self.deleted_runs = DeletedRunRepository(session)
        self.ledger = LedgerRepository(session)
        self.archive = ArchiveRepository(session)
        self.imports = ImportRepository(session)
        # Who may do what, and who did.
        self.accounts = AccountRepository(session)
        self.audit = AuditRepository(session)

    def lease(self, owner: str, lasts_s: float) -> Lease:
        """A lease for ``owner`` from now on, by the clock that all workers of this database share.

        Workers on several machines share a MySQL server, so its clock decides; one machine has an SQLite file open, so
        its own does. A clock that was handed in decides everything.
        """
        now = self._clock.utc_now()
        shared = self._clock is SYSTEM_CLOCK and self.session.get_bind().dialect.name == "mysql"
        return Lease(owner, self._server_time() if shared else now, lasts_s, recorded_at=now)

    def _server_time(self) -> datetime:
        told: datetime = self.session.execute(text("SELECT UTC_TIMESTAMP(6)")).scalar_one()
        return told.replace(tzinfo=UTC)


class Snapshot:
    """One read transaction for several reads; it begins with the first of them.

    Args:
        engine: The database.
        clock: For the transaction.
    """

    def __init__(self, engine: Engine, clock: Clock) -> None:
        self._engine = engine
        self._clock = clock
        self._session: Session | None = None
        self._transaction: Transaction | None = None

    def read(self, work: Callable[[Transaction], T]) -> T:
        """What ``work`` returns. A broken transaction is ended: the next read begins another."""
        if self._transaction is None:
            self._session = Session(self._engine, expire_on_commit=False)
            self._transaction = Transaction(self._session, self._clock)
        try:
            return work(self._transaction)
        except DBAPIError:
            self.end()
            raise

    def end(self) -> None:
        """End the transaction, if there is one."""
        if self._session is not None:
            self._session.close()
        self._session = self._transaction = None
