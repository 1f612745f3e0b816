"""The tables of what users say about configurations; the configurations themselves never change."""

from __future__ import annotations

from sqlalchemy import ForeignKey, Integer, String, UniqueConstraint

from slamhive.store.models import NAME_LENGTH
from slamhive.store.tables import TABLE_OPTIONS, Base, column, optional
from slamhive.store.types import LongText


class ConfigurationLabel(Base):
    """Name and note of a configuration; there is no row for one without."""

    __tablename__ = "configuration_labels"
    __table_args__ = (UniqueConstraint("name"), TABLE_OPTIONS)
    configuration_id = column(Integer, ForeignKey("configurations.id"), primary_key=True, autoincrement=False)
    name = optional(String(NAME_LENGTH))
    note = column(LongText)


class ConfigurationGroup(Base):
    """A configuration in a group; a group is there as long as one is in it."""

    __tablename__ = "configuration_groups"
    __table_args__ = ({**TABLE_OPTIONS, "sqlite_with_rowid": False},)
    name = column(String(NAME_LENGTH), primary_key=True)
    configuration_id = column(Integer, ForeignKey("configurations.id"), primary_key=True, index=True)
