"""The audit log: who asked for what. A line is stored in the transaction of the change, so neither is there alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from sqlalchemy import select

from slamhive.store import account_models as models
from slamhive.store.account_records import Act, AuditLine
from slamhive.store.changes import changes_of
from slamhive.store.rows import Repository, cut, get_or_insert

SUBJECT_LENGTH = 500
_AUDIT = models.AuditLine.__table__
_FIELDS = ("id", "at", "account", "via", "address", "action", "subject")


class AuditRepository(Repository):
    """Lines are added and read; nothing changes or removes them."""

    def add(self, act: Act) -> None:
        """Store the line of ``act``, with what the transaction has stored so far; twice does no harm."""
        subject = "; ".join(part for part in (act.subject, *self._stored()) if part)
        values = {
            **{name: getattr(act, name) for name in ("at", "account", "via", "address", "action")},
            "subject": cut(subject, SUBJECT_LENGTH),
        }
        get_or_insert(self._connection, models.AuditLine, {"uid": act.uid}, values)

    def lines(self, limit: int, before: int | None = None, account: str | None = None) -> list[AuditLine]:
        """The newest lines, of one account or of all; ``before`` continues after the line of that id."""
        query = select(*(_AUDIT.c[name] for name in _FIELDS)).order_by(_AUDIT.c.id.desc()).limit(limit)
        if before is not None:
            query = query.where(_AUDIT.c.id < before)
        if account is not None:
            query = query.where(_AUDIT.c.account == account)
        return [AuditLine(**row._mapping) for row in self._connection.execute(query)]

    def _stored(self) -> Iterator[str]:
        """The numbers of new runs and names of experiments: the request does not have them."""
        changes = changes_of(self._connection)
        runs = [row.id for row in changes.runs]
        if runs:
            yield f"queued {in_ranges(runs)}"
        yield from sorted(changes.started)


def in_ranges(numbers: Sequence[int]) -> str:
    """Numbers of runs in words: ``runs 3, 5 to 8``."""
    ranges: list[list[int]] = []
    for number in sorted(numbers):
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1][1] = number
        else:
            ranges.append([number, number])
    words = [str(first) if first == last else f"{first} to {last}" for first, last in ranges]
    return f"run{'s' if len(numbers) > 1 else ''} {', '.join(words)}"
