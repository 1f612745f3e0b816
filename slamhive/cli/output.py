"""How the command line speaks: JSON and tables on stdout, progress and messages on stderr, one line per error."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Literal

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from slamhive.clock import monotonic_s
from slamhive.errors import InvalidInput, SlamHiveError, one_line
from slamhive.input_bounds import check_text
from slamhive.search.reader import FilterError

STATE_STYLES = {"succeeded": "green", "failed": "red", "cancelled": "yellow", "running": "cyan", "queued": "dim"}
PIPED_WIDTH = 160
COLUMN_GAP = 2
_PLAIN_INTERVAL_S = 5.0

messages = Console(stderr=True, highlight=False)


class OneLineErrors(click.Group):
    """A group whose commands end with one line and exit code 1 for every explained error."""

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        """Parse the options of the root command; a mistake in them ends as one in a subcommand does."""
        try:
            for number, text in enumerate(args, start=1):
                check_text(text, f"argument {number}")
            return super().make_context(info_name, args, parent, **extra)
        except InvalidInput as error:  # bytes that are not UTF-8 arrive as halves of surrogate pairs
            _print_error(str(error))
            raise click.exceptions.Exit(1) from None
        except click.UsageError as error:
            _print_usage_error(error)
            raise click.exceptions.Exit(1) from None

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; turn SlamHiveError into a message."""
        try:
            return super().invoke(ctx)
        except SlamHiveError as error:
            if isinstance(error, FilterError):
                messages.print("\n".join(error.pointer), markup=False, soft_wrap=True)
            _print_error(str(error))
            ctx.exit(1)
        except click.UsageError as error:
            _print_usage_error(error)
            ctx.exit(1)
        except BrokenPipeError:
            sys.stderr.close()
            ctx.exit(0)


def _print_error(text: str) -> None:
    messages.print(Text.assemble(("error: ", "bold red"), text), soft_wrap=True)


def _print_usage_error(error: click.UsageError) -> None:
    """One line: what is wrong with the arguments, and where the right ones are listed."""
    text = one_line(error.format_message()).rstrip(".")
    path = "slamhive" if error.ctx is None else error.ctx.command_path
    _print_error(f"{text}; see {path} --help")


def print_json(content: Any) -> None:
    """``content`` as JSON on stdout."""
    click.echo(json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False))


def print_table(
    columns: Sequence[str],
    rows: Sequence[Sequence[Any]],
    *,
    right: Sequence[str] = (),
    spare: Sequence[str] = (),
) -> None:
    """A table on stdout. Nothing in a cell is taken for markup.

    Args:
        columns: The head of each column.
        rows: A cell for each column; None is shown as a dash.
        right: Columns of numbers.
        spare: Columns that a narrow terminal goes without, the first to go first; which ones is said on stderr.
    """
    width = Console().width if sys.stdout.isatty() else PIPED_WIDTH
    left_out = columns_to_leave_out(columns, rows, spare, width)
    kept = [index for index, column in enumerate(columns) if column not in left_out]
    table = Table(box=None, pad_edge=False, header_style="bold")
    for index in kept:
        align: Literal["left", "right"] = "right" if columns[index] in right else "left"
        table.add_column(columns[index], justify=align, overflow="fold", no_wrap=bool(spare))
    for row in rows:
        table.add_row(*(_cell(row[index]) for index in kept))
    Console(highlight=False, width=width).print(table)
    if left_out:
        messages.print(f"not shown, the terminal is narrow: {', '.join(left_out)}", markup=False, soft_wrap=True)


def columns_to_leave_out(
    columns: Sequence[str], rows: Sequence[Sequence[Any]], spare: Sequence[str], width: int
) -> list[str]:
    """Which of the ``spare`` columns have to go, in their order, for the rest to fit into ``width`` characters."""
    widths = {
        column: max([len(column), *(len(str(row[index])) for row in rows)]) + COLUMN_GAP
        for index, column in enumerate(columns)
    }
    left_out: list[str] = []
    for column in spare:
        if sum(widths.values()) - COLUMN_GAP <= width:
            break
        del widths[column]
        left_out.append(column)
    return left_out


def _cell(value: Any) -> Text:
    if value is None:
        return Text("–", style="dim")
    text = str(value)
    return Text(text, style=STATE_STYLES.get(text, ""))


@contextmanager
def progress_bar(title: str, *, tells_left: bool = True) -> Iterator[Callable[[float, str], None]]:
    """A bar on a terminal, a line every few seconds elsewhere; with the time left unless the texts state it.

    Yields a function that takes the fraction done (0..1) and what is being done.
    """
    if not messages.is_terminal:
        yield _plain_progress(title, tells_left=tells_left)
        return
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        *((TextColumn("left"), TimeRemainingColumn()) if tells_left else ()),
        console=messages,
    ) as bar:
        task = bar.add_task(title, total=1.0)
        yield lambda fraction, text: bar.update(task, completed=fraction, description=f"{title}: {text}")


@contextmanager
def counting_bar(title: str, total: int, *, tells_left: bool = True) -> Iterator[Callable[[int, str], None]]:
    """As :func:`progress_bar`, for done / total; yields a function that takes how many are done, and a text.

    ``tells_left``: the time left is told, taking the rest to go as fast as what is done; for texts that say nothing.
    """
    if not messages.is_terminal:
        plain = _plain_progress(title, tells_left=tells_left)
        yield lambda done, text: plain(done / total if total else 1.0, f"{done}/{total} {text}")
        return
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        *((TextColumn("left"), TimeRemainingColumn()) if tells_left else ()),
        console=messages,
    ) as bar:
        task = bar.add_task(title, total=total)
        yield lambda done, text: bar.update(task, completed=done, description=f"{title}: {text}")


def _plain_progress(title: str, *, tells_left: bool = True) -> Callable[[float, str], None]:
    started = monotonic_s()
    last = [started - _PLAIN_INTERVAL_S, -1.0]

    def show(fraction: float, text: str) -> None:
        now = monotonic_s()
        finished = fraction >= 1.0 > last[1]
        if now - last[0] < _PLAIN_INTERVAL_S and not finished:
            return
        last[:] = [now, fraction]
        elapsed_s = now - started
        left = f", {elapsed_s * (1 / fraction - 1):.0f} s left" if tells_left and 0.01 < fraction < 1 else ""
        messages.print(Text(f"{title}: {text} ({fraction:.0%}, {elapsed_s:.0f} s{left})"), soft_wrap=True)

    return show
