"""``slamhive algorithm test``: whether packages keep what they promise, on this machine."""

from __future__ import annotations

from collections.abc import Sequence

import click

from slamhive.cli import offers
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_table, tell
from slamhive.cli.waiting import run_to_end
from slamhive.domain.algorithm import Algorithm
from slamhive.errors import InvalidInput, NotFound
from slamhive.schema.catalogue import BoundResult
from slamhive.services.bounds import BoundTest, bound_tests
from slamhive.services.hive import Hive

COLUMNS = (
    *("algorithm", "dataset", "run", "poses", "at least", "ATE m", "at most", "relations m", "at most"),
    *("relations deg", "at most", "ms per frame", "RAM MB", "result"),
)


@click.command("test")
@click.argument("names", nargs=-1, shell_complete=offers.PACKAGE)
@click.option("--all", "all_", is_flag=True, help="Test all packages.")
@click.option("--dataset", "datasets", multiple=True, help="Only the bounds on these datasets.")
@click.option("--executor", help="An executor that `slamhive doctor --all` lists; default: the one in force.")
@json_option
@pass_cli
def test(
    cli: CliContext, names: tuple[str, ...], all_: bool, datasets: tuple[str, ...], executor: str | None, as_json: bool
) -> None:
    """Test whether the algorithms or packages NAMES keep their bounds.

    Runs each mode on the datasets that are here and for which its algorithm.yaml states bounds. Compares the number of
    poses and the trajectory error with them. The exit code is 1 if a bound is not kept.
    """
    if bool(names) == all_:
        raise InvalidInput("name the algorithms to test, or give --all", "slamhive algorithm list shows them")
    hive = cli.hive()
    tests = _tests_here(hive, _chosen(hive, names), datasets)
    run_ids = [hive.runs.submit(entry.submission(executor))[0].id for entry in tests]
    run_to_end(hive, run_ids, evaluate=True)
    results = [entry.result(hive.runs.get(run_id)) for entry, run_id in zip(tests, run_ids, strict=True)]
    if as_json:
        print_json([result.content for result in results])
    else:
        _print(results)
    if any(result.problem is not None for result in results):
        raise click.exceptions.Exit(1)


def _chosen(hive: Hive, names: Sequence[str]) -> list[Algorithm]:
    """The algorithms called ``names`` or of packages called so; all without names."""
    known = hive.catalogue.algorithms()
    for name in names:
        if all(name not in {entry.name, entry.package.name} for entry in known):
            hive.catalogue.algorithm(name)  # explains what is wrong with the name
    return [entry for entry in known if not names or entry.name in names or entry.package.name in names]


def _tests_here(hive: Hive, algorithms: Sequence[Algorithm], datasets: Sequence[str]) -> list[BoundTest]:
    """The tests whose datasets are here; says which cannot be done. Raises if there is none."""
    tests = bound_tests(algorithms, datasets)
    if not tests:
        names = ", ".join(entry.name for entry in algorithms)
        where = f" on {', '.join(datasets)}" if datasets else ""
        raise InvalidInput(f"no bounds are stated for {names}{where}", "add bounds to algorithm.yaml")
    here = {entry.name for entry in hive.catalogue.datasets()}
    missing = sorted({entry.bound.dataset for entry in tests} - here)
    if missing and not here.intersection(entry.bound.dataset for entry in tests):
        raise NotFound(f"no dataset of the bounds is here: {', '.join(missing)}", "make one: slamhive dataset room")
    for name in missing:
        left_out = ", ".join(entry.algorithm.name for entry in tests if entry.bound.dataset == name)
        tell(f"not tested on {name}, which is not here: {left_out}", style="yellow")
    return [entry for entry in tests if entry.bound.dataset in here]


def _print(results: Sequence[BoundResult]) -> None:
    rows = [
        (
            entry.algorithm,
            entry.bound.dataset,
            entry.run,
            entry.poses,
            entry.bound.poses,
            _number(entry.ate_rmse_m, 4),
            _number(entry.bound.ate_rmse_m, 4),
            _number(entry.relations_m, 4),
            _number(entry.bound.relations_m, 4),
            _number(entry.relations_deg, 2),
            _number(entry.bound.relations_deg, 2),
            _number(entry.latency_median_ms, 1),
            _number(entry.memory_max_mb, 0),
            "kept" if entry.problem is None else "NOT KEPT",
        )
        for entry in results
    ]
    print_table(COLUMNS, rows, right=COLUMNS[2:-1])
    for entry in results:
        if entry.problem is not None:
            tell(f"{entry.algorithm} on {entry.bound.dataset}: {entry.problem}", style="red")


def _number(value: float | None, digits: int) -> str | None:
    return None if value is None else f"{value:.{digits}f}"


COMMANDS = (test,)
