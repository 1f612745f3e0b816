"""Nothing that an installation can set makes passwords cheaper to guess than argon2-cffi recommends."""

from __future__ import annotations

from argon2.profiles import get_default_parameters

from slamhive.base.settings import SETTINGS
from slamhive.services.accounts import passwords


def test_passwords_cost_what_the_library_recommends() -> None:
    assert get_default_parameters() == passwords.PARAMETERS
    assert passwords.PARAMETERS.memory_cost >= 64 * 1024
    assert passwords.PARAMETERS.time_cost >= 3
    names = SETTINGS.keys() - {"smtp_password"}
    assert not [name for name in names if "argon" in name or "hash" in name or "password" in name]
