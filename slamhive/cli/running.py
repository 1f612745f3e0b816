"""``slamhive run``: queue runs and, with ``--wait``, work on them to their end."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import click

from slamhive.base.errors import InvalidInput
from slamhive.cli import completion
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, print_match, tell
from slamhive.cli.runs import print_runs
from slamhive.cli.waiting import run_to_end
from slamhive.documents.catalogue import MatchDocument
from slamhive.documents.limits import RULES, Option
from slamhive.documents.submission import CONTENT, OPTIONS, Submission, parse_stop_when
from slamhive.domain.configuration import Variant, parse_step
from slamhive.domain.roles import parse_choices
from slamhive.domain.run import RunState
from slamhive.services.configurations import unwatchable

# Options of commands that submit runs, generated from the fields of a submission.


Command = Callable[..., Any]
Decorator = Callable[[Command], Command]

_FLAGS = {
    "playback_mode": "--playback",
    "playback_rate": "--rate",
    "alignment": "--align",
    "cpu_cores": "--cpus",
    "memory_mb": "--memory",
    "timeout_s": "--timeout",
}
"""Flags that differ from the names of their fields."""
_STEP_HELP = (
    "A pre-processing step, as 'KIND@SENSOR,SENSOR OPTION=VALUE'; may be repeated, in order. "
    "`slamhive variants steps` lists all."
)
_STRUCTURED = {
    "parameters": click.option(
        "--set",
        "parameters",
        multiple=True,
        metavar="KEY=VALUE",
        help="Set a parameter, by its key or general name; may be repeated.",
    ),
    "variant": click.option("--step", "variant", multiple=True, metavar="STEP", help=_STEP_HELP),
    "sensors": click.option(
        "--sensor",
        "sensors",
        multiple=True,
        metavar="ROLE=SENSOR",
        help="The sensor for a role, where several fit (left=cam2); may be repeated. --preview shows the others.",
    ),
    "stop_when": click.option(
        "--stop-when",
        multiple=True,
        metavar="RULE=NUMBER",
        help=f"End a run early, with the reason: {', '.join(RULES)}; may be repeated.",
    ),
}
"""Options whose values are more than one word or number."""

step_option = _STRUCTURED["variant"]


def all_of(*options: Decorator) -> Decorator:
    """Several options of a command, in this order."""

    def add(command: Command) -> Command:
        for option in reversed(options):
            command = option(command)
        return command

    return add


def run_options() -> Decorator:
    """The options that say how runs of a configuration are executed."""
    return _options(option for option in OPTIONS.values() if option.group != CONTENT)


def content_options(*, changes: bool = False) -> Decorator:
    """The options that make up a configuration. For ``changes`` to one, an option that is not given is None."""
    content = (option for option in OPTIONS.values() if option.group == CONTENT)
    content = (option for option in content if option.name not in ("algorithm", "dataset"))
    return _options(replace(option, default=None) if changes else option for option in content)


def submission_options() -> Decorator:
    """All options of a submission besides algorithm and dataset."""
    return all_of(content_options(), run_options())


def submission_values(options: dict[str, Any]) -> dict[str, Any]:
    """The fields of a submission from the options of a command; raises NotFound or InvalidInput naming the text."""
    readers = {
        "parameters": parse_assignments,
        "variant": parse_steps,
        "sensors": parse_choices,
        "stop_when": parse_stop_when,
    }
    names = {option.name.partition(".")[0] for option in OPTIONS.values()}
    return {
        name: readers[name](value) if name in readers else value for name, value in options.items() if name in names
    }


def parse_assignments(texts: Sequence[str]) -> dict[str, str]:
    """``KEY=VALUE`` texts as a mapping; raises InvalidInput for one without ``=`` or a key given twice."""
    parsed: dict[str, str] = {}
    for text in texts:
        key, sign, value = text.partition("=")
        if not sign or not key:
            raise InvalidInput(f"--set {text!r} is not KEY=VALUE", "for example --set nFeatures=2000")
        if key in parsed:
            raise InvalidInput(f"--set {key} is given twice")
        parsed[key] = value
    return parsed


def parse_steps(texts: Sequence[str]) -> Variant:
    """The steps of ``--step`` options, options still text; raises InvalidInput."""
    return tuple(parse_step(text) for text in texts)


def _options(options: Iterable[Option]) -> Decorator:
    """A flag for each option; the rules of a nested model share one."""
    found: dict[str, Decorator] = {}
    for option in options:
        name = option.name.partition(".")[0]
        found.setdefault(name, _STRUCTURED.get(name) or _flag(option))
    return all_of(*found.values())


def _flag(option: Option) -> Decorator:
    dashed = option.name.replace("_", "-")
    flag = _FLAGS.get(option.name, f"--{dashed}")
    help_text = f"{option.help}  [unit: {option.unit}]" if option.unit else option.help
    shown = option.default is not None
    if option.kind is bool:
        return click.option(f"--{dashed}/--no-{dashed}", default=option.default, show_default=shown, help=help_text)
    kind = click.Choice([str(choice) for choice in option.choices]) if option.choices else option.kind
    default = str(option.default) if option.choices and shown else option.default
    return click.option(flag, option.name, type=kind, default=default, show_default=shown, help=help_text)


@click.command()
@click.argument("algorithm", shell_complete=completion.ALGORITHM)
@click.argument("dataset", shell_complete=completion.DATASET)
@submission_options()
@click.option("--wait", is_flag=True, help="Wait until the runs have ended; run them here if there is no worker.")
@click.option("--preview", is_flag=True, help="Only print which sensors are used and what is taken from them.")
@json_option
@pass_cli
def run(cli: CliContext, as_json: bool, wait: bool, preview: bool, **options: Any) -> None:
    """Run ALGORITHM on DATASET."""
    hive = cli.hive()
    submission = Submission(**submission_values(options))
    if preview:
        match = MatchDocument.of_match(hive.configurations.check(submission).match)
        print_json(match.content) if as_json else print_match(match)
        return
    submitted = hive.runs.submit(submission)
    unseen = unwatchable(submission.stop_when, [hive.catalogue.algorithm(submission.algorithm)])
    for note in (unseen, hive.configurations.map_note(submission)):
        if note is not None:
            tell(f"note: {note}")
    run_ids = [entry.id for entry in submitted]
    if wait:
        run_to_end(hive, run_ids, evaluate=submission.evaluate)
    elif not hive.worker_alive():
        tell("no worker is running here; start one with `slamhive worker` or `slamhive serve`")
    ended = [hive.runs.get(run_id) for run_id in run_ids]
    print_runs(ended, as_json)
    if wait and any(entry.state is not RunState.SUCCEEDED for entry in ended):
        raise click.exceptions.Exit(1)


COMMANDS = (run,)
