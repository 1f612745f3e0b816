"""One budget for all: what is lent at once has a limit, and who is refused learns who holds it."""

from __future__ import annotations

import threading

import pytest

from slamhive.base.budget import Budget, Lent, unbounded
from slamhive.base.errors import InvalidInput, Unavailable


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_all_together_get_no_more_than_there_is():
    clock = Clock()
    budget = Budget({Lent.MEMORY: 100_000_000, Lent.SUBMISSIONS: 2}, clock)
    with budget.share("the first", Lent.SUBMISSIONS) as first:
        first.take(Lent.MEMORY, 60_000_000)
        clock.now_s += 7
        with budget.share("the second", Lent.SUBMISSIONS) as second:
            second.take(Lent.MEMORY, 40_000_000)
            with pytest.raises(Unavailable) as refused:
                second.take(Lent.MEMORY, 1_000_000)
            assert refused.value.message == (
                "the second has to wait: 100 of 100 MB of memory are in use (the first, for 7 s; the second, for 0 s)"
            )
            assert refused.value.retry_after_s == 5
            words = "the third has to wait: this server works on 2 submissions at once"
            with pytest.raises(Unavailable, match=words), budget.share("the third", Lent.SUBMISSIONS):
                pass
            second.give_back(Lent.MEMORY, 40_000_000)
            with second.lend(Lent.MEMORY, 30_000_000):
                assert budget.used(Lent.MEMORY) == 90_000_000
    assert {kind: budget.used(kind) for kind in Lent} == dict.fromkeys(Lent, 0)
    assert budget.shares == []


def test_what_never_fits_is_no_matter_of_waiting():
    budget = Budget({Lent.DISK: 10_000_000})
    with (
        budget.share("a file") as share,
        pytest.raises(InvalidInput, match=r"a file needs 11 MB of temporary files, and all together may have 10 MB"),
    ):
        share.take(Lent.DISK, 11_000_000)


def test_a_refusal_and_an_error_give_everything_back():
    budget = Budget({Lent.IMPORTS: 1, Lent.DISK: 5})

    def fail(error: type[BaseException]) -> None:
        with budget.share("one", Lent.IMPORTS) as share:
            share.take(Lent.DISK, 5)
            raise error

    for error in (ValueError, KeyboardInterrupt):
        with pytest.raises(error):
            fail(error)
    assert budget.used(Lent.DISK) == budget.used(Lent.IMPORTS) == 0


def test_some_wait_and_the_others_are_refused_at_once():
    budget = Budget({Lent.SUBMISSIONS: 1})
    entered, done = threading.Event(), []

    def work(number: int) -> None:
        try:
            with budget.share(f"number {number}", Lent.SUBMISSIONS, 20.0):
                entered.wait(20)
                done.append(number)
        except Unavailable:
            done.append(-number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(1, 9)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(0.1)
    assert len([number for number in done if number < 0]) == 3
    entered.set()
    for thread in threads:
        thread.join(20)
    assert len([number for number in done if number > 0]) == 5


def test_the_command_line_shares_with_nobody():
    unbounded("a submission").take(Lent.MEMORY, 10**15)
