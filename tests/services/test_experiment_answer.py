"""The answer of an experiment as a sentence: who is best, whether a test says so, and what would settle it."""

from __future__ import annotations

import itertools

import pytest

from slamhive.documents.experiment import Certainty, DatasetAnswerDocument
from slamhive.services.experiments.answer import answer_on, question
from slamhive.services.experiments.ranking import RankEntries, RankEntry, placed
from slamhive.store.experiments import CellSample
from slamhive.store.records import ProtocolLabel

SE3 = ProtocolLabel("f" * 16, "SE(3)")


def entry(number: int, n: int, mean_m: float = 0.1, std_m: float = 0.01, failed: int = 0) -> RankEntry:
    """A configuration with ``n`` good and ``failed`` failed runs."""
    good = CellSample(number, SE3, n, mean_m, std_m**2) if n else None
    return RankEntry(number, good, failed, n + failed)


def answered(*entries: RankEntry, waiting: tuple[int, ...] = ()) -> DatasetAnswerDocument:
    names = {number: "abcdef"[number - 1] for number in (*(known.number for known in entries), *waiting)}
    ordered = sorted(entries, key=lambda known: known.key)
    return answer_on("room", RankEntries(SE3, 0, ordered, list(waiting)), names)


def test_means_that_a_test_tells_apart_name_the_best() -> None:
    found = answered(entry(1, 5, 0.1), entry(2, 5, 0.2))
    assert found.certainty is Certainty.SEPARATED
    assert found.sentence == "a is best: ATE 0.100 ± 0.010 m against 0.200 ± 0.010 m of b, p < 0.001."
    assert found.more_repeats is None


def test_means_that_no_test_tells_apart_say_how_many_repeats_would() -> None:
    found = answered(entry(1, 5, 0.100), entry(2, 5, 0.110))
    assert found.certainty is Certainty.NOT_SEPARATED
    assert found.leaders == ("a", "b")
    assert found.more_repeats is not None
    assert found.sentence == (
        f"a and b are not separated, p = {found.p_value:.2g}; {found.more_repeats} more repeats would decide."
    )
    decided = answered(entry(1, 5 + found.more_repeats, 0.100), entry(2, 5 + found.more_repeats, 0.110))
    assert decided.certainty is Certainty.SEPARATED
    assert answered(entry(1, 4 + found.more_repeats, 0.1), entry(2, 4 + found.more_repeats, 0.11)).certainty.undecided


def test_equal_means_are_never_separated_by_repeats() -> None:
    found = answered(entry(1, 5, 0.1), entry(2, 5, 0.1))
    assert found.more_repeats is None
    assert "no number of repeats would decide" in found.sentence


def test_one_run_each_cannot_separate_anything() -> None:
    found = answered(entry(1, 1, 0.05), entry(2, 1, 0.5))
    assert (found.certainty, found.more_repeats) == (Certainty.TOO_FEW, 2)
    assert "no test can judge one run of a and b; add 2 repeats" in found.sentence


def test_few_failures_do_not_separate_and_many_do() -> None:
    few = answered(entry(1, 5, 0.1), entry(2, 4, 0.1, failed=1))
    assert few.certainty is Certainty.NOT_SEPARATED
    many = answered(entry(1, 8, 0.1), entry(2, 2, 0.05, failed=6))
    assert many.certainty is Certainty.SEPARATED
    assert "0 of 8 runs failed, 6 of 8 of b" in many.sentence


def test_a_configuration_that_fails_rarely_and_is_more_accurate_is_not_beaten() -> None:
    found = answered(entry(1, 5, 0.2), entry(2, 4, 0.1, failed=1))
    assert found.leaders == ("a", "b")
    assert found.certainty is Certainty.NOT_SEPARATED


def places(*entries: RankEntry) -> dict[str, int | None]:
    ordered, found = placed(sorted(entries, key=lambda known: known.key))
    assert [found[known.number] for known in ordered] == sorted(found.values(), key=lambda place: place or 99)
    return {"abcdef"[number - 1]: place for number, place in found.items()}


def test_one_failure_more_takes_a_place_only_if_the_test_of_the_answer_says_so() -> None:
    assert places(entry(1, 5, 0.2), entry(2, 4, 0.1, failed=1)) == {"a": 1, "b": 1}
    assert places(entry(1, 8, 0.1), entry(2, 2, 0.05, failed=6)) == {"a": 1, "b": 2}


def test_one_that_shares_the_first_place_stands_before_one_that_does_not() -> None:
    entries = entry(1, 5, 0.1), entry(2, 5, 0.12, 0.001), entry(3, 2, 0.125, 0.05), entry(4, 1, 0.1)
    assert places(*entries) == {"a": 1, "c": 1, "b": 3, "d": None}
    assert answered(*entries).leaders == ("a", "c")


@pytest.mark.integration  # 828 triples
@pytest.mark.parametrize("first", [entry(1, 5, 0.1), entry(1, 3, 0.1, failed=1), entry(1, 9, 0.1, 0.03)])
def test_the_first_place_and_the_answer_name_the_same(first: RankEntry) -> None:
    others = [
        entry(2, n, mean_m, std_m, failed)
        for n, mean_m, std_m, failed in itertools.product((2, 6), (0.08, 0.11, 0.14), (0.005, 0.03), (0, 1, 3))
    ]
    for second, third in itertools.combinations(others, 2):
        entries = first, second, RankEntry(3, third.good, third.failed, third.total)
        best = {name for name, place in places(*entries).items() if place == 1}
        assert best == set(answered(*entries).leaders), entries


def test_what_has_no_result_keeps_the_answer_open() -> None:
    assert answered(waiting=(1, 2)).sentence == "No run has been evaluated yet."
    found = answered(entry(1, 5, 0.1), entry(2, 5, 0.2), waiting=(3,))
    assert found.certainty is Certainty.OPEN
    assert found.sentence.endswith("So far, c has no result.")
    assert answered(entry(1, 0, failed=3)).sentence == "No run gave a result: 3 runs failed."


def test_a_single_competitor_is_described() -> None:
    found = answered(entry(1, 5, 0.106, 0.019))
    assert found.certainty is Certainty.ALONE
    assert found.sentence == "a: ATE 0.106 ± 0.019 m; there is nothing to compare it with."


def test_the_question_is_that_of_the_description_or_of_the_axes() -> None:
    axes = {"algorithm": ("a", "b"), "dataset": ("room",)}
    assert question("Two systems. Is a better than b? See below.", axes) == "Is a better than b?"
    assert question("Two systems.", axes) == "Which of a and b is most accurate on room?"
    assert question("", {"algorithm": ("a",), "dataset": ("x", "y"), "rate": (5, 10)}) == (
        "Which rate suits a best on 2 datasets?"
    )
    assert question("", {"algorithm": ("a",), "dataset": ("x",)}) == "How accurate is a on x?"
