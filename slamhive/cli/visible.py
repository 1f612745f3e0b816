"""The way to the terminal for text that others wrote: what would steer the terminal is shown instead.

A run's log, the name of a dataset or the note of an import may hold escape sequences. These change titles, colours and
clipboards, or hide what was printed. Other signs turn the order of letters around.
"""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import click

from slamhive.base.errors import SlamHiveError, one_line

_STEERING = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # C0 without tab and line feed, DEL and C1
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # the direction of letters
    "\u2028\u2029\ufeff\ufff9-\ufffb\U000e0000-\U000e007f"  # lines and notes that nobody sees
    "\ud800-\udfff]"  # bytes that are not UTF-8, which no terminal can be sent
)
_BREAKING = re.compile("[\t\n]")


def visible(text: str) -> str:
    r"""``text`` with ``\x1b`` for an escape, and so on; tabs and line ends stay."""
    return _STEERING.sub(_shown, text.replace("\r\n", "\n"))


def visible_line(text: str) -> str:
    r"""The same in one line, with ``\n`` and ``\t``."""
    return _BREAKING.sub(_shown, visible(text))


def visible_json(text: str) -> str:
    """JSON with the same meaning, in which escapes of JSON stand for what would steer a terminal."""
    return _STEERING.sub(lambda found: _units(found.group()), text)


def say(text: object = "", *, nl: bool = True, err: bool = False) -> None:
    """Print ``text`` on stdout or stderr, with its lines."""
    click.echo(visible(str(text)), nl=nl, err=err)


def write_out(text: str) -> None:
    """Text in a format that programs read, such as CSV, on stdout: unchanged unless that is a terminal."""
    click.echo(visible(text) if sys.stdout.isatty() else text, nl=False, color=True)


def write_raw(text: str) -> None:
    """Text of others as it is on stdout, because the user asked for it."""
    click.echo(text, nl=False, color=True)


def confirm(question: str, *, default: bool = False) -> None:
    """Ask on stderr; an answer of no ends the command."""
    click.confirm(visible(question), abort=True, default=default, err=True)


class VisibleFormatter(logging.Formatter):
    """Formats log records for a terminal: they tell of files, packages and programs of others."""

    def format(self, record: logging.LogRecord) -> str:
        """The record with its traceback."""
        return visible(super().format(record))


def _shown(found: re.Match[str]) -> str:
    return found.group().encode("unicode_escape").decode("ascii")


def _units(character: str) -> str:
    """A character in the escapes of JSON, which has two for those beyond 16 bits."""
    units = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at] << 8 | units[at + 1]:04x}" for at in range(0, len(units), 2))


# Ends of commands by mistakes of the user: one line on stderr, and an exit code.


MISTAKE = 2
"""The exit code of a mistake where 1 is an answer: worse, or different."""


class Answering(click.Command):
    """A command whose exit code is its answer. A mistake ends it with another one."""

    def make_context(
        self, info_name: str | None, args: list[str], parent: click.Context | None = None, **extra: Any
    ) -> click.Context:
        """Parse the options."""
        with mistakes_end_with(MISTAKE):
            return super().make_context(info_name, args, parent, **extra)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command."""
        with mistakes_end_with(MISTAKE):
            return super().invoke(ctx)


@contextmanager
def mistakes_end_with(code: int) -> Iterator[None]:
    """An explained error in the block ends the command with one line and this exit code."""
    try:
        yield
    except SlamHiveError as error:
        _print_error(str(error), getattr(error, "pointer", ()))
        raise click.exceptions.Exit(code) from None
    except click.UsageError as error:
        path = "slamhive" if error.ctx is None else error.ctx.command_path
        # The right arguments are listed there.
        _print_error(f"{one_line(error.format_message()).rstrip('.')}; see {path} --help")
        raise click.exceptions.Exit(code) from None


def _print_error(text: str, pointer: tuple[str, ...] = ()) -> None:
    """The message on stderr; ``pointer`` are lines above it that show the place in a filter."""
    from slamhive.cli.output import print_error  # noqa: PLC0415 - rich takes a moment, which success need not wait for

    print_error(text, pointer)
