"""Lists of configurations, their names, notes and groups, and deletion."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from slamhive.base.errors import Conflict, InvalidInput, NotFound, SlamHiveError
from slamhive.domain.configuration import Configuration
from slamhive.domain.parameters import Parameter, ParameterType, Value
from slamhive.store import ConfigurationFilter, ConfigurationPage, ParameterCondition, Store, open_store
from tests.store.store_samples import Samples, dataset

pytestmark = pytest.mark.quick

HOSTILE = "<script>'\"%_\\ 漢"
DEFINITIONS = (
    Parameter("count", ParameterType.INT, 1, "", general="features"),
    Parameter("factor", ParameterType.FLOAT, 1.0, ""),
    Parameter("switch", ParameterType.BOOL, True, ""),
    Parameter("words", ParameterType.STRING, "", ""),
    Parameter("kind", ParameterType.ENUM, "a", "", choices=("a", "b")),
    Parameter("K", ParameterType.MATRIX, (1.0,), ""),
)
ONE: dict[str, Value] = {"count": 1, "factor": 0.5, "switch": True, "words": "1", "kind": "a", "K": (1.0, 2.0)}
TWO: dict[str, Value] = {"count": 2, "factor": 2.0, "switch": False, "words": "true", "kind": "b", "K": (1.0, 2.5)}


def add(samples: Samples, parameters: dict[str, Value], algorithm: str = "a", data: str = "room") -> int:
    def work(tx: Any) -> int:
        algorithm_id = tx.catalogue.put_algorithm_named(algorithm, "p", "m")
        dataset_id = tx.catalogue.put_dataset(dataset(data), samples.now)
        content = Configuration(algorithm, data, parameters)
        found: int = tx.configurations.get_or_create(content, algorithm_id, dataset_id, samples.now, DEFINITIONS)[0]
        return found

    return samples.store.write(work)


def page(store: Store, after: str | None = None, limit: int = 50, **wanted: Any) -> ConfigurationPage:
    return store.read(lambda tx: tx.configuration_book.page(ConfigurationFilter(**wanted), after, limit))


def ids(store: Store, **wanted: Any) -> list[int]:
    return [record.id for record in page(store, **wanted).records]


def book(store: Store, work: Callable[[Any], Any]) -> Any:
    return store.write(lambda tx: work(tx.configuration_book))


@pytest.mark.parametrize(
    ("name", "operator", "value", "expected"),
    [("count", "=", "1", [1]), ("features", "=", "2", [2]), ("features", ">=", "1", [2, 1]), ("count", "<", "2", [1]),
     ("count", "=", "1.0", [1]), ("factor", "=", "0.5", [1]), ("factor", ">", "5e-1", [2]), ("factor", "<=", "x", []),
     ("switch", "=", "true", [1]), ("switch", "=", "False", [2]), ("switch", "=", "1", []), ("count", "=", "true", []),
     ("words", "=", "1", [1]), ("words", "=", "true", [2]), ("words", ">", "0", []), ("kind", "=", "b", [2]),
     ("kind", "=", "c", []), ("K", "=", "1, 2.5", [2]), ("K", "=", "[1, 2]", [1]), ("K", "=", "1", []),
     ("K", ">", "0", []), ("count", "=", "nan", [])],
)  # fmt: skip
def test_every_type_is_found_by_its_value(
    samples: Samples, name: str, operator: str, value: str, expected: list[int]
) -> None:
    made = {1: add(samples, ONE), 2: add(samples, TWO)}
    condition = ParameterCondition(name, operator, value)
    assert ids(samples.store, conditions=(condition,)) == [made[number] for number in expected]


def test_an_unknown_parameter_is_answered_with_the_nearest(samples: Samples) -> None:
    add(samples, ONE)
    with pytest.raises(NotFound, match="did you mean 'features'"):
        ids(samples.store, conditions=(ParameterCondition("feature", "=", "1"),))


def test_filters_add_up(samples: Samples) -> None:
    first, second, third = add(samples, ONE), add(samples, ONE, "b"), add(samples, ONE, "a", "hall")
    store = samples.store
    samples.queued(2, configuration_id=second)
    book(store, lambda b: b.describe(first, f"Half {HOSTILE}", "low light"))
    book(store, lambda b: b.add_to_group("night", [first, third, first]))
    assert ids(store, algorithms=("a",)) == [third, first]
    assert ids(store, algorithms=("a",), datasets=("hall",)) == [third]
    assert ids(store, group="night") == [third, first]
    assert ids(store, group="day") == []
    assert ids(store, used=True) == [second]
    assert ids(store, used=False) == [third, first]
    assert ids(store, text="half") == ids(store, text="LOW") == ids(store, text="'\"%_\\") == [first]
    assert ids(store, text="%") == [first]
    assert ids(store, text="x%") == []
    (record,) = page(store, text="half").records
    assert (record.name, record.note, record.groups, record.runs) == (f"Half {HOSTILE}", "low light", ("night",), 0)
    assert page(store, used=True).records[0].runs == 2


def test_pages_go_on_by_key(samples: Samples) -> None:
    made = [add(samples, {"count": number}) for number in range(5)]
    first = page(samples.store, limit=2)
    second = page(samples.store, first.next_key, 2)
    third = page(samples.store, second.next_key, 2)
    shown = [record.id for part in (first, second, third) for record in part.records]
    assert shown == made[::-1]
    assert (first.total, third.next_key) == (5, None)
    for key in ("x", "-1", "1" * 40, "²"):
        with pytest.raises(InvalidInput, match="unknown page key"):
            page(samples.store, key)
    with pytest.raises(InvalidInput, match="page size 0"):
        page(samples.store, limit=0)


def test_a_name_belongs_to_one(samples: Samples) -> None:
    first, second = add(samples, ONE), add(samples, TWO)
    store = samples.store
    book(store, lambda b: b.describe(first, "mine", ""))
    with pytest.raises(Conflict, match=f"the name 'mine' belongs to configuration {first}; choose another"):
        book(store, lambda b: b.describe(second, "mine", ""))
    book(store, lambda b: b.describe(first, "mine", "again"))
    book(store, lambda b: b.describe(second, None, "a note alone"))
    book(store, lambda b: b.describe(first, None, ""))
    book(store, lambda b: b.describe(second, "mine", ""))
    assert book(store, lambda b: b.named("mine")) == second
    assert book(store, lambda b: b.named("Mine")) is None
    with pytest.raises(NotFound, match="unknown configuration 99"):
        book(store, lambda b: b.describe(99, "x", ""))


def test_one_of_many_gets_the_name(samples: Samples, database_url: str) -> None:
    made = [add(samples, {"count": number}) for number in range(4)]
    start = threading.Barrier(4)

    def work(configuration_id: int) -> bool:
        own = open_store(database_url)
        start.wait()
        try:
            own.write(lambda tx: tx.configuration_book.describe(configuration_id, "mine", ""))
        except SlamHiveError:
            return False
        finally:
            own.close()
        return True

    with ThreadPoolExecutor(4) as pool:
        assert sum(pool.map(work, made)) == 1


def test_groups_come_and_go_with_their_members(samples: Samples) -> None:
    first, second = add(samples, ONE), add(samples, TWO)
    store = samples.store
    book(store, lambda b: b.add_to_group("b", [first, second]))
    book(store, lambda b: b.add_to_group("a", [first]))
    assert book(store, lambda b: b.groups()) == {"a": 1, "b": 2}
    assert page(store).records[1].groups == ("a", "b")
    with pytest.raises(NotFound, match=f"configuration {second} is not in the group 'a'"):
        book(store, lambda b: b.remove_from_group("a", [first, second]))
    book(store, lambda b: b.remove_from_group("a", [first]))
    assert book(store, lambda b: b.groups()) == {"b": 2}
    with pytest.raises(NotFound, match="unknown configuration 99"):
        book(store, lambda b: b.add_to_group("c", [first, 99]))
    assert book(store, lambda b: b.groups()) == {"b": 2}


def test_what_nothing_depends_on_can_be_deleted(samples: Samples) -> None:
    store = samples.store
    used, unused = add(samples, ONE), add(samples, TWO)
    samples.queued(1, configuration_id=used)
    book(store, lambda b: b.describe(unused, "old", "x"))
    book(store, lambda b: b.add_to_group("g", [unused]))
    with pytest.raises(Conflict, match=f"configuration {used} has 1 run; a configuration with runs must stay"):
        book(store, lambda b: b.delete(used))
    book(store, lambda b: b.delete(unused))
    assert ids(store) == [used]
    assert book(store, lambda b: b.groups()) == {}
    assert book(store, lambda b: b.named("old")) is None
    with pytest.raises(NotFound):
        book(store, lambda b: b.delete(unused))
    assert add(samples, TWO) != used
