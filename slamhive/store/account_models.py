"""The tables of accounts. No run folder, ledger or archive holds what is in them."""

from __future__ import annotations

from sqlalchemy import ForeignKey, Index, Integer, String

from slamhive.domain.accounts import Role
from slamhive.store.account_records import KeyKind
from slamhive.store.models import NAME_LENGTH
from slamhive.store.tables import TABLE_OPTIONS, Base, column, optional
from slamhive.store.types import JsonText, UtcDateTime, enum_column


class Account(Base):
    """Somebody who can sign in. Rows are never removed."""

    __tablename__ = "accounts"
    id = column(Integer, primary_key=True)
    name = column(String(NAME_LENGTH), unique=True)
    role = column(enum_column(Role))
    password_hash = column(String(190))
    created_at = column(UtcDateTime)
    disabled_at = optional(UtcDateTime)


class AccountKey(Base):
    """What proves who somebody is: a connection or an API token. Only the SHA-256 digest of its secret is stored."""

    __tablename__ = "account_keys"
    id = column(Integer, primary_key=True)
    account_id = column(Integer, ForeignKey("accounts.id"), index=True)
    kind = column(enum_column(KeyKind))
    name = column(String(NAME_LENGTH))
    digest = column(String(64), unique=True)
    scopes = column(JsonText)
    created_at = column(UtcDateTime)
    expires_at = column(UtcDateTime)
    used_at = optional(UtcDateTime)


class AccountIdentity(Base):
    """Who somebody is at a provider of OpenID Connect; ``digest`` identifies issuer and subject together."""

    __tablename__ = "account_identities"
    id = column(Integer, primary_key=True)
    account_id = column(Integer, ForeignKey("accounts.id"), index=True)
    digest = column(String(64), unique=True)
    issuer = column(String(500))
    subject = column(String(255))
    created_at = column(UtcDateTime)


class AuditLine(Base):
    """Who asked for what. The name of the account is text, so that the line needs no other row."""

    __tablename__ = "audit_log"
    __table_args__ = (Index("ix_audit_log_account", "account", "id"), TABLE_OPTIONS)
    id = column(Integer, primary_key=True)
    uid = column(String(32), unique=True)
    at = column(UtcDateTime)
    account = column(String(NAME_LENGTH))
    via = column(String(100))
    address = column(String(64))
    action = column(String(64))
    subject = column(String(500))
