"""Output of the command line: JSON and tables on stdout, progress and messages on stderr."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console
from rich.table import Table
from rich.text import Text

from slamhive.base.clock import monotonic_s
from slamhive.cli.visible import say, visible, visible_json, visible_line

if TYPE_CHECKING:
    from rich.progress import Progress

    from slamhive.documents.catalogue import MatchDocument
    from slamhive.domain.verdict import Hint
    from slamhive.services.hive import Hive
    from slamhive.store import EvaluationRecord

STATE_STYLES = {"succeeded": "green", "failed": "red", "cancelled": "yellow", "running": "cyan", "queued": "dim"}
PIPED_WIDTH = 160
COLUMN_GAP = 2
_PLAIN_INTERVAL_S = 5.0
_LEAST_CUT = 12

messages = Console(stderr=True, highlight=False)


def print_error(text: str, pointer: Sequence[str] = ()) -> None:
    """An error on stderr, in one line; ``pointer`` are lines above it that show the place in a text."""
    if pointer:
        messages.print("\n".join(map(visible_line, pointer)), markup=False, soft_wrap=True)
    messages.print(Text.assemble(("error: ", "bold red"), visible(text)), soft_wrap=True)


def tell(text: str, style: str | None = None) -> None:
    """A line on stderr. Nothing in it is taken for markup."""
    messages.print(visible(text), style=style, markup=False, soft_wrap=True)


def print_json(content: Any) -> None:
    """``content`` as JSON on stdout."""
    say(visible_json(json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)))


def print_table(
    columns: Sequence[str],
    rows: Sequence[Sequence[Any]],
    *,
    right: Sequence[str] = (),
    spare: Sequence[str] = (),
    cut: Sequence[str] = (),
) -> None:
    """A table on stdout. Nothing in a cell is taken for markup, and each is one line.

    Args:
        columns: The heading of each column.
        rows: One cell per column; None is shown as a dash.
        right: Columns of numbers.
        spare: Columns to drop on a narrow terminal, in this order; a message on stderr names them.
        cut: Columns whose text ends with … where the terminal is too narrow for all of it; rows then stay one line.
    """
    width = Console().width if sys.stdout.isatty() else PIPED_WIDTH
    left_out = columns_to_leave_out(columns, rows, spare, width)
    kept = [index for index, column in enumerate(columns) if column not in left_out]
    # Widths with which the table fits, in characters: the first column in ``cut`` is cut first.
    widths = _widths(columns, rows)
    excess = sum(widths.values()) - COLUMN_GAP - width
    shortened: dict[str, int] = {}
    for column in cut:
        full = widths[column] - COLUMN_GAP
        taken = max(0, min(excess, full - max(len(column), _LEAST_CUT)))
        shortened[column] = full - taken
        excess -= taken
    table = Table(box=None, pad_edge=False, header_style="bold")
    for index in kept:
        align: Literal["left", "right"] = "right" if columns[index] in right else "left"
        table.add_column(
            columns[index],
            justify=align,
            overflow="ellipsis" if cut else "fold",
            no_wrap=bool(spare or cut),
            max_width=shortened.get(columns[index]),
        )
    for row in rows:
        table.add_row(*(_cell(row[index]) for index in kept))
    Console(highlight=False, width=width).print(table)
    if left_out:
        messages.print(f"not shown, the terminal is narrow: {', '.join(left_out)}", markup=False, soft_wrap=True)


def columns_to_leave_out(
    columns: Sequence[str], rows: Sequence[Sequence[Any]], spare: Sequence[str], width: int
) -> list[str]:
    """The ``spare`` columns to drop, in their order, so that the others fit into ``width`` characters."""
    widths = _widths(columns, rows)
    left_out: list[str] = []
    for column in spare:
        if sum(widths.values()) - COLUMN_GAP <= width:
            break
        del widths[column]
        left_out.append(column)
    return left_out


def _widths(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> dict[str, int]:
    """The width of each column with the gap after it, in characters."""
    return {
        column: max([len(column), *(len(visible_line(str(row[index]))) for row in rows)]) + COLUMN_GAP
        for index, column in enumerate(columns)
    }


def _cell(value: Any) -> Text:
    if value is None:
        return Text("–", style="dim")
    text = visible_line(str(value))
    return Text(text, style=STATE_STYLES.get(text, ""))


@contextmanager
def progress_bar(title: str, *, tells_left: bool = True) -> Iterator[Callable[[float, str], None]]:
    """A bar on a terminal, a line every few seconds elsewhere; with the time left unless the texts state it.

    Yields a function that takes the fraction done (0..1) and what is being done.
    """
    if not messages.is_terminal:
        yield _plain_progress(title, tells_left=tells_left)
        return
    with _bar("{task.percentage:>3.0f} %", tells_left=tells_left) as bar:
        task = bar.add_task(title, total=1.0)
        yield lambda fraction, text: bar.update(task, completed=fraction, description=visible_line(f"{title}: {text}"))


@contextmanager
def counting_bar(title: str, total: int, *, tells_left: bool = True) -> Iterator[Callable[[int, str], None]]:
    """Show a bar like :func:`progress_bar`, for done / total; yields a function of how many are done, and a text.

    ``tells_left``: show the time left, assuming that the rest is as fast as what is done.
    """
    if not messages.is_terminal:
        plain = _plain_progress(title, tells_left=tells_left)
        yield lambda done, text: plain(done / total if total else 1.0, _counted(done, total, text))
        return
    with _bar("{task.completed}/{task.total}", tells_left=tells_left) as bar:
        task = bar.add_task(title, total=total)
        yield lambda done, text: bar.update(task, completed=done, description=visible_line(f"{title}: {text}"))


def _counted(done: int, total: int, text: str) -> str:
    return f"{done} of {total}, {text}" if text else f"{done} of {total}"


def _bar(share: str, *, tells_left: bool) -> Progress:
    """A bar with what it is about, how much is done, as ``share`` says it, and times."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn  # noqa: PLC0415

    left = (TextColumn("left"), TimeRemainingColumn()) if tells_left else ()
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn(share),
        TimeElapsedColumn(),
        *left,
    )
    return Progress(*columns, console=messages)


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
        line = visible_line(f"{title}: {text} ({fraction:.0%}, {elapsed_s:.0f} s{left})")
        messages.print(Text(line), soft_wrap=True)

    return show


# Hints at common mistakes, as commands print them.


_NAMED_RUNS = 5


def hint_in_words(hint: Hint) -> str:
    """Return what was found, and what to do."""
    return f"{hint.sentence} Remedy: {hint.remedy}."


def hints_of(hive: Hive, ended: Iterable[EvaluationRecord]) -> dict[int, tuple[Hint, ...]]:
    """{run: hints} of successful evaluations that have hints."""
    from slamhive.services.evaluations import evaluation_notes  # noqa: PLC0415 - lists of runs show no hints

    found = {
        entry.run_id: evaluation_notes(hive.runs.folder(entry.run_id), entry.protocol.fingerprint).hints
        for entry in ended
        if entry.reason is None
    }
    return {run_id: hints for run_id, hints in found.items() if hints}


def print_hints(found: dict[int, tuple[Hint, ...]]) -> None:
    """Print each hint on stderr once, with the numbers of the first run that has it."""
    alike: dict[tuple[str, str], list[tuple[int, Hint]]] = {}
    for run_id, hints in found.items():
        for hint in hints:
            alike.setdefault((hint.key, hint.remedy.partition(":")[0]), []).append((run_id, hint))
    for members in alike.values():
        first, hint = members[0]
        numbers = ", ".join(str(run_id) for run_id, _ in members[:_NAMED_RUNS])
        more = f" and {len(members) - _NAMED_RUNS} more" if len(members) > _NAMED_RUNS else ""
        where = f"run {first}" if len(members) == 1 else f"runs {numbers}{more} (the numbers are those of run {first})"
        tell(f"hint for {where}: {hint_in_words(hint)}")


# The fit of an algorithm and a dataset, on the command line.


def print_match(match: MatchDocument) -> None:
    """The sensor in each role, and the parameters that are taken from sensors."""
    rows = [
        (
            role,
            used.name,
            f"{used.rate_hz:g}",
            match.topics.get(role, used.topic),
            ", ".join(name for name in used.fitting if name != used.name) or None,
        )
        for role, used in match.sensors.items()
    ]
    print_table(("role", "sensor", "Hz", "topic", "also fits"), rows, right=("Hz",))
    if match.parameters:
        print_table(("parameter", "value", "source"), list(bound_rows(match)))
    else:
        say("no parameter is taken from a sensor")


def bound_rows(match: MatchDocument | None) -> Iterator[tuple[str, object, str]]:
    """Key, value and source of each parameter that is taken from a sensor."""
    for key, entry in ({} if match is None else match.parameters).items():
        yield key, list(entry.value) if isinstance(entry.value, tuple) else entry.value, entry.words
