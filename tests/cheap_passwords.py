"""Hashing of passwords that takes no time, for tests that sign in."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def cheap_passwords() -> Iterator[None]:
    """Passwords are hashed with the cheapest parameters in the block."""
    from argon2.profiles import CHEAPEST  # noqa: PLC0415 - few tests need it

    from slamhive.services.accounts import passwords  # noqa: PLC0415

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(passwords, "PARAMETERS", CHEAPEST)
        passwords.nobodys_hash.cache_clear()
        yield
    passwords.nobodys_hash.cache_clear()
