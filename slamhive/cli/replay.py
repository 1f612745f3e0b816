"""``slamhive replay``: run again what a bundle recorded, and say whether both agree."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.mistakes import Answering
from slamhive.cli.output import print_json, print_table, progress_bar, tell
from slamhive.cli.visible import say
from slamhive.domain.numbers import plural
from slamhive.domain.replay import DEFAULT_MARGINS, Agreement
from slamhive.errors import InvalidInput
from slamhive.files import write_aside

if TYPE_CHECKING:
    from slamhive.schema.replay import ReplayAnswer

EXIT_CODES = {Agreement.AGREE: 0, Agreement.DIFFERS: 1, Agreement.UNDECIDED: 3}
STYLES = {Agreement.AGREE: "green", Agreement.DIFFERS: "red", Agreement.UNDECIDED: "yellow"}
_DEFAULTS = ", ".join(f"{key}={margin.words().replace(' ', '')}" for key, margin in DEFAULT_MARGINS.items())


@click.command(cls=Answering)
@click.argument("bundle", type=click.Path(dir_okay=False, path_type=Path))
@click.option(
    "--repeats", type=click.IntRange(1, 1000), default=5, show_default=True, help="Runs of each configuration."
)
@click.option("--into", type=click.Path(file_okay=False, path_type=Path), help="Data root to use; made if missing.")
@click.option("--executor", help="Where runs are executed; by default where the recorded ones were.")
@click.option("--load-image", is_flag=True, help="Take packages and images from BUNDLE. They are code that runs here.")
@click.option("--rebuild", is_flag=True, help="Build a package again if its image or environment is not here.")
@click.option(
    "--margin",
    "margins",
    multiple=True,
    metavar="METRIC=MARGIN",
    help=f"A share (5%), a number in the metric's unit, or off; may be repeated.  [default: {_DEFAULTS}]",
)
@click.option("--markdown", type=click.Path(dir_okay=False, path_type=Path), help="Write a summary.")
@json_option
@pass_cli
def replay(cli: CliContext, /, bundle: Path, as_json: bool, **options: Any) -> None:
    """Run again what BUNDLE recorded, and say whether old and new agree. See docs/replay.md.

    BUNDLE is a file of `slamhive archive export`. The exit code is 0 if all metrics agree within their margins, and 1
    if one differs and chance does not explain it. It is 3 if the runs are too few to say, and 2 for a mistake.
    """
    # Importing the services takes half a second, which `--help` need not wait for.
    from slamhive.cli.waiting import run_to_end  # noqa: PLC0415
    from slamhive.services.replay import ReplayRequest  # noqa: PLC0415

    markdown = options["markdown"]
    if markdown is not None and not markdown.parent.is_dir():
        raise InvalidInput(f"folder {markdown.parent} does not exist", "make it first")
    if options["into"] is not None:
        cli.options_with(data=options["into"].absolute())
    named = ("repeats", "executor", "load_image", "rebuild", "margins")
    hive = cli.hive()
    with progress_bar("preparing") as show:
        prepared = hive.replays.prepare(ReplayRequest(bundle, **{name: options[name] for name in named}), show)
    started = hive.replays.start(prepared)
    run_to_end(hive, [run_id for run_ids in started for run_id in run_ids], evaluate=True)
    answer = hive.replays.answer(prepared, started)
    print_json(answer.content) if as_json else _print(answer)
    _write(answer, markdown)
    raise click.exceptions.Exit(EXIT_CODES[answer.answer])


def _print(answer: ReplayAnswer) -> None:
    from slamhive.services import replay as tables  # noqa: PLC0415

    print_table(tables.METRIC_HEADS, tables.metric_rows(answer), right=tables.METRIC_HEADS[1:-1])
    say()
    print_table(tables.CONFIGURATION_HEADS, tables.configuration_rows(answer), right=tables.CONFIGURATION_HEADS[2:])
    say()
    values = [
        tuple(f"{cell:.4g}" if isinstance(cell, float) else cell for cell in row) for row in tables.value_rows(answer)
    ]
    print_table(tables.VALUE_HEADS, values, right=tables.VALUE_HEADS[2:])
    for note in answer.notes:
        tell(note)
    count = plural(sum(len(entry.runs) for entry in answer.configurations), "repeat")
    tell(f"replay of {answer.bundle}, {count}: {answer.answer}. {answer.words}", style=STYLES[answer.answer])


def _write(answer: ReplayAnswer, markdown: Path | None) -> None:
    from slamhive.services.replay import answer_markdown  # noqa: PLC0415

    if markdown is not None:
        write_aside(markdown, answer_markdown(answer))


COMMANDS = (replay,)
