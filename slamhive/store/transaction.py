"""One transaction: the repositories, and the snapshot that several reads can share."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, TypeVar

from sqlalchemy import Connection, Engine, text
from sqlalchemy.exc import DBAPIError

from slamhive.clock import SYSTEM_CLOCK, Clock
from slamhive.domain.visibility import Viewer
from slamhive.lazy import lazy_names
from slamhive.store.leases import Lease
from slamhive.store.sight import restrict

if TYPE_CHECKING:
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
    from slamhive.store.experiment_values import ExperimentValues
    from slamhive.store.experiments import ExperimentRepository
    from slamhive.store.filed_runs import FiledRunRepository
    from slamhive.store.imports import ImportRepository
    from slamhive.store.ledger import LedgerRepository
    from slamhive.store.metrics import MetricRepository
    from slamhive.store.notes import NoteRepository
    from slamhive.store.placing import PlacingRepository
    from slamhive.store.queue import RunQueue
    from slamhive.store.run_table import RunTableRepository
    from slamhive.store.runs import RunRepository
    from slamhive.store.same_cpu import SameCpu
    from slamhive.store.searches import SearchRepository
    from slamhive.store.sharing import SharingRepository
    from slamhive.store.versions import VersionRepository

T = TypeVar("T")


_repository = lazy_names(__name__)


class Transaction:
    """The repositories, all on the same transaction. Nothing outside the store makes one, or sees its connection."""

    # What is run, and with what.
    catalogue: CatalogueRepository
    versions: VersionRepository
    configurations: ConfigurationRepository
    configuration_book: ConfigurationBook
    experiments: ExperimentRepository
    experiment_counts: ExperimentCounts
    experiment_values: ExperimentValues
    # Runs, and what waits for a worker.
    runs: RunRepository
    queue: RunQueue
    same_cpu: SameCpu
    placing: PlacingRepository
    evaluations: EvaluationRepository
    analyses: AnalysisRepository
    # What came out.
    metrics: MetricRepository
    run_table: RunTableRepository
    notes: NoteRepository
    durations: DurationRepository
    searches: SearchRepository
    # What comes from folders and files, and goes there.
    filed_runs: FiledRunRepository
    deleted_runs: DeletedRunRepository
    ledger: LedgerRepository
    archive: ArchiveRepository
    imports: ImportRepository
    # Who may do what, and who did.
    accounts: AccountRepository
    audit: AuditRepository
    sharing: SharingRepository

    def __init__(self, connection: Connection, clock: Clock = SYSTEM_CLOCK) -> None:
        self.database = connection
        self._clock = clock

    def __getattr__(self, name: str) -> Any:
        """The repository of that name. It is imported and made on first use: most transactions use one or two."""
        if name not in Transaction.__annotations__:
            raise AttributeError(name)
        made = _repository(Transaction.__annotations__[name])(self.database)
        setattr(self, name, made)
        return made

    def lease(self, owner: str, lasts_s: float) -> Lease:
        """A lease for ``owner`` from now on, by the clock that all workers of this database share.

        Workers on several machines share a MySQL server, so its clock decides; one machine has an SQLite file open, so
        its own does. A clock that was handed in decides everything.
        """
        now = self._clock.utc_now()
        shared = self._clock is SYSTEM_CLOCK and self.database.dialect.name == "mysql"
        return Lease(owner, self._server_time() if shared else now, lasts_s, recorded_at=now)

    def _server_time(self) -> datetime:
        told: datetime = self.database.execute(text("SELECT UTC_TIMESTAMP(6)")).scalar_one()
        return told.replace(tzinfo=UTC)


class Snapshot:
    """One read transaction for several reads; it begins with the first of them.

    Args:
        engine: The database.
        clock: For the transaction.
        viewer: Who may see what is read.
    """

    def __init__(self, engine: Engine, clock: Clock, viewer: Viewer | None = None) -> None:
        self._engine = engine
        self._clock = clock
        self.viewer = viewer
        self._connection: Connection | None = None
        self._transaction: Transaction | None = None

    def read(self, work: Callable[[Transaction], T]) -> T:
        """What ``work`` returns. A broken transaction is ended: the next read begins another."""
        try:
            if self._transaction is None:
                self._connection = self._engine.connect()
                restrict(self._connection, self.viewer)
                self._transaction = Transaction(self._connection, self._clock)
            return work(self._transaction)
        except DBAPIError:
            self.end()
            raise

    def end(self) -> None:
        """End the transaction, if there is one."""
        if self._connection is not None:
            self._connection.close()
        self._connection = self._transaction = None
