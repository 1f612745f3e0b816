"""Whether callers of the web server have to sign in."""

from __future__ import annotations

from slamhive.domain.accounts import LOOPBACK_HOSTS
from slamhive.settings import Auth, Mode, Settings


def accounts_needed(settings: Settings, host: str) -> bool:
    """Whether a server that binds to ``host`` asks who calls. One that only shows never does."""
    if settings.mode is Mode.VIEW_ONLY:
        return False
    if settings.auth is Auth.AUTO:
        return host not in LOOPBACK_HOSTS
    return settings.auth is Auth.ACCOUNTS
