"""``--workers``: nothing that a test reports is lost, and a process that dies loses no other file."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration

CONFTEST = """
import os, pathlib, pytest
from tests.workers import pytest_addoption, pytest_runtestloop

@pytest.fixture(scope="session")
def kept(tmp_path_factory):
    yield tmp_path_factory.mktemp("kept")
    pathlib.Path(f"torn-down-{os.getpid()}").touch()
"""
FILES = {
    "test_a.py": """
        import os, pathlib, pytest
        pathlib.Path(f"imported-{os.getpid()}").touch()
        def test_passes(kept): assert kept.is_dir()
        def test_fails(kept):
            print("said before it failed")
            assert kept is None
        def test_skips(): pytest.skip("for a reason")
        def test_has_a_folder(tmp_path): assert not list(tmp_path.iterdir())
    """,
    "test_b.py": """
        import os, time, pathlib
        def test_sees_another_process(kept):
            pathlib.Path(f"worker-{os.getpid()}").touch()
        def test_has_a_folder(tmp_path): assert not list(tmp_path.iterdir())
    """,
    "test_c.py": """
        import os
        def test_before(): pass
        def test_dies(): os._exit(7)
        def test_after(): pass
    """,
    "test_d.py": "def test_is_run(): pass",
}


def ran(folder: Path, *options: str) -> tuple[int, str, dict[str, str]]:
    """Exit code, output, and the outcome of each test in the report, by file and name."""
    (folder / "conftest.py").write_text(CONFTEST)
    (folder / "pytest.ini").write_text("[pytest]\n")
    for name, text in FILES.items():
        (folder / name).write_text(text.replace("\n        ", "\n"))
    command = [sys.executable, "-m", "pytest", "-q", "--junitxml=report.xml", "-p", "no:schemathesis", *options]
    root = str(Path(__file__).resolve().parents[2])
    done = subprocess.run(
        command, cwd=folder, env={"PYTHONPATH": root, "HOME": str(folder)}, capture_output=True, text=True, check=False
    )
    outcomes = {}
    for case in ET.parse(folder / "report.xml").getroot().iter("testcase"):
        (outcome,) = [child.tag for child in case if child.tag in {"failure", "error", "skipped"}] or ["passed"]
        outcomes[f"{case.get('classname')}.{case.get('name')}"] = outcome
    return done.returncode, done.stdout + done.stderr, outcomes


def test_all_reports_arrive_and_a_dead_process_is_a_failure(tmp_path: Path):
    code, said, outcomes = ran(tmp_path, "--workers=2")
    assert code == 1, said
    assert outcomes == {
        "test_a.test_passes": "passed",
        "test_a.test_fails": "failure",
        "test_a.test_skips": "skipped",
        "test_a.test_has_a_folder": "passed",
        "test_b.test_sees_another_process": "passed",
        "test_b.test_has_a_folder": "passed",
        "test_c.test_before": "passed",
        "test_c.test_dies": "failure",
        "test_c.test_after": "failure",
        "test_d.test_is_run": "passed",
    }
    assert "its process ended with 7 before it had reported this test" in said
    assert "said before it failed" in said
    assert "3 failed, 6 passed, 1 skipped" in said
    assert len(list(tmp_path.glob("imported-*"))) == 1, "no process imports for itself"
    assert list(tmp_path.glob("torn-down-*")), "what tests of several files share is torn down in the end"


def test_more_processes_begin_when_there_is_room(tmp_path: Path):
    """The first test ends only when it sees another process at work, which the file allows while the test waits."""
    allowed = tmp_path / "allowed"
    allowed.write_text("1")
    first = f"""
        import os, time, pathlib
        def test_waits_for_another():
            begun = time.monotonic()
            assert not list(pathlib.Path().glob("worker-*"))
            time.sleep(1.5)
            assert not list(pathlib.Path().glob("worker-*")), "only one process may work"
            pathlib.Path({str(allowed)!r}).write_text("2")
            while not list(pathlib.Path().glob("worker-*")) and time.monotonic() < begun + 60: time.sleep(0.05)
            assert list(pathlib.Path().glob("worker-*")), "nobody else began"
        def test_after(): "Before its last test, a process asks for its next file."
    """
    (tmp_path / "test_0.py").write_text(textwrap.dedent(first))
    code, said, outcomes = ran(tmp_path, "--workers=3", f"--workers-now={allowed}", "test_0.py", "test_b.py")
    assert (code, set(outcomes.values())) == (0, {"passed"}), said


def test_no_file_begins_after_as_many_failures_as_were_allowed(tmp_path: Path):
    code, said, outcomes = ran(tmp_path, "--workers=2", "-x", "--deselect=test_c.py::test_dies")
    assert code == 1, said
    assert [name for name, outcome in outcomes.items() if outcome == "failure"] == ["test_a.test_fails"]
    assert "test_a.test_has_a_folder" not in outcomes


@pytest.mark.parametrize("option", ["--workers=1", "--workers=2"])
def test_a_file_that_cannot_be_imported_is_an_error(tmp_path: Path, option: str):
    (tmp_path / "test_e.py").write_text("import nothing_of_this_name\n")
    code, said, outcomes = ran(tmp_path, option)
    assert (code, list(outcomes.values())) == (2, ["error"])
    assert "nothing_of_this_name" in said
