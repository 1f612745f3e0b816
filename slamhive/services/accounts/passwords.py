"""Hashes of passwords: Argon2id with the parameters that argon2-cffi recommends (RFC 9106, 64 MiB)."""

from __future__ import annotations

import threading
from functools import cache

from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerificationError
from argon2.profiles import get_default_parameters

from slamhive.base.errors import Unavailable

PARAMETERS = get_default_parameters()
"""Neither a setting nor the environment can change them; tests replace them with cheap ones."""
MOST_AT_ONCE = 2
"""Each takes 64 MiB and tens of milliseconds, so strangers who send passwords get little of the machine."""
LONGEST_WAIT_S = 10.0

_slots = threading.BoundedSemaphore(MOST_AT_ONCE)


def hash_password(password: str) -> str:
    """The hash of a new password, with a random salt and its parameters."""
    with _Slot():
        return _hasher().hash(password)


def is_password(password_hash: str | None, password: str) -> bool:
    """Tell if the hash is that of ``password``. Without a hash the answer is no, and takes as long."""
    with _Slot():
        try:
            return _hasher().verify(password_hash or nobodys_hash(), password) and password_hash is not None
        except (VerificationError, InvalidHashError):
            return False


def is_outdated(password_hash: str) -> bool:
    """Tell if the hash was made with other parameters than new ones are."""
    return _hasher().check_needs_rehash(password_hash)


class _Slot:
    """Waits until few enough passwords are being hashed; raises Unavailable after some seconds."""

    def __enter__(self) -> None:
        if not _slots.acquire(timeout=LONGEST_WAIT_S):
            raise Unavailable("too many people are signing in", "try again in a minute")

    def __exit__(self, *_: object) -> None:
        _slots.release()


def _hasher() -> PasswordHasher:
    return PasswordHasher.from_parameters(PARAMETERS)


@cache
def nobodys_hash() -> str:
    """Make a hash to compare with passwords of unknown accounts, so that the time of an answer gives nothing away."""
    return _hasher().hash("")
