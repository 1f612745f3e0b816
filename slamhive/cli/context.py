"""State and options that commands share: the installation, opened on first use."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import click

from slamhive.base.errors import InvalidInput, NotFound

if TYPE_CHECKING:
    from slamhive.services.hive import Hive


class CliContext:
    """The options of the root command, and the installation they select."""

    def __init__(self, options: dict[str, Any]) -> None:
        self._options = options
        self._hive: Hive | None = None
        self._opened = ExitStack()

    @property
    def options(self) -> dict[str, Any]:
        """Settings given as options."""
        return dict(self._options)

    def hive(self, *, indexed: bool = True) -> Hive:
        """The installation. ``indexed`` refuses one whose database lacks its runs."""
        # Importing the services takes half a second, which `--help` and `--version` need not wait for.
        from slamhive.cli.acting import LISTS, command_name, expected_of  # noqa: PLC0415
        from slamhive.services.data_root import DataRoot  # noqa: PLC0415
        from slamhive.services.hive import check_indexed, open_hive  # noqa: PLC0415

        if self._hive is None:
            context = click.get_current_context()
            expected = expected_of(context)
            self._hive = open_hive(self._options, expected)
            self._opened.callback(self._hive.close)
            if expected is DataRoot.MADE:
                from slamhive.base.project import about_data_root  # noqa: PLC0415
                from slamhive.cli.output import tell  # noqa: PLC0415 - `--help` prints without rich

                # Nothing to say if the user chose the place or can see it in the checkout.
                remark = about_data_root(self._hive.project_root, self._hive.settings.data)
                if remark:
                    tell(f"data root {self._hive.settings.data} ({remark})")
            if command_name(context) in LISTS:
                self._opened.enter_context(self._hive.store.snapshot())
        if indexed:
            check_indexed(self._hive)
        return self._hive

    def options_with(self, **more: Any) -> None:
        """Add options of a subcommand before the installation is opened."""
        self._options.update(more)

    def close(self) -> None:
        """Close what was opened."""
        self._opened.close()


def choice(kind: type[StrEnum]) -> click.Choice[str]:
    """The values of an enumeration as a choice (click itself would offer the names)."""
    return click.Choice([member.value for member in kind])


def run_number(text: str) -> int:
    """The number of a run, as the type of an argument. A number too large for a database is an unknown run."""
    try:
        number = int(text)
    except ValueError:
        raise click.BadParameter(f"{text!r} is not a valid integer.") from None
    if abs(number) >= 2**63:
        raise NotFound(f"unknown run {number}")
    return number


def _read_meanings(_context: click.Context, _parameter: click.Parameter, texts: tuple[str, ...]) -> dict[str, str]:
    from slamhive.packages.published.knowledge import HERE  # noqa: PLC0415 - few commands have the option

    found: dict[str, str] = {}
    for text in texts:
        old, sign, new = (HERE, "=", HERE) if text == HERE else (part.strip() for part in text.partition("="))
        if not (old and sign and new):
            raise InvalidInput(f"--id {text!r} is not OLD=NEW", "write for instance --id 3=orb-slam2-mono")
        if found.setdefault(old, new) != new:
            raise InvalidInput(f"--id {old} is given as {found[old]} and as {new}", "give it once")
    return found


pass_cli: Callable[..., Any] = click.make_pass_decorator(CliContext)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
id_option: Callable[..., Any] = click.option(
    "--id",
    "ids",
    metavar="OLD=NEW",
    multiple=True,
    callback=_read_meanings,
    help="What a number or a name in a file of the published SLAM Hive means here, for instance 3=orb-slam2-mono; "
    "'here': its numbers are those of this installation. Can be given several times.",
)
