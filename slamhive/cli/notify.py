"""``slamhive notify``: tell people when experiments end or fail."""

from __future__ import annotations

import click

from slamhive.base.clock import utc_now
from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.cli.context import CliContext, json_option, pass_cli
from slamhive.cli.output import print_json, tell
from slamhive.documents.experiment import Notice, NoticeEvent


@click.group()
def notify() -> None:
    """Tell people when experiments end or fail. See docs/notifications.md."""


@notify.command("test", short_help="Send a test message by each channel")
@json_option
@pass_cli
def test(cli: CliContext, as_json: bool) -> None:
    """Send a message by each channel of the settings; exit code 1 if one does not arrive."""
    from slamhive.services.notices import channels_of  # noqa: PLC0415 - `--help` need not load it

    channels = channels_of(cli.hive(indexed=False).settings)
    if not channels:
        raise InvalidInput("no channel is set", "set NOTIFY_WEBHOOK, or NOTIFY_MAIL_TO and SMTP_HOST")
    notice = Notice(
        event=NoticeEvent.TEST,
        experiment="",
        words="this is a test, sent by slamhive notify test",
        counts={},
        failures={},
        address=None,
        at=utc_now(),
    )
    problems: dict[str, str | None] = {}
    for channel in channels:
        try:
            channel.send(notice)
        except Unavailable as error:
            problems[channel.name] = str(error)
        else:
            problems[channel.name] = None
    if as_json:
        found = [{"channel": name, "arrived": not problem, "problem": problem} for name, problem in problems.items()]
        print_json(found)
    else:
        for name, problem in problems.items():
            tell(f"{name}: sent" if problem is None else problem)
    if any(problems.values()):
        raise click.exceptions.Exit(1)


COMMANDS = (notify,)
