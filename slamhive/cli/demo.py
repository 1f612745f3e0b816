"""``slamhive demo``: the main job from end to end, re-using what is there."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import click

from slamhive.bags.room import RoomOptions
from slamhive.cli.output import messages, print_table, progress_bar
from slamhive.cli.runs import COLUMNS, NUMBERS, SPARE, run_row
from slamhive.cli.waiting import run_to_end
from slamhive.domain.run import RunState
from slamhive.errors import NotFound, SlamHiveError
from slamhive.executors.base import ImageMissing
from slamhive.search.build import matching
from slamhive.services.hive import Hive
from slamhive.services.request import Submission
from slamhive.store import RunRecord

DATASET = "room"
SEED = 1


@dataclass(frozen=True, slots=True)
class DemoRun:
    """One run of the demo."""

    algorithm: str
    parameters: dict[str, object] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """The run in words."""
        return self.algorithm + "".join(f" {key}={value}" for key, value in self.parameters.items())


EXPERIMENT = (
    DemoRun("kiss-icp"),
    DemoRun("rko-lio"),
    DemoRun("orb-slam3-stereo", {"nFeatures": 1000}),
    DemoRun("orb-slam3-stereo", {"nFeatures": 2000}),
)


def run_demo(hive: Hive, seconds: float) -> None:
    """Render the room, run the experiment, evaluate, print the table.

    Raises SlamHiveError if nothing at all could be run.
    """
    hive.check_writable()
    began = time.monotonic()
    executor, reason = hive.executor_choice()
    messages.print(f"executor: {executor} ({reason})", markup=False, soft_wrap=True)
    wanted = _buildable(hive, executor)
    _render_room(hive, seconds)
    known = {run.text: _existing(hive, run) for run in wanted}
    todo = [run for run in wanted if known[run.text] is None]
    for run in wanted:
        if known[run.text] is not None:
            messages.print(f"{run.text}: run {known[run.text]} is there already, re-used", markup=False)
    run_ids = {run.text: _submit(hive, run) for run in todo}
    if run_ids:
        run_to_end(hive, list(run_ids.values()), evaluate=True, on_end=_announce)
    entries = [hive.run(known[run.text] or run_ids[run.text]) for run in wanted]
    labels = {entry.id: run.text for entry, run in zip(entries, wanted, strict=True)}
    _print_results(entries, labels)
    messages.print(f"demo done in {time.monotonic() - began:.0f} s; data in {hive.settings.data}", markup=False)
    if not any(entry.state is RunState.SUCCEEDED for entry in entries):
        raise click.exceptions.Exit(1)


def _buildable(hive: Hive, executor: str) -> list[DemoRun]:
    """The runs whose image or environment is there or can be made; says what is skipped and how to get it."""
    chosen = hive.executor(executor)
    problems: dict[str, SlamHiveError | None] = {}
    packages = {run.algorithm: hive.catalogue.algorithm(run.algorithm).package for run in EXPERIMENT}
    names = list(dict.fromkeys(package.name for package in packages.values()))
    for number, name in enumerate(names, start=1):
        package = hive.catalogue.package(name)
        with progress_bar(f"building {name} ({number} of {len(names)})") as show:
            try:
                chosen.build(package, lambda line, show=show, number=number: show((number - 1) / len(names), line[:60]))  # type: ignore[misc]
            except ImageMissing as error:
                problems[name] = error
            else:
                problems[name] = None
                show(1.0, "ready")
    for name, problem in problems.items():
        if problem is not None:
            messages.print(f"skipped {name}: {problem}", style="yellow", markup=False, soft_wrap=True)
    found = [run for run in EXPERIMENT if problems[packages[run.algorithm].name] is None]
    if not found:
        raise ImageMissing("none of the demo's algorithms can be run on this machine", "slamhive doctor says why")
    return found


def _render_room(hive: Hive, seconds: float) -> None:
    options = RoomOptions(name=DATASET, duration_s=seconds, seed=SEED)
    try:
        if abs(hive.catalogue.dataset(DATASET).duration_s - seconds) < 0.5:
            messages.print(f"dataset {DATASET} is there already, re-used")
            return
    except NotFound:
        pass
    with progress_bar(f"rendering {DATASET}") as progress:
        hive.catalogue.render_room(options, progress, replace=True)


def _existing(hive: Hive, wanted: DemoRun) -> int | None:
    """A good, evaluated run of the same configuration on the same data, None if there is none."""
    checksum = hive.catalogue.dataset(DATASET).checksum
    page = hive.runs(
        matching(states=(RunState.SUCCEEDED,), algorithms=(wanted.algorithm,), datasets=(DATASET,), evaluated=True)
    )
    algorithm = hive.catalogue.algorithm(wanted.algorithm)
    parameters = Submission(wanted.algorithm, DATASET, wanted.parameters).configuration(algorithm).parameters
    for run in page.records:
        if run.parameters == parameters and run.dataset_checksum == checksum:
            return run.id
    return None


def _submit(hive: Hive, wanted: DemoRun) -> int:
    (run,) = hive.submit(Submission(wanted.algorithm, DATASET, wanted.parameters))
    return run.id


def _announce(run: RunRecord) -> None:
    error_m = (run.metrics or {}).get("ate.rmse")
    result = f"ATE RMSE {error_m:.4f} m" if error_m is not None else (run.detail or "not evaluated")
    messages.print(f"run {run.id}: {run.algorithm} {run.state}, {run.poses or 0} poses, {result}", markup=False)


def _print_results(entries: list[RunRecord], labels: dict[int, str]) -> None:
    rows = [(*run_row(entry)[:1], labels[entry.id], *run_row(entry)[2:]) for entry in entries]
    print_table(COLUMNS, rows, right=NUMBERS, spare=SPARE)
    protocols = {entry.protocol.label for entry in entries if entry.protocol is not None}
    failed = sum(entry.state is RunState.FAILED for entry in entries)
    for label in sorted(protocols):
        click.echo(f"protocol: {label}; {len(entries)} runs, {failed} failed")
