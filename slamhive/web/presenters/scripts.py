"""Lines to copy that do what a page does: in Python, on the command line and with curl."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import quote

from slamhive.base.settings import Settings
from slamhive.store.records import RunSort


@dataclass(frozen=True, slots=True)
class Script:
    """Lines to copy, and for what."""

    title: str
    text: str


def run_scripts(run_id: int, settings: Settings) -> tuple[Script, ...]:
    """One run."""
    server = _server(settings)
    python = f"run = hive.runs.get({run_id})\nprint(run.metrics)\ntrajectory = run.trajectory().to_evo()"
    return _scripts(settings, python, f"slamhive runs show {run_id}", f"curl {server}/api/v1/runs/{run_id}")


def search_scripts(where: str, sort: RunSort, settings: Settings) -> tuple[Script, ...]:
    """All runs that match a filter, in an order."""
    chosen = f".where({where!r})" if where else ""
    order = f", descending={sort.descending}" if sort.descending else ""
    command = ["slamhive", "runs", *(("--where", where) if where else ()), "--sort", sort.key]
    command += [*(() if sort.descending else ("--ascending",)), "--csv"]
    arguments = {"where": where, "sort": sort.key, "order": "desc" if sort.descending else "asc"}
    data = [part for name, value in arguments.items() if value for part in ("--data-urlencode", f"{name}={value}")]
    return _scripts(
        settings,
        f"table = hive.runs{chosen}.sort({sort.key!r}{order}).to_pandas()",
        shlex.join(command),
        shlex.join(["curl", "--get", f"{_server(settings)}/api/v1/runs", *data]),
    )


def search_commands(where: str) -> list[str]:
    """The commands that act on all runs of a search."""
    chosen = ["--where", where]
    commands = (["runs", "tag", *chosen, "--add", "TAG"], ["evaluate", *chosen])
    more = (["runs", action, *chosen] for action in ("retry", "delete"))
    return [shlex.join(["slamhive", *command]) for command in (*commands, *more)]


def comparison_scripts(run_ids: Sequence[int], settings: Settings, *, grouped: bool) -> tuple[Script, ...]:
    """A comparison of runs; in Python, their metrics as a table."""
    numbers = ",".join(map(str, run_ids))
    group = "&group=configuration" if grouped else ""
    command = f"slamhive compare {' '.join(map(str, run_ids))}{' --group configuration' if grouped else ''}"
    return _scripts(
        settings,
        f"import pandas as pd\n\ntable = pd.DataFrame({{run: hive.runs.get(run).metrics for run in ({numbers})}})",
        command,
        f"curl '{_server(settings)}/api/v1/comparison?runs={numbers}{group}'",
    )


def experiment_scripts(name: str, settings: Settings) -> tuple[Script, ...]:
    """The results of an experiment."""
    return _scripts(
        settings,
        f"experiment = hive.experiments.get({name!r})\ntable = experiment.runs.to_pandas()",
        shlex.join(["slamhive", "experiment", "report", name]),
        shlex.join(["curl", f"{_server(settings)}/api/v1/experiments/{quote(name)}/cells"]),
    )


def dataset_scripts(name: str, settings: Settings) -> tuple[Script, ...]:
    """The description of a dataset; in Python, its runs."""
    return _scripts(
        settings,
        f"table = hive.runs.where({f'dataset = {name}'!r}).to_pandas()",
        shlex.join(["slamhive", "dataset", "show", name]),
        shlex.join(["curl", f"{_server(settings)}/api/v1/datasets/{quote(name)}"]),
    )


def _scripts(settings: Settings, python: str, command: str, curl: str) -> tuple[Script, ...]:
    beginning = f"from slamhive.client import Hive\n\nhive = Hive.connect({_server(settings)!r})\n"
    return (Script("Python", beginning + python), Script("Command line", command), Script("curl", curl))


def _server(settings: Settings) -> str:
    """The address in the settings: the Host of a request is not to be trusted in lines that people run."""
    return f"http://{settings.host}:{settings.port}"
