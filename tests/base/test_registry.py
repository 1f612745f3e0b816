from __future__ import annotations

import logging
import threading
from importlib.metadata import PathDistribution
from pathlib import Path
from typing import Protocol, runtime_checkable

import pytest

from slamhive.base.errors import Conflict, NotFound
from slamhive.base.registry import Registry, instances_of


@runtime_checkable
class Thing(Protocol):
    size: int

    def use(self) -> None: ...


def test_entries_are_found_by_name_and_listed_sorted():
    registry: Registry[int] = Registry("thing")
    registry.register("b", 2)
    registry.register("a", 1)
    assert registry.get("a") == 1
    assert registry.names() == ["a", "b"]
    assert list(registry) == [("a", 1), ("b", 2)]
    assert list(registry.entries) == ["b", "a"]


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


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Make a package of one module with entry points in the group ``slamhive.tests``."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def make(package: str, code: str, **entries: str) -> PathDistribution:
        module = package.replace("-", "_")
        (tmp_path / f"{module}.py").write_text(code)
        folder = tmp_path / f"{module}-1.0.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Name: {package}\nVersion: 1.0\n")
        lines = "".join(f"{name} = {module}:{value}\n" for name, value in entries.items())
        (folder / "entry_points.txt").write_text(f"[slamhive.tests]\n{lines}")
        return PathDistribution(folder)

    return make


def things() -> Registry[Thing]:
    return Registry("thing", "slamhive.tests", instances_of(Thing))


GOOD = "class Good:\n    size = 1\n    def use(self): ...\nGOOD = Good()\nBAD = 5\n"


def test_a_broken_plugin_leaves_the_others_and_says_why(plugin, caplog: pytest.LogCaptureFixture):
    plugin("test-plugin-good", GOOD, good="GOOD", bad="BAD")
    plugin("test-plugin-lost", "import test_plugin_no_such_module\n", lost="X")
    registry = things()
    with caplog.at_level(logging.WARNING):
        assert registry.names() == ["good"]
        assert registry.names() == ["good"]
    assert len(caplog.records) == 2
    with pytest.raises(NotFound, match=r"'lost' of test-plugin-lost 1.0 .*No module named .*pip uninstall"):
        registry.get("lost")
    with pytest.raises(NotFound, match="it is no Thing, but of type int without size, use"):
        registry.get("bad")
    assert {origin.name: origin.problem is None for origin in registry.origins()} == {
        "good": True,
        "bad": False,
        "lost": False,
    }


def test_of_two_packages_with_one_name_the_same_one_wins(plugin):
    plugin("test-plugin-two", GOOD, good="GOOD")
    plugin("test-plugin-one", GOOD, good="GOOD")
    registry = things()
    assert registry.get("good") is not None
    one, two = sorted(registry.origins(), key=lambda origin: origin.package)
    assert one.problem is None
    assert two.problem == "the name 'good' is taken by test-plugin-one"


def test_threads_load_plugins_once(plugin, tmp_path: Path):
    counting = f"with open({str(tmp_path / 'count')!r}, 'a') as stream:\n    stream.write('x')\n"
    plugin("test-plugin-slow", f"import time\n{counting}time.sleep(0.05)\n{GOOD}", good="GOOD")
    registry, seen = things(), []
    threads = [threading.Thread(target=lambda: seen.append(registry.names())) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert seen == [["good"]] * 8
    assert (tmp_path / "count").read_text() == "x"


def test_a_plugin_may_ask_for_the_registry_while_it_is_loaded(plugin, monkeypatch: pytest.MonkeyPatch):
    registry = things()
    registry.register("shipped", instances_of_thing())
    monkeypatch.setitem(globals(), "asked", registry)
    code = f"import {__name__} as tests\nassert tests.asked.names() == ['shipped']\n{GOOD}"
    plugin("test-plugin-curious", code, good="GOOD")
    assert registry.names() == ["good", "shipped"]


def instances_of_thing() -> Thing:
    class Shipped:
        size = 2

        def use(self) -> None: ...

    return Shipped()
