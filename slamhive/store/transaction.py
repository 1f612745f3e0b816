"""One transaction: the repositories, and the snapshot that several reads can share."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from datetime import UTC
from typing import TYPE_CHECKING, Any, TypeVar

from sqlalchemy import Connection, Engine, text
from sqlalchemy.exc import DBAPIError, InterfaceError

from slamhive.base.clock import SYSTEM_CLOCK, Clock
from slamhive.base.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.base.lazy import lazy_names
from slamhive.domain.accounts import Viewer
from slamhive.store.engine import database_label, sqlite_file
from slamhive.store.leases import Lease
from slamhive.store.sight import restrict

if TYPE_CHECKING:
    from slamhive.store.accounts import AccountRepository, AuditRepository
    from slamhive.store.analyses import AnalysisRepository
    from slamhive.store.catalogue import CatalogueRepository, NoteRepository, VersionRepository
    from slamhive.store.configuration_listing import ConfigurationBook
    from slamhive.store.configurations import ConfigurationRepository
    from slamhive.store.durations import DurationRepository, PlacingRepository, SameCpu
    from slamhive.store.evaluations import EvaluationRepository
    from slamhive.store.experiments import ExperimentCounts, ExperimentRepository, ExperimentValues
    from slamhive.store.filed_runs import FiledRunRepository, ImportRepository
    from slamhive.store.ledger import ArchiveRepository, LedgerRepository
    from slamhive.store.metrics import MetricRepository
    from slamhive.store.queue import RunQueue
    from slamhive.store.run_table import RunTableRepository
    from slamhive.store.runs import DeletedRunRepository, RunRepository
    from slamhive.store.searches import SearchRepository
    from slamhive.store.sharing import SharingRepository

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
        decisive = now
        if shared:
            decisive = self.database.execute(text("SELECT UTC_TIMESTAMP(6)")).scalar_one().replace(tzinfo=UTC)
        return Lease(owner, decisive, lasts_s, recorded_at=now)


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
        """Return what ``work`` returns. A broken transaction is ended: the next read begins another."""
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


# -- errors of the database: those worth another attempt, and one line for the user ------------------------------------

FULL_DISK_BYTES = 1_000_000
"""With less free space than this, a failed access to an SQLite file means a full disk: files grow in pages."""

_SQLITE_TRANSIENT = {
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED,
    # The disk may be away for a moment. SQLite reports a full one in the same way; ``is_transient`` excludes it.
    sqlite3.SQLITE_CANTOPEN,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_PROTOCOL,
}
_SQLITE_FINAL: dict[int, tuple[str, str]] = {
    sqlite3.SQLITE_FULL: ("cannot grow, the disk is full", "free space; nothing that was stored is lost"),
    sqlite3.SQLITE_READONLY: ("is read-only", "check the rights of the file and of its folder"),
    sqlite3.SQLITE_CORRUPT: ("is damaged", "move the file away and run: slamhive reindex"),
    sqlite3.SQLITE_NOTADB: ("is not an SQLite database", "check DATABASE_URL"),
}
_MYSQL_TRANSIENT = {
    1040: "too many connections",
    1053: "the server is shutting down",
    1205: "lock wait timeout",
    1213: "deadlock, the other transaction won",
    1927: "connection was killed",
    2002: "cannot connect (socket)",
    2003: "cannot connect (TCP)",
    2006: "server has gone away",
    2013: "connection lost during a query",
    2014: "commands out of sync after an interrupted query",
    4031: "disconnected for inactivity",
}
_MYSQL_FINAL: dict[int, tuple[type[SlamHiveError], str, str]] = {
    1021: (Unavailable, "cannot grow, the server's disk is full", "free space; nothing that was stored is lost"),
    1044: (InvalidInput, "refuses the user", "grant the user all rights on the database"),
    1045: (InvalidInput, "refuses the user or the password", "check DATABASE_URL"),
    1049: (InvalidInput, "does not exist", "create it: CREATE DATABASE name CHARACTER SET utf8mb4"),
    1114: (Unavailable, "cannot grow, a table is full", "free space; nothing that was stored is lost"),
    1290: (Unavailable, "is read-only", "make the server writable"),
    1698: (InvalidInput, "refuses the user", "check DATABASE_URL"),
    1836: (Unavailable, "is read-only", "make the server writable"),
}


def error_code(error: DBAPIError) -> int | None:
    """The database's own error number; SQLite's primary result code. None where there is none."""
    original = error.orig
    if isinstance(original, sqlite3.Error):
        code = getattr(original, "sqlite_errorcode", None)
        return None if code is None else code & 0xFF
    arguments = getattr(original, "args", ())
    return arguments[0] if arguments and isinstance(arguments[0], int) else None


def is_transient(engine: Engine, error: DBAPIError) -> bool:
    """True if the same transaction may succeed a moment later: a lock, a deadlock, a server that is away."""
    if isinstance(error.orig, sqlite3.Error):
        return error_code(error) in _SQLITE_TRANSIENT and not _is_full_disk(engine, error)
    return isinstance(error, InterfaceError) or error.connection_invalidated or error_code(error) in _MYSQL_TRANSIENT


def explained(engine: Engine, error: DBAPIError) -> SlamHiveError | None:
    """The line for the user if the error is one that a user can cause; None for a bug."""
    label = database_label(engine)
    code = error_code(error)
    if isinstance(error.orig, sqlite3.Error) and _is_full_disk(engine, error):
        code = sqlite3.SQLITE_FULL
    if code is not None and isinstance(error.orig, sqlite3.Error) and code in _SQLITE_FINAL:
        what, remedy = _SQLITE_FINAL[code]
        return Unavailable(f"database {label} {what}", remedy)
    if code in _MYSQL_FINAL:
        kind, what, remedy = _MYSQL_FINAL[code]
        return kind(f"database {label} {what}", remedy)
    return None


def _is_full_disk(engine: Engine, error: DBAPIError) -> bool:
    """Tell if the disk is full, which SQLite reports as an I/O error or as a file that it cannot open.

    The index of the write-ahead log is mapped into memory: even a reader needs a page of disk for it.
    """
    if error_code(error) not in {sqlite3.SQLITE_IOERR, sqlite3.SQLITE_CANTOPEN}:
        return False
    try:
        return shutil.disk_usage(sqlite_file(engine.url).parent).free < FULL_DISK_BYTES
    except OSError:
        return False


def gave_up(engine: Engine, error: DBAPIError, waited_s: float) -> Unavailable:
    """The line for a database that stayed locked or away during the whole wait."""
    sqlite = isinstance(error.orig, sqlite3.Error)
    remedy = (
        "see which other program holds the file open, and whether its disk is there"
        if sqlite
        else "see whether the server runs and can be reached, then try again"
    )
    return Unavailable(
        f"database {database_label(engine)} has not answered for {waited_s:.0f} s: {short(error)}",
        f"nothing that was stored is lost; {remedy}",
    )


def short(error: DBAPIError) -> str:
    """The driver's message in one line, without statement and parameters."""
    arguments = getattr(error.orig, "args", ())
    text = str(arguments[-1]) if arguments else type(error.orig).__name__
    return " ".join(text.split())[:200]
