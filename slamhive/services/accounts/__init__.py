"""Accounts: who may sign in, with which role, their sessions and API tokens, and the audit log."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.domain.accounts import LOOPBACK_HOSTS
    from slamhive.services.accounts.service import (
        LONGEST_TOKEN_DAYS,
        Accounts,
        AccountSession,
        TokenRequest,
        accounts_needed,
        published,
    )


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
