"""Which of several names fits some words best."""

from __future__ import annotations

from slamhive.domain.finding import Found, FoundKind, best


def entry(name: str, words: str = "", key: str = "") -> Found:
    return Found(FoundKind.ALGORITHM, key or name, name, words)


ENTRIES = (
    entry("orb-slam3-stereo", "ORB-SLAM3 (stereo)"),
    entry("orb-slam3", "ORB-SLAM3"),
    entry("kiss-icp", "Point-to-point ICP, in the spirit of orb-slam3"),
    entry("vins-mono", "Visual-inertial"),
)


def names(text: str, most: int = 8) -> list[str]:
    return [found.name for found in best(text, ENTRIES, most)]


def test_the_same_name_is_first_then_its_beginnings_then_descriptions() -> None:
    assert names("orb-slam3") == ["orb-slam3", "orb-slam3-stereo", "kiss-icp"]


def test_all_words_must_be_there_in_any_order_and_case() -> None:
    assert names("STEREO orb") == ["orb-slam3-stereo"]
    assert names("stereo inertial") == []


def test_no_words_find_nothing() -> None:
    assert names(" ") == []


def test_only_the_best_are_shown() -> None:
    assert names("o", 1) == ["orb-slam3"]
