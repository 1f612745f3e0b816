"""The tables of accounts. No run folder, ledger or archive holds what is in them."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import ForeignKey, Index, String
from sqlalchemy.orm import Mapped, mapped_column

from slamhive.domain.accounts import Role
from slamhive.store.account_records import KeyKind
from slamhive.store.models import NAME_LENGTH, TABLE_OPTIONS, Base
from slamhive.store.types import JsonText


class Account(Base):
    """Somebody who can sign in. Rows are never removed."""

    __tablename__ = "accounts"
    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(NAME_LENGTH), unique=True)
    role: Mapped[Role]
    password_hash: Mapped[str] = mapped_column(String(190))
    created_at: Mapped[datetime]
    disabled_at: Mapped[datetime | None]


class AccountKey(Base):
    """What proves who somebody is: a session or an API token. Only the SHA-256 digest of its secret is stored."""

    __tablename__ = "account_keys"
    id: Mapped[int] = mapped_column(primary_key=True)
    account_id: Mapped[int] = mapped_column(ForeignKey("accounts.id"), index=True)
    kind: Mapped[KeyKind]
    name: Mapped[str] = mapped_column(String(NAME_LENGTH))
    digest: Mapped[str] = mapped_column(String(64), unique=True)
    scopes: Mapped[Any] = mapped_column(JsonText)
    created_at: Mapped[datetime]
    expires_at: Mapped[datetime]
    used_at: Mapped[datetime | None]


class AccountIdentity(Base):
    """Who somebody is at a provider of OpenID Connect; ``digest`` identifies issuer and subject together."""

    __tablename__ = "account_identities"
    id: Mapped[int] = mapped_column(primary_key=True)
    account_id: Mapped[int] = mapped_column(ForeignKey("accounts.id"), index=True)
    digest: Mapped[str] = mapped_column(String(64), unique=True)
    issuer: Mapped[str] = mapped_column(String(500))
    subject: Mapped[str] = mapped_column(String(255))
    created_at: Mapped[datetime]


class AuditLine(Base):
    """Who asked for what. The name of the account is text, so that the line needs no other row."""

    __tablename__ = "audit_log"
    __table_args__ = (Index("ix_audit_log_account", "account", "id"), TABLE_OPTIONS)
    id: Mapped[int] = mapped_column(primary_key=True)
    uid: Mapped[str] = mapped_column(String(32), unique=True)
    at: Mapped[datetime]
    account: Mapped[str] = mapped_column(String(NAME_LENGTH))
    via: Mapped[str] = mapped_column(String(100))
    address: Mapped[str] = mapped_column(String(64))
    action: Mapped[str] = mapped_column(String(64))
    subject: Mapped[str] = mapped_column(String(500))
