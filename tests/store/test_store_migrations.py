"""The tables: up, down, up again; equal to the models; never those of a newer software."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Engine, inspect

from slamhive.base.errors import Conflict, Unavailable
from slamhive.store import migrate, open_store
from slamhive.store.engine import make_engine
from slamhive.store.migrate import METADATA
from slamhive.store.models import MEASURED_PROTOCOL_ID
from tests import fresh_tables
from tests.fresh_tables import migrated_tables

pytestmark = pytest.mark.integration

BOTH = ["sqlite", pytest.param("mysql", marks=pytest.mark.mysql)]


@pytest.fixture(autouse=True)
def migrated() -> Iterator[None]:
    """Other tests copy the tables of new databases."""
    with migrated_tables():
        yield


@pytest.fixture(params=BOTH)
def engine(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Engine]:
    """An engine on a database without any table."""
    if request.param == "sqlite":
        engine = make_engine(f"sqlite:///{tmp_path}/empty%20%25.db")
        yield engine
        engine.dispose()
        return
    server = request.getfixturevalue("database_server")
    engine = make_engine(server.create_database("slamhive_migrations"))
    yield engine
    engine.dispose()
    server.drop_database("slamhive_migrations")


def tables(engine: Engine) -> set[str]:
    return set(inspect(engine).get_table_names()) - {"alembic_version"}


def test_up_down_and_up_again(engine: Engine) -> None:
    assert migrate.current(engine) is None
    for _ in range(2):
        migrate.upgrade(engine)
        assert migrate.current(engine) == migrate.head()
        assert tables(engine) == set(METADATA.tables)
        migrate.downgrade(engine)
        assert migrate.current(engine) is None
        assert tables(engine) == set()


def test_tests_copy_the_tables_that_migrations_make(tmp_path: Path) -> None:
    def dump(name: str) -> list[str]:
        open_store(f"sqlite:///{tmp_path / name}").close()
        with closing(sqlite3.connect(tmp_path / name)) as connection:
            return list(connection.iterdump())

    migrated = dump("migrated.db")
    migrate.upgrade = fresh_tables.upgrade
    assert dump("copied.db") == migrated


def test_the_newest_revision_of_the_file_names_is_that_of_alembic() -> None:
    assert ScriptDirectory(str(Path(migrate.__file__).parent / "migrations")).get_current_head() == migrate.head()


def test_the_migrations_make_what_the_models_say(engine: Engine) -> None:
    migrate.upgrade(engine)
    with engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True, "compare_server_default": True})
        assert compare_metadata(context, METADATA) == []


def test_the_comparison_would_see_a_difference(engine: Engine) -> None:
    migrate.upgrade(engine)
    with engine.begin() as connection:
        connection.exec_driver_sql("ALTER TABLE hosts ADD COLUMN surprise INTEGER")
        connection.exec_driver_sql("DROP INDEX ix_runs_created_at" + _on(engine, "runs"))
    with engine.connect() as connection:
        found = compare_metadata(MigrationContext.configure(connection), METADATA)
    assert {difference[0] for difference in found} >= {"remove_column", "add_index"}


def test_measured_figures_have_their_protocol_row(engine: Engine) -> None:
    migrate.upgrade(engine)
    with engine.connect() as connection:
        rows = connection.exec_driver_sql("SELECT id, fingerprint FROM protocols").all()
    assert [tuple(row) for row in rows] == [(MEASURED_PROTOCOL_ID, "measured")]


def test_configurations_of_the_first_version_use_their_datasets_as_they_are(engine: Engine) -> None:
    migrate.upgrade(engine, "0001")
    _add_configuration(engine)
    migrate.upgrade(engine)
    with engine.connect() as connection:
        assert connection.exec_driver_sql("SELECT variant FROM configurations").all() == [(None,)]
    migrate.downgrade(engine, "0001")
    assert "variant" not in {column["name"] for column in inspect(engine).get_columns("configurations")}
    assert migrate.current(engine) == "0001"
    with engine.connect() as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM configurations").scalar() == 1


def test_going_back_is_refused_where_runs_would_be_told_wrongly(engine: Engine) -> None:
    migrate.upgrade(engine)
    _add_configuration(engine)
    with engine.begin() as connection:
        connection.exec_driver_sql("UPDATE configurations SET variant='[]'")
    with pytest.raises(Conflict, match="1 configurations use variants"):
        migrate.downgrade(engine, "0001")
    assert_whole_at(engine, "0002")


def test_runs_of_the_second_version_belong_to_no_experiment_and_wait_for_nothing(engine: Engine) -> None:
    migrate.upgrade(engine, "0002")
    _add_configuration(engine)
    _add_run(engine)
    columns = "experiment_id, cell, held, affinity, stop_when"
    for _ in range(2):
        migrate.upgrade(engine)
        with engine.connect() as connection:
            row = connection.exec_driver_sql(f"SELECT uid, {columns} FROM runs").one()
        assert tuple(row) == ("u", None, None, 0, "", None)
        migrate.downgrade(engine, "0002")
        assert not set(columns.split(", ")) & {column["name"] for column in inspect(engine).get_columns("runs")}
    with engine.connect() as connection:
        assert connection.exec_driver_sql("SELECT uid FROM runs").all() == [("u",)]


def test_going_back_is_refused_where_experiments_would_be_lost(engine: Engine) -> None:
    migrate.upgrade(engine)
    with engine.begin() as connection:
        connection.exec_driver_sql(
            "INSERT INTO experiments (id, uid, name, description, content_hash, source, state, executor, priority, "
            "repeats, cells, runs, complete, created_at) VALUES "
            "(1, 'u', 'n', '', 'h', '', 'active', 'docker', 0, 1, 1, 1, 1, '2026-05-04 03:02:01')"
        )
    with pytest.raises(Conflict, match="1 experiments are stored"):
        migrate.downgrade(engine, "0002")
    assert_whole_at(engine, "0003")


def test_of_runs_of_the_seventh_version_no_disturbance_is_known(engine: Engine) -> None:
    migrate.upgrade(engine, "0007")
    _add_configuration(engine)
    _add_run(engine)
    for _ in range(2):
        migrate.upgrade(engine)
        with engine.connect() as connection:
            query = "SELECT uid, disturbed_by, disturbance, repeat_disturbed FROM runs"
            assert connection.exec_driver_sql(query).all() == [("u", None, None, 0)]
        migrate.downgrade(engine, "0007")
    with engine.connect() as connection:
        assert connection.exec_driver_sql("SELECT uid FROM runs").all() == [("u",)]


def test_versions_of_modes_become_versions_of_packages_in_the_order_of_their_runs(engine: Engine) -> None:
    migrate.upgrade(engine, "0011")
    _add_configuration(engine)
    columns = "(id, algorithm_id, identity, package_hash, version, created_at)"
    rows = [(1, 1, "late"), (2, 1, "early"), (3, 2, "late"), (4, 1, "unused")]
    with engine.begin() as connection:
        connection.exec_driver_sql("INSERT INTO algorithms (id, name, package, mode) VALUES (2, 'b', 'a', 'other')")
        for number, algorithm, identity in rows:
            values = f"({number}, {algorithm}, '{identity}', 'h', '1', '2026-05-04 03:02:01')"
            connection.exec_driver_sql(f"INSERT INTO algorithm_versions {columns} VALUES {values}")
    for run, version in ((5, 2), (6, 3), (7, 1), (8, 2)):
        _add_run(engine, run, version)
    migrate.upgrade(engine)
    query = (
        "SELECT runs.id, package, number, identity FROM runs "
        "JOIN algorithm_versions AS used ON used.id = algorithm_version_id ORDER BY runs.id"
    )
    with engine.connect() as connection:
        package = connection.exec_driver_sql("SELECT package FROM algorithms WHERE id = 1").scalar_one()
        found = [tuple(row) for row in connection.exec_driver_sql(query)]
        unused = "SELECT number FROM algorithm_versions WHERE identity = 'unused'"
        last = connection.exec_driver_sql(unused).scalar_one()
    assert package == "a"
    assert found == [(5, "a", 1, "early"), (6, "a", 2, "late"), (7, "a", 2, "late"), (8, "a", 1, "early")]
    assert last == 3
    migrate.downgrade(engine, "0011")
    assert migrate.current(engine) == "0011"


def _add_run(engine: Engine, number: int = 1, version: int | None = None) -> None:
    with engine.begin() as connection:
        connection.exec_driver_sql(
            "INSERT INTO runs (id, uid, configuration_id, executor, seed, priority, evaluate, created_at, state, "
            "attempt, cancel_requested, algorithm_version_id) "
            f"VALUES ({number}, 'u{'' if number == 1 else number}', 1, 'docker', 0, 0, 0, '2026-05-04 03:02:01', "
            f"'queued', 0, 0, {'NULL' if version is None else version})"
        )


def test_parameters_under_two_definitions_keep_the_older_schema_away(engine: Engine) -> None:
    migrate.upgrade(engine, "0003")
    add = f"INSERT INTO parameters (scope, {_key(engine)}, type, unit) VALUES ('p', 'voxel', 'float', '{{}}')"
    with engine.begin() as connection:
        connection.exec_driver_sql(add.format("m"))
    migrate.upgrade(engine)
    migrate.downgrade(engine, "0003")
    migrate.upgrade(engine)
    with engine.begin() as connection:
        connection.exec_driver_sql(add.format("cm"))
        assert connection.exec_driver_sql("SELECT count(*) FROM parameters").scalar() == 2
    with pytest.raises(Conflict, match="1 parameters were stored under several definitions"):
        migrate.downgrade(engine, "0003")
    assert_whole_at(engine, "0004")


def test_figures_keep_their_values_and_learn_which_count(engine: Engine) -> None:
    migrate.upgrade(engine, "0004")
    _add_configuration(engine)
    now = "'2026-05-04 03:02:01'"
    with engine.begin() as connection:
        for number, fingerprint in ((2, "a"), (3, "b")):
            connection.exec_driver_sql(
                "INSERT INTO protocols (id, fingerprint, label, definition) "
                f"VALUES ({number}, '{fingerprint}', '', '{{}}')"
            )
        connection.exec_driver_sql(f"INSERT INTO metrics (id, {_key(engine)}) VALUES (1, 'ate.rmse')")
        connection.exec_driver_sql(
            "INSERT INTO runs (id, uid, configuration_id, executor, seed, priority, evaluate, created_at, state, "
            "attempt, cancel_requested, current_protocol_id) "
            f"VALUES (1, 'u', 1, 'docker', 0, 0, 0, {now}, 'succeeded', 0, 0, 3)"
        )
        for protocol in (1, 2, 3):
            connection.exec_driver_sql(f"INSERT INTO metric_values VALUES (1, 1, {protocol}, 0.{protocol})")
        variant = '[{"kind":"rate","sensors":["cam0","imu"],"options":{"keep":0.5}}]'
        connection.exec_driver_sql(f"UPDATE configurations SET variant='{variant}'")
    migrate.upgrade(engine)
    figures = "SELECT run_id, metric_id, protocol_id, value, is_current FROM metric_values ORDER BY protocol_id"
    with engine.connect() as connection:
        assert connection.exec_driver_sql(figures).all() == [(1, 1, 1, 0.1, 1), (1, 1, 2, 0.2, 0), (1, 1, 3, 0.3, 1)]
        options = connection.exec_driver_sql("SELECT name, number_value FROM variant_options ORDER BY name").all()
        assert options == [("rate.keep", 0.5), ("rate.keep@cam0", 0.5), ("rate.keep@imu", 0.5)]
    migrate.downgrade(engine, "0004")
    with engine.connect() as connection:
        assert connection.exec_driver_sql("SELECT value FROM metric_values ORDER BY value").all() == [
            (0.1,),
            (0.2,),
            (0.3,),
        ]


def test_saved_searches_keep_the_older_schema_away(engine: Engine) -> None:
    migrate.upgrade(engine)
    with engine.begin() as connection:
        connection.exec_driver_sql(
            "INSERT INTO saved_searches (name, filter_text, shown_columns, sort, descending, grouped, created_at) "
            "VALUES ('n', '', '[]', 'id', 1, 0, '2026-05-04 03:02:01')"
        )
    with pytest.raises(Conflict, match="1 searches are saved"):
        migrate.downgrade(engine, "0004")
    assert_whole_at(engine, "0005")


def test_analyses_leave_with_their_table_since_folders_hold_them(engine: Engine) -> None:
    migrate.upgrade(engine)
    with engine.begin() as connection:
        connection.exec_driver_sql(
            "INSERT INTO analyses (token, name, state, listed, visitor, created_at, attempt) "
            "VALUES ('t', 'n', 'done', 1, 0, '2026-05-04 03:02:01', 0)"
        )
    migrate.downgrade(engine, "0005")
    assert "analyses" not in tables(engine)
    migrate.upgrade(engine)
    with engine.connect() as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM analyses").scalar() == 0


def assert_whole_at(engine: Engine, refused: str) -> None:
    """A refusal leaves tables that are what their version says: the newest on SQLite, the one that refused on MySQL."""
    assert migrate.current(engine) == (migrate.head() if engine.dialect.name == "sqlite" else refused)
    migrate.upgrade(engine)
    with engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), METADATA) == []


def _add_configuration(engine: Engine) -> None:
    now = "'2026-05-04 03:02:01'"
    with engine.begin() as connection:
        connection.exec_driver_sql("INSERT INTO algorithms (id, name, package, mode) VALUES (1, 'a', 'a', 'a')")
        connection.exec_driver_sql(
            "INSERT INTO datasets (id, name, checksum, duration_s, folder, sensors, title, registered_at) "
            f"VALUES (1, 'd', 'c', 1, 'f', '[]', '', {now})"
        )
        connection.exec_driver_sql(
            "INSERT INTO configurations "
            "(id, content_hash, algorithm_id, dataset_id, playback_mode, playback_rate, created_at) "
            f"VALUES (1, 'h', 1, 1, 'realtime', 1, {now})"
        )


def test_upgrading_what_is_current_changes_nothing(engine: Engine) -> None:
    migrate.upgrade(engine)
    with engine.begin() as connection:
        connection.exec_driver_sql(
            "INSERT INTO metrics (id, name_key) VALUES (1, 'a')".replace("name_key", _key(engine))
        )
    migrate.upgrade(engine)
    with engine.connect() as connection:
        assert connection.exec_driver_sql("SELECT count(*) FROM metrics").scalar() == 1


def test_several_processes_may_upgrade_at_once(engine: Engine) -> None:
    url = engine.url.render_as_string(hide_password=False)
    start = threading.Barrier(4)

    def work(_number: int) -> str | None:
        start.wait()
        store = open_store(url)
        revision = migrate.current(store.engine)
        store.close()
        return revision

    with ThreadPoolExecutor(4) as pool:
        assert set(pool.map(work, range(4))) == {migrate.head()}
    assert tables(engine) == set(METADATA.tables)


def test_tables_of_a_newer_software_are_left_alone(engine: Engine) -> None:
    migrate.upgrade(engine)
    with engine.begin() as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num='9999'")
    for work in (migrate.upgrade, migrate.check_current):
        newest = rf"is at schema 9999, which is newer than this software \({migrate.head()}\)"
        with pytest.raises(Unavailable, match=newest):
            work(engine)
    assert tables(engine) == set(METADATA.tables)


def test_a_reader_says_that_tables_are_missing(engine: Engine) -> None:
    url = engine.url.render_as_string(hide_password=False)
    with pytest.raises(Unavailable, match="has no tables; start the worker"):
        open_store(url, upgrade=False)
    open_store(url).close()
    open_store(url, upgrade=False).close()


def _on(engine: Engine, table: str) -> str:
    return "" if engine.dialect.name == "sqlite" else f" ON {table}"


def _key(engine: Engine) -> str:
    return engine.dialect.identifier_preparer.quote("key")
