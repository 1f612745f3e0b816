"""The tables of what users say about configurations; the configurations themselves never change."""

from __future__ import annotations

from sqlalchemy import ForeignKey, String, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from slamhive.store.models import NAME_LENGTH, TABLE_OPTIONS, Base
from slamhive.store.types import LongText


class ConfigurationLabel(Base):
    """Name and note of a configuration; there is no row for one without."""

    __tablename__ = "configuration_labels"
    __table_args__ = (UniqueConstraint("name"), TABLE_OPTIONS)
    configuration_id: Mapped[int] = mapped_column(
        ForeignKey("configurations.id"), primary_key=True, autoincrement=False
    )
    name: Mapped[str | None] = mapped_column(String(NAME_LENGTH))
    note: Mapped[str] = mapped_column(LongText)


class ConfigurationGroup(Base):
    """A configuration in a group; a group is there as long as one is in it."""

    __tablename__ = "configuration_groups"
    __table_args__ = ({**TABLE_OPTIONS, "sqlite_with_rowid": False},)
    name: Mapped[str] = mapped_column(String(NAME_LENGTH), primary_key=True)
    configuration_id: Mapped[int] = mapped_column(ForeignKey("configurations.id"), primary_key=True, index=True)
