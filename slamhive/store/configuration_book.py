"""What users do with stored configurations: list, name, group and delete them. Their content never changes."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import delete, func, insert, select, update
from sqlalchemy.exc import IntegrityError

from slamhive.errors import Conflict, NotFound
from slamhive.store.changes import changes_of
from slamhive.store.configuration_listing import configuration_records, list_configurations
from slamhive.store.configuration_models import ConfigurationGroup, ConfigurationLabel
from slamhive.store.configuration_records import ConfigurationFilter, ConfigurationPage, ConfigurationRecord
from slamhive.store.models import Configuration, ConfigurationValue, Run, VariantOption
from slamhive.store.rows import Repository, changed

_LABELS = ConfigurationLabel.__table__
_GROUPS = ConfigurationGroup.__table__


class ConfigurationBook(Repository):
    """Names are unique among configurations; a configuration may be in several groups."""

    def page(self, wanted: ConfigurationFilter, after: str | None, limit: int) -> ConfigurationPage:
        """One page, newest first; see :func:`list_configurations`."""
        return list_configurations(self._connection, wanted, after, limit)

    def get(self, configuration_id: int) -> ConfigurationRecord:
        """The configuration with this number; raises NotFound."""
        found = configuration_records(self._connection, [configuration_id])
        if not found:
            raise NotFound(f"unknown configuration {configuration_id}", "slamhive configuration list shows all")
        return found[0]

    def records(self, configuration_ids: Sequence[int]) -> tuple[ConfigurationRecord, ...]:
        """The configurations with these numbers, in this order; those that do not exist are left out."""
        return configuration_records(self._connection, configuration_ids)

    def latest_runs(self, configuration_id: int, limit: int) -> list[int]:
        """The numbers of its newest runs, newest first."""
        query = select(Run.__table__.c.id).where(Run.__table__.c.configuration_id == configuration_id)
        return self._column(query.order_by(Run.__table__.c.id.desc()).limit(limit))

    def named(self, name: str) -> int | None:
        """The number of the configuration called ``name``."""
        query = select(_LABELS.c.configuration_id).where(_LABELS.c.name == name)
        return self._connection.execute(query).scalar_one_or_none()

    def with_content(self, content_hash: str) -> int | None:
        """The number of the configuration with this content."""
        table = Configuration.__table__
        return self._connection.execute(
            select(table.c.id).where(table.c.content_hash == content_hash)
        ).scalar_one_or_none()

    def describe(self, configuration_id: int, name: str | None, note: str) -> None:
        """Set name and note; raises NotFound, or Conflict if another configuration has the name."""
        self.get(configuration_id)
        owner = None if name is None else self.named(name)
        if owner not in (None, configuration_id):
            raise _name_taken(name, owner)
        if name is None and not note:
            self._connection.execute(delete(_LABELS).where(_LABELS.c.configuration_id == configuration_id))
            changes_of(self._connection).described.add(configuration_id)
            return
        values = {"name": name, "note": note}
        changes_of(self._connection).described.add(configuration_id)
        try:
            if changed(
                self._connection, update(_LABELS).where(_LABELS.c.configuration_id == configuration_id).values(values)
            ):
                return
            self._connection.execute(insert(_LABELS).values(configuration_id=configuration_id, **values))
        except IntegrityError:  # another transaction was faster
            raise _name_taken(name, None) from None

    def add_to_group(self, group: str, configuration_ids: Sequence[int]) -> None:
        """Put configurations into a group, which keeps those that it has. Raises NotFound."""
        for configuration_id in dict.fromkeys(configuration_ids):
            if group not in self.get(configuration_id).groups:
                self._connection.execute(insert(_GROUPS).values(name=group, configuration_id=configuration_id))
        changes_of(self._connection).described.update(configuration_ids)

    def remove_from_group(self, group: str, configuration_ids: Sequence[int]) -> None:
        """Take configurations out of a group; an empty group disappears. Raises NotFound for one that is not in it."""
        for configuration_id in dict.fromkeys(configuration_ids):
            place = (_GROUPS.c.name == group, _GROUPS.c.configuration_id == configuration_id)
            if not changed(self._connection, delete(_GROUPS).where(*place)):
                raise NotFound(f"configuration {configuration_id} is not in the group {group!r}")
        changes_of(self._connection).described.update(configuration_ids)

    def groups(self) -> dict[str, int]:
        """All groups by name, and how many configurations each has."""
        query = select(_GROUPS.c.name, func.count()).group_by(_GROUPS.c.name).order_by(_GROUPS.c.name)
        return {row[0]: row[1] for row in self._connection.execute(query)}

    def delete(self, configuration_id: int) -> None:
        """Remove a configuration that nothing depends on; raises NotFound, or Conflict naming what does."""
        record = self.get(configuration_id)
        if record.experiments:
            owner = record.experiments[0]
            raise Conflict(f"{record.label} is part of experiment {owner}", "it stays as long as the experiment does")
        if record.runs:
            raise _has_runs(record.label, f"{record.runs} run{'s' if record.runs > 1 else ''}")
        for table in (_LABELS, _GROUPS, ConfigurationValue.__table__, VariantOption.__table__):
            self._connection.execute(delete(table).where(table.c.configuration_id == configuration_id))
        table = Configuration.__table__
        try:
            self._connection.execute(delete(table).where(table.c.id == configuration_id))
        except IntegrityError:  # a run was queued meanwhile
            raise _has_runs(record.label, "a new run") from None
        changes_of(self._connection).deleted.add(configuration_id)


def _has_runs(label: str, runs: str) -> Conflict:
    remedy = "a configuration with runs must stay; take it out of its groups, or rename it"
    return Conflict(f"{label} has {runs}", remedy)


def _name_taken(name: str | None, owner: int | None) -> Conflict:
    of = "another configuration" if owner is None else f"configuration {owner}"
    return Conflict(f"the name {name!r} belongs to {of}", "choose another")
