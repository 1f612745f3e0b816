"""Ends of commands by mistakes of the user: one line on stderr, and an exit code."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import click

from slamhive.errors import SlamHiveError, one_line

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
        _print_error(_usage(error))
        raise click.exceptions.Exit(code) from None


def _print_error(text: str, pointer: tuple[str, ...] = ()) -> None:
    """The message on stderr; ``pointer`` are lines above it that show the place in a filter."""
    from slamhive.cli.output import print_error  # noqa: PLC0415 - rich takes a moment, which success need not wait for

    print_error(text, pointer)


def _usage(error: click.UsageError) -> str:
    """One line: what is wrong with the arguments, and where the right ones are listed."""
    path = "slamhive" if error.ctx is None else error.ctx.command_path
    return f"{one_line(error.format_message()).rstrip('.')}; see {path} --help"
