"""Numbers of claims: printed digits, units, deviations and margins."""

from __future__ import annotations

from typing import Any

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.claim import (
    Claim,
    ClaimedStatistic,
    ClaimState,
    MetricFamily,
    PrintedUnit,
    claims_words,
    read_printed,
    read_stated,
)
from slamhive.domain.gate import Margin
from slamhive.domain.metrics import metric

METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


def claim(text: str, **changes: Any) -> Claim:
    values: dict[str, Any] = {
        "algorithm": "kiss-icp",
        "version": None,
        "dataset": "room",
        "settings": "",
        "metric": "ate.rmse",
        "stated": read_stated(text, metric("ate.rmse"), METRES),
        "statistic": ClaimedStatistic.MEAN,
        "runs": None,
        "tolerance": Margin(0.0),
        "repeats": 5,
        "protocol": "default",
        "source": "Table 1",
    }
    return Claim(**values | changes)


def test_printed_digits_say_how_exact_a_number_is():
    assert read_printed("0.016").within == pytest.approx(0.0005)
    assert read_printed("0.0160").within == pytest.approx(0.00005)
    assert read_printed("12").within == 0.5


def test_a_number_keeps_its_unit_and_is_compared_in_it():
    found = read_stated("1.6 cm", metric("ate.rmse"), METRES)
    assert (found.printed.value, found.unit, found.std) == (1.6, "cm", None)
    assert found.printed.unit is PrintedUnit.CM
    assert found.factor == pytest.approx(100.0)


@pytest.mark.parametrize("text", ["0.016 ± 0.002 m", "0.016±0.002m", "  0.016 ±0.002  m "])
def test_a_deviation_may_follow_the_mean(text: str):
    found = read_stated(text, metric("ate.rmse"), METRES)
    assert (found.printed.value, found.std, found.unit) == (0.016, 0.002, "m")


def test_a_pure_number_has_no_unit():
    assert read_stated("0.95", metric("tracked.path"), {}).factor == 1.0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("0.016", "'0.016' has no unit; use mm or cm or m"),
        ("1.6 inch", "'inch' is no unit of it; use mm or cm or m"),
        ("small", "'small' is no number with its unit; write '1.6 cm', '0.016 ± 0.002 m'"),
        ("-0.1 m", "'-0.1' cannot be an error"),
        ("1.2.3 m", "'1.2.3' is not a number"),
        ("0.1 ± x m", "is no number with its unit"),
    ],
)
def test_what_is_no_number_with_its_unit_is_named(text: str, said: str):
    with pytest.raises(InvalidInput) as error:
        read_stated(text, metric("ate.rmse"), METRES)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_rounding_and_tolerance_add_up():
    assert claim("1.6 cm").margin == pytest.approx(0.05)
    assert claim("1.6 cm", tolerance=Margin(0.05)).margin == pytest.approx(0.05 + 0.08)
    assert claim("1.6 cm", tolerance=Margin(0.002, relative=False)).margin == pytest.approx(0.05 + 0.2)


def test_protocols_are_searched_for_errors_in_units_of_their_search():
    assert claim("1.6 cm").family is MetricFamily.ATE
    assert claim("1.6 cm", metric="rpe_point.mean").family is MetricFamily.RPE
    assert claim("1.6 cm", metric="ate.per_path").family is None
    assert claim("1.6 cm", metric="cpu.mean").family is None
    kilometres = read_stated("0.01 km", metric("ate.rmse"), {"km": 1e3})
    assert claim("1.6 cm", stated=kilometres).family is None


def test_the_words_of_a_badge_count_all_claims():
    assert claims_words([ClaimState.HOLDS] * 9 + [ClaimState.DIFFERS, *[ClaimState.CANNOT_RUN] * 2]) == "9 of 12 hold"
    assert claims_words([]) == "0 of 0 hold"
