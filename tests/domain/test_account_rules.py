"""Roles, scopes, names and passwords."""

from __future__ import annotations

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.accounts import (
    EVERYTHING,
    MAY,
    VISITOR_MAY,
    Action,
    Role,
    Scope,
    check_account_name,
    check_password,
    token_may,
)


def test_each_role_may_more_than_the_one_before() -> None:
    assert MAY[Role.READER] < MAY[Role.MEMBER] < MAY[Role.ADMIN]
    assert Action.CHANGE not in MAY[Role.READER]
    assert Action.ADMINISTER not in MAY[Role.MEMBER]
    assert frozenset({Action.VIEW}) == VISITOR_MAY
    assert not EVERYTHING & {Action.OWN, Action.SIGN_IN}


@pytest.mark.parametrize("role", list(Role))
@pytest.mark.parametrize("scopes", [(), (Scope.READ,), (Scope.CHANGE,), tuple(Scope)])
def test_a_token_may_no_more_than_its_owner_and_never_what_is_personal(role: Role, scopes: tuple[Scope, ...]) -> None:
    may = token_may(role, scopes)
    assert may <= MAY[role]
    assert not may & {Action.OWN, Action.SIGN_IN}
    assert (Action.VIEW in may) == bool(scopes)
    assert (Action.CHANGE in may) == (role is not Role.READER and Scope.CHANGE in scopes)
    assert (Action.ADMINISTER in may) == (role is Role.ADMIN and Scope.ADMINISTER in scopes)


@pytest.mark.parametrize("name", ["", "Anna", "a b", "-x", "a/b", "ä", "x" * 65, "a\n", "<b>"])
def test_names_that_are_refused(name: str) -> None:
    with pytest.raises(InvalidInput, match="is not allowed"):
        check_account_name(name)


@pytest.mark.parametrize("name", ["a", "anna.lab-2_x", "0", "x" * 64])
def test_names_that_are_taken(name: str) -> None:
    assert check_account_name(name) == name


@pytest.mark.parametrize(
    "password", ["", "short", "x" * 11, "x" * 201, "a" * 40, "ababababababab", "Anna-Lovelace", "annaanna1234567"]
)
def test_passwords_that_are_easy_to_guess(password: str) -> None:
    with pytest.raises(InvalidInput, match="the password") as refused:
        check_password("anna", password)
    assert not password or password not in str(refused.value)


@pytest.mark.parametrize("name", ["anna", "a"])
def test_a_long_password_is_taken(name: str) -> None:
    assert check_password(name, "correct horse battery") == "correct horse battery"
