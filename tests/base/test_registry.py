from __future__ import annotations

import pytest

from slamhive.errors import Conflict, NotFound
from slamhive.registry import Registry


def test_entries_are_found_by_name_and_listed_sorted():
    registry: Registry[int] = Registry("thing")
    registry.register("b", 2)
    registry.register("a", 1)
    assert registry.get("a") == 1
    assert registry.names() == ["a", "b"]
    assert list(registry) == [("a", 1), ("b", 2)]


def test_an_unknown_name_lists_the_choices():
    registry: Registry[int] = Registry("dataset importer")
    registry.register("kitti-odometry", 1)
    with pytest.raises(NotFound, match=r"unknown dataset importer 'kiti'.*kitti-odometry"):
        registry.get("kiti")


def test_a_name_is_taken_once():
    registry: Registry[int] = Registry("thing")
    registry.register("a", 1)
    with pytest.raises(Conflict, match="'a' is registered already"):
        registry.register("a", 2)
