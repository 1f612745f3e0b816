"""``slamhive dataset``: import, render, list, show, remove."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from slamhive.bags.room import RoomOptions
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, progress_bar, tell
from slamhive.domain.dataset import Dataset
from slamhive.services.datasets import dataset_document


@click.group()
def dataset() -> None:
    """Import, render and show datasets."""


@dataset.command("import")
@click.argument("importer", metavar="FORMAT")
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--name", required=True, help="Name of the new dataset.")
@json_option
@pass_cli
def import_(cli: CliContext, importer: str, source: Path, name: str, as_json: bool) -> None:
    """Convert a recording in FORMAT (kitti-odometry, or auto to detect it) at SOURCE into a dataset."""
    with progress_bar(f"importing {name}") as progress:
        made = cli.hive(indexed=False).catalogue.import_dataset(importer, source, name, progress)
    _report(made, as_json)


@dataset.command("room")
@click.option("--name", default="room", show_default=True, help="Name of the new dataset.")
@click.option("--seconds", type=float, default=15.0, show_default=True, help="Duration in s.")
@click.option("--seed", type=int, default=1, show_default=True, help="The same seed gives the same bytes.")
@json_option
@pass_cli
def room(cli: CliContext, name: str, seconds: float, seed: int, as_json: bool) -> None:
    """Render the synthetic room: stereo, depth, IMU, LiDAR and exact ground truth."""
    options = RoomOptions(name=name, duration_s=seconds, seed=seed)
    with progress_bar(f"rendering {name}") as progress:
        made = cli.hive(indexed=False).catalogue.render_room(options, progress)
    _report(made, as_json)


@dataset.command("list")
@json_option
@pass_cli
def list_(cli: CliContext, as_json: bool) -> None:
    """List all datasets."""
    catalogue = cli.hive(indexed=False).catalogue
    found = catalogue.datasets()
    if as_json:
        print_json([_to_json(entry) for entry in found])
        return
    if not found:
        tell("no datasets yet; `slamhive dataset room` renders one")
    else:
        rows = [
            (
                entry.name,
                f"{entry.duration_s:.1f}",
                ", ".join(f"{sensor.name} {sensor.rate_hz:g} Hz" for sensor in entry.sensors),
                _ground_truth(entry),
            )
            for entry in found
        ]
        print_table(("name", "duration s", "sensors", "ground truth"), rows, right=("duration s",))
    for broken in catalogue.broken():
        tell(f"left out: {broken.problem}")


@dataset.command("show")
@click.argument("name")
@json_option
@pass_cli
def show(cli: CliContext, name: str, as_json: bool) -> None:
    """Show one dataset: sensors, calibration, ground truth."""
    entry = cli.hive(indexed=False).catalogue.dataset(name)
    _report(entry, as_json)
    if not as_json:
        click.echo()
        print_table(("sensor", "calibration", "value"), _calibration(entry))


@dataset.command("remove")
@click.argument("name")
@click.confirmation_option(prompt="Delete the dataset's folder? Runs keep their results.")
@pass_cli
def remove(cli: CliContext, name: str) -> None:
    """Delete a dataset and its variants; runs that used it keep their results."""
    hive = cli.hive(indexed=False)
    hive.catalogue.remove_dataset(name)
    hive.variants.drop_unused(name)
    tell(f"dataset {name} removed")


def _to_json(entry: Dataset) -> dict[str, Any]:
    return {**dataset_document(entry).content, "folder": str(entry.folder)}


def _report(entry: Dataset, as_json: bool) -> None:
    if as_json:
        print_json(_to_json(entry))
        return
    click.echo(f"{entry.name}: {entry.duration_s:.1f} s, {entry.bag_path if entry.bag else 'no recording'}")
    for label, text in (
        ("title", entry.title),
        ("attributes", ", ".join(entry.attributes)),
        ("licence", entry.licence),
        ("ground truth", _ground_truth_in_words(entry)),
        ("relations", entry.relations),
    ):
        if text:
            click.echo(f"{label}: {text}")
    rows = [(s.name, s.kind.value, s.topic, f"{s.rate_hz:g}") for s in entry.sensors]
    print_table(("sensor", "kind", "topic", "rate Hz"), rows, right=("rate Hz",))


def _calibration(entry: Dataset) -> list[tuple[str, str, str]]:
    return [
        (sensor.name, key, ", ".join(f"{number:.6g}" for number in value) if isinstance(value, tuple) else str(value))
        for sensor in entry.sensors
        for key, value in (*sensor.calibration.items(), ("T_body_sensor", sensor.T_body_sensor))
    ]


def _ground_truth(entry: Dataset) -> str:
    if entry.groundtruth_path is None:
        return "no" if entry.relations is None else "relations"
    return "yes" if entry.groundtruth_path.is_file() else "file missing"


def _ground_truth_in_words(entry: Dataset) -> str:
    truth = entry.groundtruth
    if truth is None:
        return "none" if entry.relations is None else "no trajectory"
    traits = (
        "" if entry.groundtruth_path is not None and entry.groundtruth_path.is_file() else "the file is missing",
        "z axis up" if truth.gravity_aligned else "z axis not known to point up",
        "positions only" if truth.positions_only else "",
    )
    return f"{truth.file}, {', '.join(trait for trait in traits if trait)}"


COMMANDS = (dataset,)
