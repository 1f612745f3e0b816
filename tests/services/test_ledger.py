"""The ledger: lines that are whole or absent, completed after a kill, and never emptied by a database that was lost."""

from __future__ import annotations

import multiprocessing
import shutil
from pathlib import Path

import pytest

from slamhive.base.errors import Conflict, Unavailable
from slamhive.documents.submission import Submission
from slamhive.services.configurations import Label
from slamhive.services.hive import Hive, check_indexed, open_hive
from slamhive.services.ledger.book import Book
from slamhive.services.reindex import reindex

pytestmark = pytest.mark.integration


def test_a_line_that_was_cut_off_is_passed_over(tmp_path: Path) -> None:
    book = Book(tmp_path / "ledger" / "some.jsonl")
    book.append([{"a": 1}, {"b": iter([1, 2])}])
    with book.path.open("a") as stream:
        stream.write('{"c": ')
    book.append([{"d": 4}])
    assert list(book.read()) == [{"a": 1}, {"b": [1, 2]}, {"d": 4}]
    with book.replaced() as lines:
        lines.append({"e": 5})
    assert list(book.read()) == [{"e": 5}]


def test_lines_of_many_processes_are_all_there(tmp_path: Path) -> None:
    path = tmp_path / "some.jsonl"
    context = multiprocessing.get_context("fork")
    writers = [context.Process(target=_write_many, args=(path, number)) for number in range(4)]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert sorted((line["writer"], line["line"]) for line in Book(path).read()) == [
        (writer, line) for writer in range(4) for line in range(50)
    ]


def _write_many(path: Path, number: int) -> None:
    for line in range(50):
        Book(path).append([{"writer": number, "line": line}])


def test_a_book_that_cannot_be_written_is_said_and_no_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").write_text("kept")
    (tmp_path / "some.jsonl").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(Unavailable, match=r"some\.jsonl cannot be written"):
        Book(tmp_path / "some.jsonl").append([{"a": 1}])
    assert (tmp_path / "elsewhere").read_text() == "kept"


def test_what_a_kill_kept_from_being_written_is_added(hive: Hive) -> None:
    listener, hive.store.listener = hive.store.listener, None
    stored = hive.configurations.create(Submission("tiny", "track", {"seconds": 3.0}), Label("three", "a note", "all"))
    (run,) = hive.runs.submit(Submission("tiny", "track", {"seconds": 4.0}))
    hive.store.listener = listener
    assert list(hive.ledger.files.configurations.read()) == []
    hive.ledger.check()
    written = sorted(path.read_bytes() for path in hive.settings.ledger_folder.iterdir())
    hive.ledger.check()
    assert sorted(path.read_bytes() for path in hive.settings.ledger_folder.iterdir()) == written, "nothing twice"
    again = lose_database(hive)
    try:
        reindex(again, lambda _done, _total: None)
        assert again.configurations.find("three").id == stored.record.id
        assert again.runs.get(run.id).uid == run.uid
    finally:
        again.close()


def test_an_empty_database_beside_a_ledger_is_refused_and_empties_nothing(
    hive: Hive, caplog: pytest.LogCaptureFixture
) -> None:
    hive.configurations.create(Submission("tiny", "track", {"seconds": 3.0}), Label("three"))
    again = lose_database(hive)
    try:
        with pytest.raises(Conflict, match="the database is empty"):
            check_indexed(again)
        again.ledger.check()
        assert "slamhive reindex restores them" in caplog.text
        reindex(again, lambda _done, _total: None)
        assert again.configurations.find("three").configuration.parameters["seconds"] == 3.0
        check_indexed(again)
    finally:
        again.close()


def test_a_store_that_cannot_write_its_ledger_stores_all_the_same(hive: Hive, caplog: pytest.LogCaptureFixture) -> None:
    shutil.rmtree(hive.settings.ledger_folder, ignore_errors=True)
    hive.settings.ledger_folder.write_text("in the way")
    hive.runs.submit(Submission("tiny", "track"))
    assert "the ledger is completed when a worker starts" in caplog.text
    hive.settings.ledger_folder.unlink()
    hive.ledger.check()
    assert any("runs" in line for line in hive.ledger.files.runs.read())


def lose_database(hive: Hive) -> Hive:
    hive.close()
    for path in hive.settings.data.glob("slamhive.db*"):
        path.unlink()
    return open_hive()
