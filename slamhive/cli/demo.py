"""``slamhive demo``: the main use case from end to end; existing results are used again."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

import click

from slamhive import strict_yaml
from slamhive.bags.room import RoomOptions
from slamhive.cli.experiment_tables import print_report
from slamhive.cli.output import tell
from slamhive.cli.phases import Phase, Phases
from slamhive.cli.waiting import experiment_to_end
from slamhive.clock import monotonic_s
from slamhive.domain.sensors import SensorKind
from slamhive.errors import NotFound, SlamHiveError
from slamhive.executors.base import ImageMissing
from slamhive.machine_speed import slowness
from slamhive.services.experiments import ExperimentSource, Standing, varying
from slamhive.services.experiments import Phase as RunPhase
from slamhive.services.hive import Hive
from slamhive.store import RunRecord
from slamhive.sweep.experiment_file import parse_experiment

FILE = "docs/examples/room-demo.yaml"
DATASET = "room"
SEED = 1

# What phases take on two cores of the reference with a fast network; Phases finds out how it is here.
BUILD_S = 60.0
RENDER_S_FOR_1_S = 1.0
AROUND_A_RUN_S = 7.0
"""Preparing, collecting and evaluating a run."""


def run_demo(hive: Hive, seconds: float) -> None:
    """Render the room, run the experiment, evaluate, print the table.

    Raises SlamHiveError if nothing at all could be run.
    """
    hive.check_writable()
    began = monotonic_s()
    executor, reason = hive.executors.default()
    tell(f"executor: {reason}")
    text = (hive.catalogue.project_root / FILE).read_text(encoding="utf-8")
    asked = [str(name) for name in parse_experiment(text, FILE).algorithms.values]
    packages = list(dict.fromkeys(hive.catalogue.algorithm(name).package.name for name in asked))
    phases = _phases(hive, executor, packages, seconds)
    algorithms = buildable(hive, executor, asked, phases)
    _prepare_evaluation(hive, phases)
    _render_room(hive, seconds, phases)
    source = _source(hive, strict_yaml.parse(text, FILE), algorithms, executor)
    status = hive.experiments.start(source, executor)
    if status.standing is Standing.FINISHED:
        tell(f"experiment {status.name} has run already, its results are shown again")
    experiment_to_end(hive, status.name, on_end=_announce, title=f"step {phases.count} of {phases.count}, runs")
    status = hive.experiments.status(status.name)
    print_report(status, list(hive.experiments.report(status.name)), varying(hive.experiments.axes(status.name)))
    tell(f"demo done in {monotonic_s() - began:.0f} s; data in {hive.settings.data}")
    if not status.counts[RunPhase.GOOD]:
        raise click.exceptions.Exit(1)


def _source(hive: Hive, content: dict[str, Any], algorithms: Sequence[str], executor: str) -> ExperimentSource:
    """The experiment with the algorithms that can be run here, under a name that goes with them and with the data."""
    heard = {entry.kind for name in algorithms for entry in hive.catalogue.algorithm(name).inputs}
    left_out = () if SensorKind.CAMERA in heard else ("steps", "linked", "where")
    parts = [hive.catalogue.dataset(DATASET).checksum, executor, *algorithms]
    name = f"{content['name']}-{hashlib.sha256(' '.join(parts).encode()).hexdigest()[:6]}"
    kept = {key: value for key, value in content.items() if key not in left_out}
    return ExperimentSource(strict_yaml.dump({**kept, "name": name, "algorithms": list(algorithms)}), FILE)


def _phases(hive: Hive, executor: str, packages: Sequence[str], seconds: float) -> Phases:
    """Plan the phases of the demo, with the time that each takes on two cores of the reference and a fast network."""
    chosen = hive.executors.get(executor)
    there = {name: chosen.identity(hive.catalogue.package(name)) is not None for name in packages}
    builds = [Phase(f"building {name}", 1.0 if there[name] else BUILD_S, "build") for name in packages]
    evaluation = Phase("building the evaluation", 1.0 if all(there.values()) else BUILD_S, "build")
    room = Phase(f"rendering {DATASET}", 1.0 if _rendered(hive, seconds) else RENDER_S_FOR_1_S * seconds, "render")
    count = len(packages) + 1
    runs = Phase("runs", count * (seconds + AROUND_A_RUN_S), "run", count * seconds)
    phases = Phases([*builds, evaluation, room, runs], slowness=slowness())
    tell(f"{phases.count} steps, {phases.after().span} in all: a guess, which each step makes better")
    return phases


def buildable(hive: Hive, executor: str, algorithms: Sequence[str], phases: Phases) -> list[str]:
    """The algorithms whose image or environment is there or can be made; says what is skipped and how to get it."""
    chosen = hive.executors.get(executor)
    problems: dict[str, SlamHiveError | None] = {}
    packages = {algorithm: hive.catalogue.algorithm(algorithm).package.name for algorithm in algorithms}
    for name in dict.fromkeys(packages.values()):
        with phases.next() as show:
            package = hive.catalogue.package(name)
            try:
                identity = chosen.build(package, lambda line, show=show: show(0.0, line[:60]))  # type: ignore[misc]
            except ImageMissing as error:
                problems[name] = error
            else:
                problems[name] = None
                # So that the time left of the runs does not count a build that is over.
                hive.versions.register(chosen, package, identity)
                show(1.0, "ready")
    for name, problem in problems.items():
        if problem is not None:
            tell(f"skipped {name}: {problem}", style="yellow")
    found = [algorithm for algorithm in algorithms if problems[packages[algorithm]] is None]
    if not found:
        raise ImageMissing("none of the demo's algorithms can be run on this machine", "slamhive doctor says why")
    return found


def _prepare_evaluation(hive: Hive, phases: Phases) -> None:
    """Build what evaluations need now, where it is seen, and not between the first run and its result."""
    with phases.next() as show:
        hive.evaluations.prepare(lambda line: show(0.0, line[:60]))
        show(1.0, "ready")


def _rendered(hive: Hive, seconds: float) -> bool:
    """Return whether the room is there, and as long as it is to be."""
    try:
        return abs(hive.catalogue.dataset(DATASET).duration_s - seconds) < 0.5
    except NotFound:
        return False


def _render_room(hive: Hive, seconds: float, phases: Phases) -> None:
    with phases.next() as show:
        if _rendered(hive, seconds):
            show(1.0, "is there already, used again")
            return
        options = RoomOptions(name=DATASET, duration_s=seconds, seed=SEED)
        hive.catalogue.render_room(options, show, replace=True)


def _announce(run: RunRecord) -> None:
    error_m = (run.metrics or {}).get("ate.rmse")
    result = f"ATE RMSE {error_m:.4f} m" if error_m is not None else (run.detail or "not evaluated")
    tell(f"run {run.id}: {run.algorithm} {run.state}, {run.poses or 0} poses, {result}")
