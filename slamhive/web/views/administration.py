"""Pages for admins: the accounts, and the audit log."""

from __future__ import annotations

from flask import Blueprint, current_app, render_template, request

from slamhive.input_bounds import whole_number
from slamhive.web.context import hive

blueprint = Blueprint("administration", __name__)

PAGE_LENGTH = 100
_LARGEST_ID = 2**31 - 1


@blueprint.get("/accounts")
def accounts() -> str:
    """List the accounts and their API tokens."""
    services = hive().accounts
    return render_template("accounts/index.html", accounts=services.list(), tokens=services.tokens())


@blueprint.get("/audit")
def audit() -> str:
    """The audit log, the newest first; ``account`` shows one account, ``before`` continues after a line."""
    name = request.args.get("account", "").strip()[:64]
    before = request.args.get("before", "")
    after_line = whole_number(before, "before", 1, _LARGEST_ID) if before else None
    lines = hive().accounts.audit(PAGE_LENGTH + 1, after_line, name or None)
    return render_template(
        "accounts/audit.html",
        lines=lines[:PAGE_LENGTH],
        more=len(lines) > PAGE_LENGTH,
        account=name,
        before=before,
        in_words=in_words,
    )


def in_words(action: str) -> str:
    """What an action of the audit log does: the first sentence about the view of that name, or its name."""
    about = getattr(current_app.view_functions.get(action), "__doc__", None)
    return action if about is None else about.partition("\n")[0].partition(". ")[0].removesuffix(".")
