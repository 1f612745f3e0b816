"""Configurations: exact values, one row for equal content."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from slamhive.base.errors import NotFound
from slamhive.domain.configuration import Configuration, Playback, PlaybackMode, VariantStep
from slamhive.domain.parameters import Parameter, ParameterType, Value
from slamhive.store import ConfigurationFilter, ParameterCondition, Store, StoredParameter, open_store
from tests.store.store_samples import Samples, dataset

pytestmark = pytest.mark.quick

NOW = datetime(2026, 5, 4, 3, 2, 1, tzinfo=UTC)
EVERY_TYPE: dict[str, Value] = {
    "zeta": 1,
    "alpha": 1.0,
    "switch": True,
    "text": "1",
    "quoted": "a'b\"c\\d%s;-- <script> ü 漢 🐝 ",
    "empty": "",
    "matrix": (1.0, 0.1, -2e-300),
    "tiny": 5e-324,
    "precise": 0.1 + 0.2,
    "huge": 10**400,
    "long": "x" * 1024,
}


def create(store: Store, configuration: Configuration, definitions: tuple[Parameter, ...] = ()) -> tuple[int, bool]:
    def work(tx) -> tuple[int, bool]:
        algorithm_id = tx.catalogue.put_algorithm_named(configuration.algorithm, "orb-slam3", "stereo")
        dataset_id = tx.catalogue.put_dataset(dataset(configuration.dataset), NOW)
        found: tuple[int, bool] = tx.configurations.get_or_create(
            configuration, algorithm_id, dataset_id, NOW, definitions
        )
        return found

    return store.write(work)


def test_values_come_back_with_type_and_order(store: Store) -> None:
    playback = Playback(PlaybackMode.SEQUENTIAL, 0.1)
    configuration = Configuration("orb-slam3-stereo", "room", EVERY_TYPE, playback)
    configuration_id, created = create(store, configuration)
    found = store.read(lambda tx: tx.configurations.get(configuration_id))
    assert created
    assert found == configuration
    assert found.content_hash == configuration.content_hash
    assert [type(value) for value in found.parameters.values()] == [type(value) for value in EVERY_TYPE.values()]
    assert list(found.parameters) == list(EVERY_TYPE)


VARIANT = (
    VariantStep("rate", ("imu", "cam0"), {"every": 2}),
    VariantStep("fog", ("lidar",), {"visibility_m": 50.0, "backscatter": 0.0, "seed": 3}),
    VariantStep("drop_out", ("cam0",), {"fraction": 0.5, "together": True}),
)


def test_a_variant_comes_back_with_order_and_types(store: Store) -> None:
    configuration = Configuration("orb-slam3-stereo", "room", {}, variant=VARIANT)
    configuration_id, _ = create(store, configuration)
    found = store.read(lambda tx: tx.configurations.get(configuration_id))
    assert found == configuration
    assert found.content_hash == configuration.content_hash
    assert [step.content for step in found.variant] == [step.content for step in VARIANT]


def test_steps_their_order_and_their_absence_are_different_configurations(store: Store) -> None:
    variants = [(), VARIANT, VARIANT[::-1], VARIANT[:1], (VariantStep("rate", ("cam0", "imu"), {"every": 2.0}),)]
    made = [create(store, Configuration("a", "room", {}, variant=variant)) for variant in variants]
    assert [created for _, created in made] == [True] * len(variants)
    assert create(store, Configuration("a", "room", {}, variant=VARIANT)) == (made[1][0], False)
    with store.engine.connect() as connection:
        rows = connection.exec_driver_sql("SELECT count(*) FROM configurations WHERE variant IS NULL").scalar()
    assert rows == 1


def listed(store: Store, **wanted: Any) -> list[int]:
    page = store.read(lambda tx: tx.configuration_book.page(ConfigurationFilter(**wanted), None, 50))
    return [record.id for record in page.records]


value_strategy = st.one_of(
    st.integers(),
    st.floats(allow_nan=False, allow_infinity=False),
    st.booleans(),
    st.text(st.characters(min_codepoint=32, exclude_categories=["Cs"]), max_size=300),
    st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=16).map(tuple),
)


@pytest.mark.integration
@pytest.mark.parametrize("store", ["sqlite"], indirect=True)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(parameters=st.dictionaries(st.text("abcXYZ.", min_size=1, max_size=20), value_strategy, max_size=5))
def test_any_configuration_survives(store: Store, parameters: dict[str, Value]) -> None:
    configuration = Configuration("orb-slam3-stereo", "room", parameters)
    configuration_id, _ = create(store, configuration)
    found = store.read(lambda tx: tx.configurations.get(configuration_id))
    assert found.content_hash == configuration.content_hash


def test_equal_content_is_one_row_and_types_make_a_difference(store: Store) -> None:
    one = create(store, Configuration("a", "room", {"x": 1, "y": 2}))
    same = create(store, Configuration("a", "room", {"y": 2, "x": 1}))
    others = [create(store, Configuration("a", "room", {"x": x, "y": 2})) for x in (1.0, True, "1")]
    others.append(create(store, Configuration("A", "room", {"x": 1, "y": 2})))
    assert one[1]
    assert same == (one[0], False)
    assert all(created for _, created in others)
    assert len({configuration_id for configuration_id, _ in others} | {one[0]}) == 5


def test_names_that_differ_in_case_or_accent_are_different(store: Store) -> None:
    parameters: dict[str, Value] = {"nFeatures": 1, "nfeatures": 2, "nféatures": 3}
    configuration_id, _ = create(store, Configuration("a", "room", parameters))
    assert store.read(lambda tx: tx.configurations.parameters_of(configuration_id)) == parameters


def test_definitions_describe_the_parameters(store: Store) -> None:
    definition = Parameter("voxel", ParameterType.FLOAT, 1.0, "Voxel", unit="m", general="voxel_size")
    create(store, Configuration("a", "room", {"voxel": 1.0, "other": 2}), (definition,))
    with store.engine.connect() as connection:
        rows = connection.exec_driver_sql("SELECT * FROM parameters ORDER BY id").mappings().all()
    assert [(row["key"], row["type"], row["unit"], row["general"]) for row in rows] == [
        ("voxel", "float", "m", "voxel_size"),
        ("other", "int", "", None),
    ]


def test_an_edited_definition_leaves_what_is_stored_alone(store: Store) -> None:
    """Type and unit are part of what a value means: the edited parameter is another; a general name is an alias."""
    metres = Parameter("voxel", ParameterType.FLOAT, 1.0, "Voxel", unit="m")
    old = Configuration("a", "room", {"voxel": 1.0, "n": 3})
    old_id, _ = create(store, old, (metres,))
    edited = replace(metres, unit="cm", general="voxel_size")
    new_id, created = create(store, Configuration("a", "room", {"voxel": 150.0, "n": 3}), (edited,))
    assert created
    stored = store.read(lambda tx: tx.configuration_book.get(old_id))
    assert stored.configuration == old
    assert stored.configuration.content_hash == old.content_hash
    assert stored.parameters["voxel"] == StoredParameter("float", "m", "voxel_size")
    assert store.read(lambda tx: tx.configuration_book.get(new_id)).parameters["voxel"].unit == "cm"
    assert create(store, old, (edited,)) == (old_id, False)
    (found,) = listed(store, conditions=(ParameterCondition("voxel_size", ">", "100"),))
    assert found == new_id


def test_a_type_that_was_edited_is_found_by_both_types(store: Store) -> None:
    number = Parameter("mode", ParameterType.INT, 1, "")
    first, _ = create(store, Configuration("a", "room", {"mode": 2}), (number,))
    word = replace(number, type=ParameterType.STRING, default="2")
    second, _ = create(store, Configuration("a", "room", {"mode": "2"}), (word,))
    assert listed(store, conditions=(ParameterCondition("mode", "=", "2"),)) == [second, first]


def test_numbers_and_text_are_where_searches_look(store: Store) -> None:
    create(store, Configuration("a", "room", {"n": 2, "f": 0.5, "b": True, "s": "fast", "m": (1.0,), "h": 10**400}))
    with store.engine.connect() as connection:
        rows = connection.exec_driver_sql(
            "SELECT number_value, text_value FROM configuration_values ORDER BY parameter_id"
        ).all()
    assert [tuple(row) for row in rows[:5]] == [(2.0, None), (0.5, None), (1.0, None), (None, "fast"), (None, None)]
    assert rows[5][0] is None


def test_unknown_configuration(store: Store) -> None:
    with pytest.raises(NotFound, match="unknown configuration 12"):
        store.read(lambda tx: tx.configurations.get(12))


def test_two_that_create_the_same_at_once_get_the_same(database_url: str, samples: Samples) -> None:
    samples.configuration()
    start = threading.Barrier(4)

    def work(_number: int) -> tuple[int, bool]:
        own = open_store(database_url)
        start.wait()
        found = create(own, Configuration("orb-slam3-stereo", "room", {"nFeatures": 7, "other": 1.5}))
        own.close()
        return found

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(work, range(4)))
    assert len({configuration_id for configuration_id, _ in found}) == 1
    assert sum(created for _, created in found) == 1
    parameters = samples.store.read(lambda tx: tx.configurations.parameters_of(found[0][0]))
    assert parameters == {"nFeatures": 7, "other": 1.5}
