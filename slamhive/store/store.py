"""The way into the database: every access is a function that runs inside one transaction."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from sqlalchemy import Engine, create_engine
from sqlalchemy.exc import DBAPIError

from slamhive.base.clock import SYSTEM_CLOCK, Clock, monotonic_s
from slamhive.base.errors import NotFound, SlamHiveError
from slamhive.domain.accounts import NO_SHARING, Sharing, Viewer, Visibility
from slamhive.store import engine, migrate
from slamhive.store.accounts import AuditAct
from slamhive.store.changes import CHANGES_KEY, MAKER_KEY, Changes, Listener
from slamhive.store.engine import database_label, log_of, make_engine, writing
from slamhive.store.sight import restrict
from slamhive.store.transaction import Snapshot, Transaction, explained, gave_up, is_transient, short

T = TypeVar("T")
logger = logging.getLogger(__name__)

FIRST_PAUSE_S = 0.05
LONGEST_PAUSE_S = 2.0
LOOK_EVERY_S = 0.08
"""So often a waiting worker looks at the log of SQLite: one system call, so that a second of looking takes 1 ms."""
WRITES_BETWEEN_LOOKS = 500
"""A writer checks after so many transactions whether the tables have grown, see :mod:`slamhive.store.engine`."""


class Store:
    """Runs functions in transactions, and again while the database is locked or away.

    A function may therefore be called more than once. Whatever it does besides database work must be safe to repeat. It
    takes identifiers and times from outside. Repeating an operation of a repository after a lost answer does no harm.

    Args:
        engine: From :func:`slamhive.store.engine.make_engine`.
        retry_s: How long to go on trying before Unavailable is raised.
        clock: The time; a test may hand in its own.
    """

    def __init__(self, engine: Engine, retry_s: float = 60.0, clock: Clock = SYSTEM_CLOCK) -> None:
        self.engine = engine
        self._writing = writing(engine)
        self._log = log_of(engine)
        self._retry_s = retry_s
        self._clock = clock
        self._written = 0
        self._of_thread = threading.local()
        self.listener: Listener | None = None
        """Called after each transaction that stored what no run folder holds."""

    @property
    def label(self) -> str:
        """The database in words, without secrets."""
        return database_label(self.engine)

    def read(self, work: Callable[[Transaction], T]) -> T:
        """Return what ``work`` returns, from one consistent view of the database. SQLite never waits for a writer."""
        snapshot = self._snapshot
        # Hidden rows are chosen when a connection begins, so a snapshot serves the viewer that it began for.
        if snapshot is not None and snapshot.viewer == self.viewer:
            return self.retried(lambda: snapshot.read(work))
        return self.retried(lambda: self._attempt(self.engine, work))

    @contextmanager
    def snapshot(self) -> Iterator[None]:
        """All reads of this thread in the block see the database as the first of them did, in one transaction.

        A write in the block ends the transaction, so that reads after it see what was written. If the database goes
        away in between, reading goes on with a new snapshot. A block within a block belongs to the outer one.
        """
        if self._snapshot is not None:
            yield
            return
        self._of_thread.snapshot = snapshot = Snapshot(self.engine, self._clock, self.viewer)
        try:
            yield
        finally:
            del self._of_thread.snapshot
            snapshot.end()

    @property
    def _snapshot(self) -> Snapshot | None:
        return getattr(self._of_thread, "snapshot", None)

    def write(self, work: Callable[[Transaction], T]) -> T:
        """Return what ``work`` returns, once everything it wrote is on disk. If it raises, nothing is."""
        attempts: list[Changes] = []
        if self._snapshot is not None:
            self._snapshot.end()
        act = self._act

        def audited(transaction: Transaction) -> T:
            result = work(transaction)
            if act is not None:  # in the same transaction, so that change and line are both stored, or neither
                transaction.audit.add(act)
            return result

        def attempt() -> T:
            changes = Changes()  # new for each attempt: one that was rolled back has stored nothing
            attempts.append(changes)
            return self._attempt(self._writing, audited, changes)

        result = self.retried(attempt)
        self._of_thread.act = None  # one line for each request, however many transactions it takes
        self._tell(attempts)
        self._written += 1
        if self._written % WRITES_BETWEEN_LOOKS == 0:
            self.refresh_if_grown()
        return result

    def mark(self) -> tuple[int, int] | None:
        """Size and time of the log that every commit changes; None for a database server, which has no such file."""
        if self._log is None:
            return None
        try:
            found = self._log.stat()
        except OSError:  # nobody has written yet
            return 0, 0
        return found.st_size, found.st_mtime_ns

    def wait_for_commit(self, since: tuple[int, int], ended: threading.Event, longest_s: float) -> None:
        """Wait until somebody commits, ``ended`` is set, or time is up; a commit may rarely go unnoticed.

        Args:
            since: The mark before the caller looked for the last time, so that nothing in between is missed.
            ended: Ends the waiting.
            longest_s: How long to wait at most.
        """
        until_s = monotonic_s() + longest_s
        while self.mark() == since and (left_s := until_s - monotonic_s()) > 0:
            if ended.wait(min(LOOK_EVERY_S, left_s)):
                return

    @contextmanager
    def acting(self, act: AuditAct, visibility: Visibility | None = None) -> Iterator[None]:
        """The first transaction of this thread in the block also stores the line of ``act`` in the audit log.

        What any of its transactions stores belongs to the account of ``act``, with this ``visibility``.
        """
        self._of_thread.act, self._of_thread.maker = act, Sharing(act.account, visibility)
        try:
            yield
        finally:
            self._of_thread.act = self._of_thread.maker = None

    @contextmanager
    def seen_by(self, viewer: Viewer | None, account: str = "") -> Iterator[None]:
        """All accesses of this thread in the block find only what ``viewer`` may see; None sees everything.

        ``account``: who that is, also if they see everything.
        """
        before, self._of_thread.viewer = self.viewer, viewer
        named, self._of_thread.account = self.account, account
        try:
            yield
        finally:
            self._of_thread.viewer, self._of_thread.account = before, named

    @property
    def account(self) -> str:
        """The account that asks in this thread; empty for somebody without one."""
        return getattr(self._of_thread, "account", "")

    @property
    def maker(self) -> Sharing:
        """Owner and visibility of what this thread stores; nobody owns what is made without accounts."""
        return getattr(self._of_thread, "maker", None) or NO_SHARING

    @property
    def viewer(self) -> Viewer | None:
        """For whom this thread reads; None sees everything."""
        return getattr(self._of_thread, "viewer", None)

    def note_act(self) -> None:
        """Store the line of the act in the audit log, if there is one: what it asks for changes files only."""
        if self._act is not None:
            self.write(lambda _transaction: None)

    @property
    def _act(self) -> AuditAct | None:
        return getattr(self._of_thread, "act", None)

    @contextmanager
    def unheard(self) -> Iterator[None]:
        """Do not call the listener during the block: what is stored comes from where it would write."""
        listener, self.listener = self.listener, None
        try:
            yield
        finally:
            self.listener = listener

    def recheck(self) -> None:
        """Tell the listener to compare, after many rows were filed without notes."""
        if self.listener is not None:
            self.listener(Changes(uncertain=True))

    def refresh_statistics(self) -> None:
        """Renew the statistics of the tables after many rows were written."""
        self.retried(lambda: engine.refresh(self.engine))

    def close(self) -> None:
        """Close all connections. The store opens new ones if it is used again; a child process begins with this."""
        if self._written:
            self.refresh_if_grown()
            self._written = 0
        self.engine.dispose()

    def refresh_if_grown(self) -> None:
        """Renew the statistics if the tables have grown much. A failure is none of what was written."""
        try:
            engine.refresh_if_grown(self.engine)
        except DBAPIError as error:
            logger.info("database %s: statistics stay as they are: %s", self.label, short(error))

    def _tell(self, attempts: Sequence[Changes]) -> None:
        """Tell the listener what the last attempt has stored."""
        changes = attempts[-1]
        # A connection that breaks during COMMIT leaves open whether an earlier attempt was stored after all.
        changes.uncertain = len(attempts) > 1 and any(attempts)
        if self.listener is not None and changes:
            with self.seen_by(None):  # what it keeps is for everybody
                self.listener(changes)

    def _attempt(self, engine: Engine, work: Callable[[Transaction], T], changes: Changes | None = None) -> T:
        noted = {CHANGES_KEY: Changes() if changes is None else changes, MAKER_KEY: self.maker}
        with engine.connect().execution_options(**noted) as connection, connection.begin():
            restrict(connection, self.viewer)
            return work(Transaction(connection, self._clock))

    def retried(self, attempt: Callable[[], T]) -> T:
        """Return what ``attempt`` returns. It is called again while the database is locked or away."""
        began = self._clock.monotonic_s()
        pause_s = FIRST_PAUSE_S
        while True:
            try:
                result = attempt()
            except DBAPIError as error:
                waited_s = self._clock.monotonic_s() - began
                if not is_transient(self.engine, error):
                    raise (explained(self.engine, error) or error) from None
                if waited_s >= self._retry_s:
                    raise gave_up(self.engine, error, waited_s) from None
                if pause_s == FIRST_PAUSE_S:  # one line for each wait, not for each attempt
                    logger.warning("database %s: %s; trying again", self.label, short(error))
                self._clock.sleep(pause_s)
                pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
            else:
                return result


class AbsentStore(Store):
    """Stands for a database that does not exist: every access raises the reason.

    Args:
        reason: Why there is none.
    """

    def __init__(self, reason: SlamHiveError) -> None:
        super().__init__(create_engine("sqlite://"))
        self._reason = reason

    def retried(self, attempt: Callable[[], T]) -> T:  # noqa: ARG002 - the signature of every access
        """Raise the reason."""
        raise self._reason


def open_store(database_url: str, retry_s: float = 60.0, *, upgrade: bool = True, create: bool = True) -> Store:
    """A store on ``database_url``, with the tables of this software.

    Args:
        database_url: ``sqlite:///file`` or ``mysql+pymysql://user:password@host/database``.
        retry_s: How long a locked or absent database is tried again (``DATABASE_RETRY_S``).
        upgrade: Create or upgrade the tables; otherwise raise Unavailable if that is needed.
        create: If there are no tables at all, make them; otherwise raise NotFound and make nothing.
    """
    store = Store(make_engine(database_url), retry_s)
    if not create and not store.retried(lambda: migrate.has_tables(store.engine)):
        store.close()
        remedy = "slamhive reindex makes one from the run folders, slamhive serve or worker an empty one"
        raise NotFound(f"there is no database {store.label} yet", remedy)
    if upgrade:
        store.retried(lambda: migrate.upgrade(store.engine))
    else:
        store.retried(lambda: migrate.check_current(store.engine))
    return store
