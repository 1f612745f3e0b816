"""``make test``: everything this machine can test, fast things first; what did not run is named with its remedy.

Tiers that do not disturb each other run together, because single ones leave the processors idle most of the time.

As root on Debian or Ubuntu it installs and starts what is missing (Docker engine, MariaDB, libraries), and stops
what it started. Under ``CI=true`` nothing may be left out: a tier or a test that could not run is a failure.
Standard library only; runs with the interpreter of ``.venv``.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import subprocess
import sys
import tempfile
import threading
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO
from unittest import mock

import machine
import needs
import speed
from steps import StepFailed

from slamhive.base.debian import install_command

ROOT = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent
UNIT_LIMIT_S = 15.0
"""The unit tier is for use before each commit. Its limit is on CPU time: a busy machine slows no test down."""
QUICK_LIMIT_S = 40.0
"""The quick tier holds what needs a database or pages, but no other processes: for use before each merge."""
WITHOUT_TOOLS = "not docker and not mysql and not cluster and not browser and not pictures and not machines"
PLAIN = f"not integration and {WITHOUT_TOOLS}"
CHEAP = "not images and not packages and not classical and not cluster"
MAY_BE_ABSENT = ("shared/data", "shared/cases", "SOURCE_ARCHIVES is empty", "KUBE_TOOLS is empty")
"""A skipped test whose reason names one is fine everywhere: recordings, and sources and programs of other projects."""

RUFF = (("check", "."), ("format", "--check", "."))
MACHINES = ROOT.parent / "shared" / "machines" / "vm"
AT_ONCE = 4
"""Tiers at once. With more, processes take each other's caches, and the same tests a fifth more CPU time."""
LONGEST_FILES = 6
LONG_FILE_S = 10.0
"""Tiers in which no module takes longer do not say which take longest."""
NO_BYTECODE = "PYTHONDONTWRITEBYTECODE"
SHARED_FOLDER = "TESTS_SHARE_IN"
"""The variable that names the folder in which all tiers share what takes long to make, see ``tests/sharing.py``."""
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1"}
"""The tests use all processors as it is. More threads would only wait for each other."""
NO_TESTS = 5
"""The exit code of pytest if it found no tests."""
NO_ENGINE = "unix:///nonexistent/docker.sock"


class CannotRun(Exception):
    """A tier has to be left out; the message is the reason and how to enable it."""


@dataclass
class Outcome:
    """The outcome of a tier. ``skipped`` holds the reasons of skipped tests."""

    state: str = "passed"
    note: str = ""
    seconds: float = 0.0
    cpu_s: float = 0.0
    slowness: float = 1.0
    """How many times longer than the reference the machine took for the same work meanwhile."""
    passed: int = 0
    failed: int = 0
    skipped: list[str] = field(default_factory=list)
    file_s: dict[str, float] = field(default_factory=dict)
    """Time of the tests by module, with what was made for them."""


@dataclass(frozen=True)
class Tier:
    """One tier: what must be there first, the commands, or the pytest marks that select its tests.

    Each of the ``workers`` takes the next file when it is free. One more begins for each place that the other tiers of
    the group leave free, up to ``most_workers``. ``limit_s`` is the time that the tier may take if each
    process has a core.
    It fails if it uses more CPU time than that, and warns if it only takes longer.
    Tests of a tier without ``engine`` see no Docker engine, so that they behave the same on every machine.
    Tiers that follow each other in the list and name the same ``group`` run together.
    Tiers that take very long run if they are named (``asked_only``).
    """

    name: str
    commands: tuple[tuple[str, ...], ...] = ()
    marks: str = ""
    workers: int = 1
    most_workers: int = 0
    limit_s: float | None = None
    engine: bool = False
    prepare: Callable[[], str] = lambda: ""
    group: str = ""
    asked_only: bool = False


def main(names: Sequence[str]) -> int:
    """Run all tiers but those that must be asked for, or the named ones; returns the exit code."""
    engine = machine.Engine()
    tiers = all_tiers(engine)
    unknown = sorted(set(names) - {tier.name for tier in tiers})
    if unknown:
        print(f"unknown tier {unknown[0]!r}; known: {', '.join(tier.name for tier in tiers)}", file=sys.stderr)
        return 2
    chosen = [tier for tier in tiers if tier.name in names or not (names or tier.asked_only)]
    started = time.monotonic()
    outcomes: dict[str, Outcome] = {}
    try:
        with shared_folder():
            for _, group in itertools.groupby(chosen, key=lambda tier: tier.group or tier.name):
                outcomes.update(run_group(list(group)))
    except KeyboardInterrupt:
        print("\ninterrupted")
    finally:
        engine.stop()
    for tier in chosen:
        outcomes.setdefault(tier.name, Outcome("not run", "interrupted"))
    return report(outcomes, time.monotonic() - started, strict=os.environ.get("CI", "") in {"true", "1"})


def all_tiers(engine: machine.Engine) -> list[Tier]:
    """Every tier, fast ones first."""

    def with_engine() -> str:
        return prepare_database() + prepare_engine(engine)

    def with_clusters() -> str:
        return with_engine() + prepare_clusters()

    with_site = (str(BIN / "mkdocs"), "build", "--strict", "--quiet", "--site-dir", str(ROOT / "site"))
    return [
        Tier(
            "lint", (*((str(BIN / "ruff"), *rest) for rest in RUFF), (sys.executable, "tools/prose.py")), group="static"
        ),
        Tier("imports", ((str(BIN / "lint-imports"),),), group="static"),
        Tier("docs", (with_site,), group="static"),
        Tier("unit", marks=f"not quick and {PLAIN}", workers=2, limit_s=UNIT_LIMIT_S),
        Tier("quick", marks=f"quick and {PLAIN}", workers=2, limit_s=QUICK_LIMIT_S),
        Tier(
            "integration",
            marks=f"integration and {WITHOUT_TOOLS}",
            workers=2,
            most_workers=5,  # on two cores: the tests often wait
            prepare=prepare_libraries,
            group="processes",
        ),
        # Builds images: some 400 s of CPU time where none has been built before. Its runs are played slowly.
        Tier("images", marks="images", workers=2, engine=True, prepare=with_engine, group="processes"),
        Tier("docker", marks=f"docker and not alone and {CHEAP}", engine=True, prepare=with_engine, group="processes"),
        # Runs the experiment of `slamhive demo` without the engine, in environments that other tiers need as well.
        Tier("pictures", marks="pictures and not docker and not mysql", prepare=prepare_pictures, group="processes"),
        Tier("mysql", marks="mysql and not docker", prepare=prepare_database, group="processes"),
        Tier("browser", marks="browser and not docker and not mysql", prepare=prepare_browser, group="processes"),
        # Mostly waits: 150 s of CPU time in 300 s.
        Tier("clusters", marks="cluster and not long", engine=True, prepare=with_clusters, group="processes"),
        Tier("types", ((str(BIN / "mypy"),),), group="processes"),
        Tier("systems", marks=f"docker and alone and {CHEAP}", engine=True, prepare=with_engine),
        Tier("packages", marks="packages", engine=True, prepare=with_engine, asked_only=True),
        Tier("classical", marks="classical", engine=True, prepare=with_engine, asked_only=True),
        Tier("long", marks="cluster and long", engine=True, prepare=with_clusters, asked_only=True),
        Tier("machines", marks="machines and not docker and not mysql", prepare=prepare_machines, asked_only=True),
    ]


@contextlib.contextmanager
def shared_folder() -> Iterator[None]:
    """Meanwhile, tiers find what others have made."""
    with tempfile.TemporaryDirectory(prefix="slamhive-test-shared-") as folder:
        Path(folder).chmod(0o755)  # a run may have a user of its own
        with mock.patch.dict(os.environ, {SHARED_FOLDER: folder}):
            yield


def run_group(tiers: Sequence[Tier]) -> dict[str, Outcome]:
    """Prepare the tiers one after the other, then run them together."""
    outcomes: dict[str, Outcome] = {}
    notes: dict[str, str] = {}
    print("\n" + "=== " + " + ".join(tier.name for tier in tiers) + " ", flush=True)
    for tier in tiers:
        try:
            notes[tier.name] = tier.prepare()
        except (CannotRun, StepFailed) as reason:
            print(reason, flush=True)
            outcomes[tier.name] = Outcome("not run", str(reason).splitlines()[0])
    outcomes |= run_together([tier for tier in tiers if tier.name in notes])
    for tier in tiers:
        outcome = outcomes[tier.name]
        if tier.limit_s is not None and outcome.state == "passed":
            check_time(tier, outcome, tier.limit_s)
        outcome.note = outcome.note or notes.get(tier.name, "")
    return outcomes


def run_together(tiers: Sequence[Tier]) -> dict[str, Outcome]:
    """Run tiers for which everything is there, a few at once and in their order.

    The first prints as it goes, each other one when it has ended.
    """
    printing = threading.Lock()
    growing = [tier for tier in tiers if tier.most_workers]
    ended = 0

    def run_one(tier: Tier) -> Outcome:
        nonlocal ended
        if tier is tiers[0]:
            return run_timed(tier)
        with tempfile.TemporaryFile() as output:
            outcome = run_timed(tier, output)
            output.seek(0)
            with printing:
                ended += 1
                for other in growing:
                    allow_workers(other, len(tiers) - 1 - ended)
                print(f"\n--- {tier.name} ".ljust(100, "-"))
                _write(output.read(), None)
        return outcome

    for tier in growing:
        allow_workers(tier, len(tiers) - 1)
    with ThreadPoolExecutor(AT_ONCE) as pool:
        return dict(zip([tier.name for tier in tiers], pool.map(run_one, tiers), strict=True))


def allow_workers(tier: Tier, others: int) -> None:
    """Let the workers of a tier work: its first ones, and one more for each place that ``others`` leave free."""
    path = workers_file(tier)
    aside = path.with_suffix(".part")
    aside.write_text(str(min(tier.workers + max(0, AT_ONCE - 1 - others), tier.most_workers)))
    aside.rename(path)


def workers_file(tier: Tier) -> Path:
    """Holds how many workers of the tier may work now."""
    return Path(os.environ[SHARED_FOLDER], f"workers-of-{tier.name}")


def run_timed(tier: Tier, output: IO[bytes] | None = None) -> Outcome:
    """Run a tier for which everything is there; what it prints goes to ``output``, by default to the terminal."""
    started = time.monotonic()
    # Measuring takes up to a tenth of a core where several tiers run at once, so only those with a limit are measured.
    measuring = contextlib.nullcontext(speed.Slowness()) if tier.limit_s is None else speed.slowness_meanwhile()
    with measuring as slowness:
        outcome = run_pytest(tier, output) if tier.marks else run_commands(tier, output)
    outcome.seconds = time.monotonic() - started
    outcome.slowness = slowness.factor()
    return outcome


def run_measured(command: Sequence[str], environment: Mapping[str, str], output: IO[bytes] | None) -> tuple[int, float]:
    """Exit code and CPU time (s) of a command, with all that it started and waited for.

    Compiled modules are kept, whatever the environment says: tests start thousands of interpreters.
    """
    environment = {name: value for name, value in environment.items() if name != NO_BYTECODE}
    stderr = None if output is None else subprocess.STDOUT
    process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=output, stderr=stderr)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, usage.ru_utime + usage.ru_stime


def check_time(tier: Tier, outcome: Outcome, limit_s: float) -> None:
    """Fail a tier that uses too much CPU time; note one that takes long for another reason.

    A slow machine gets as much more time as it needs for work of which the reference is known.
    """
    cpu_limit_s = limit_s * tier.workers
    if outcome.cpu_s > cpu_limit_s:
        if outcome.cpu_s > cpu_limit_s * outcome.slowness:
            outcome.state = "failed"
        there = f", times {outcome.slowness:.2f} on this slow machine" if outcome.slowness > 1 else ""
        outcome.note = f"used {outcome.cpu_s:.1f} s of CPU time; must stay under {cpu_limit_s:g} s{there}"
    elif outcome.seconds > limit_s:
        outcome.note = f"WARNING: took longer than {limit_s:g} s with {outcome.cpu_s:.1f} s of CPU time"


def run_commands(tier: Tier, output: IO[bytes] | None) -> Outcome:
    """Run the commands of a tier, all of them even if one fails."""
    outcome = Outcome()
    for command in tier.commands:
        code, cpu_s = run_measured(command, {**os.environ, "NO_MKDOCS_2_WARNING": "1"}, output)
        outcome.cpu_s += cpu_s
        if code != 0:
            outcome.state = "failed"
            outcome.note = outcome.note or f"{Path(command[0]).name} found problems, see above"
    return outcome


def run_pytest(tier: Tier, output: IO[bytes] | None) -> Outcome:
    """Run the tests that carry the marks of a tier and read pytest's own report."""
    # What tests leave may belong to processes that still end, or to users of their own.
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        report_path = Path(folder) / "report.xml"
        command = [sys.executable, "-m", "pytest", "-q", "--durations=8", "-m", tier.marks]
        # A folder of its own: pytest removes what older sessions left in the one that all share, which may be in use.
        command += [f"--junitxml={report_path}", f"--basetemp={folder}/tests"]
        if (os.cpu_count() or 1) > 1:
            command.append(f"--workers={tier.most_workers or tier.workers}")
        if tier.most_workers:
            command.append(f"--workers-now={workers_file(tier)}")
        environment = {**os.environ, **ONE_THREAD} | ({} if tier.engine else {"DOCKER_HOST": NO_ENGINE})
        code, cpu_s = run_measured(command, environment, output)
        outcome = read_report(report_path)
        outcome.cpu_s = cpu_s
    if code != 0:
        outcome.state = "failed"
        outcome.note = "no test carries its marks" if code == NO_TESTS else f"pytest ended with {code}, see above"
    return outcome


def read_report(path: Path) -> Outcome:
    """Counts and skip reasons out of a JUnit report; a missing report is a failure."""
    if not path.is_file():
        return Outcome("failed", "pytest left no report")
    outcome = Outcome()
    for case in ET.parse(path).getroot().iter("testcase"):  # noqa: S314 - our own pytest wrote it
        module = case.get("classname", "").removeprefix("tests.")
        outcome.file_s[module] = outcome.file_s.get(module, 0.0) + float(case.get("time", 0))
        skipped = case.find("skipped")
        if skipped is not None:
            outcome.skipped.append(skipped.get("message", "") or "no reason given")
        elif case.find("failure") is not None or case.find("error") is not None:
            outcome.failed += 1
        else:
            outcome.passed += 1
    return outcome


def prepare_database() -> str:
    """A MariaDB or MySQL server."""
    missing = needs.database()
    if missing and not machine.can_install():
        raise CannotRun(f"no MariaDB or MySQL server here; enable: {install_command(missing)}")
    return provide(missing)


def prepare_libraries() -> str:
    """Libraries that runs outside containers load, and a compose."""
    return provide(needs.libraries())


def prepare_browser() -> str:
    """A browser and what reads its PDF files."""
    return provide(needs.browser())


def prepare_pictures() -> str:
    """A browser, and what the algorithms of the demo load outside containers."""
    return provide((*needs.libraries(), *needs.browser()))


def prepare_clusters() -> str:
    """Slurm and a container runtime."""
    return provide(needs.clusters())


def prepare_machines() -> str:
    """Programs that make virtual machines, and the one of ../shared that drives them."""
    if not MACHINES.is_file():
        raise CannotRun(f"the program that makes virtual machines is not here: {MACHINES}")
    return provide(needs.machines())


def provide(missing: Sequence[str]) -> str:
    """Install these packages; what to do about them where that is not possible."""
    if missing and not machine.can_install():
        return f"parts are skipped; enable: {install_command(missing)}"
    if missing:
        machine.install(missing)
    return ""


def prepare_engine(engine: machine.Engine) -> str:
    """A Docker engine that answers, and what its tests need beside it."""
    trouble = machine.engine_trouble()
    if machine.can_install():
        provide(needs.engine())
        if trouble is not None:
            engine.start()
    elif trouble is not None:
        raise CannotRun(f"{trouble.problem}; enable: {trouble.remedy}")
    return ""


def report(outcomes: dict[str, Outcome], seconds: float, *, strict: bool) -> int:
    """Print the table and the last line; returns the exit code."""
    print("\n" + "=" * 100)
    bad = 0
    for name, outcome in outcomes.items():
        left_out = [reason for reason in outcome.skipped if not any(name in reason for name in MAY_BE_ABSENT)]
        if strict and outcome.state == "passed" and left_out:
            outcome.state, outcome.note = "failed", f"{len(left_out)} tests were skipped, CI=true allows none"
        bad += outcome.state == "failed" or (strict and outcome.state == "not run")
        counts = f"{outcome.passed} passed" if outcome.passed or outcome.skipped or outcome.failed else ""
        counts += f", {outcome.failed} failed" if outcome.failed else ""
        counts += f", {len(outcome.skipped)} skipped" if outcome.skipped else ""
        times = f"{outcome.seconds:7.1f} s {outcome.cpu_s:7.1f} s of CPU"
        print(f"{name:<12} {outcome.state:<8} {times}   {counts:<28} {outcome.note}".rstrip())
        for reason in sorted(set(outcome.skipped)):
            print(f"{'':<12} skipped {outcome.skipped.count(reason)}: {reason}")
        longest = sorted(outcome.file_s.items(), key=lambda entry: -entry[1])[:LONGEST_FILES]
        if longest and longest[0][1] > LONG_FILE_S:
            print(f"{'':<12} longest: {', '.join(f'{name} {took_s:.0f} s' for name, took_s in longest)}")
    if strict and bad:
        print("CI=true: what did not run counts as failed")
    _last_line(outcomes, bad, seconds)
    return 1 if bad else 0


def _write(printed: bytes, output: IO[bytes] | None) -> None:
    if output is None:
        print(printed.decode(errors="replace"), flush=True)
    else:
        output.write(printed)


def _last_line(outcomes: dict[str, Outcome], bad: int, seconds: float) -> None:
    passed = sum(outcome.passed for outcome in outcomes.values())
    failed = sum(outcome.failed for outcome in outcomes.values())
    skipped = sum(len(outcome.skipped) for outcome in outcomes.values())
    not_run = [name for name, outcome in outcomes.items() if outcome.state == "not run"]
    verdict = f"{bad} of {len(outcomes)} tiers FAILED" if bad else "all tiers that ran passed"
    verdict += f" ({', '.join(not_run)} did not run)" if not_run else ""
    print(verdict)
    print(f"{passed} passed, {failed} failed, {skipped} skipped in {seconds:.1f}s")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
