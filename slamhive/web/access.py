"""Who may ask for what: one table of kinds of requests, asked once for each request before any page code runs."""

from __future__ import annotations

from dataclasses import dataclass

from flask import Response, current_app, make_response, redirect, request, url_for

from slamhive.domain.accounts import Action, Caller
from slamhive.errors import Forbidden, Unauthenticated
from slamhive.web.errors import wants_json

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
LOGIN = "accounts.form"
PLUGIN_PAGES = "slamhive-plugin-pages"
"""Extension of the application: the names of the blueprints of plug-ins."""
LONGEST_NEXT = 2000


@dataclass(frozen=True, slots=True)
class Rule:
    """What addresses ask for: ``look`` with GET, ``change`` with POST."""

    look: Action = Action.VIEW
    change: Action = Action.CHANGE


STANDARD = Rule()
OPEN = frozenset({"static", "bootstrap.static", "assets.plotly_js", "dashboard.health"})
"""Endpoints for everybody: styles and scripts, which the page to sign in needs, and the health check."""
RULES = {
    **dict.fromkeys(("algorithms", "analyses", "api", "api_docs", "compare"), STANDARD),
    **dict.fromkeys(
        (
            "challenges",
            "api.submit_to_challenge",
            "api.submit_image_to_challenge",
            "api.cancel_challenge_submission",
            "api.create_upload",
            "api.send_part",
            "api.delete_upload",
        ),
        Rule(change=Action.SUBMIT),
    ),
    **dict.fromkeys(("configurations", "dashboard", "datasets", "experiment_builder", "experiments", "help"), STANDARD),
    **dict.fromkeys(("finding", "public_datasets", "run_plots", "runs", "searches"), STANDARD),
    **dict.fromkeys(("scenes", "search_actions", "selected_runs", "start", "trash"), STANDARD),
    "analyses.create": Rule(change=Action.ANALYSE),
    "analyses.check": Rule(change=Action.ANALYSE),
    "trash.empty": Rule(change=Action.ADMINISTER),
    "api.import_algorithm": Rule(change=Action.ADMINISTER),
    "api.empty_trash": Rule(change=Action.ADMINISTER),
    **dict.fromkeys(("nodes", "api.drain_node", "api.undrain_node"), Rule(change=Action.ADMINISTER)),
    "accounts": Rule(Action.OWN, Action.OWN),
    LOGIN: Rule(look=Action.SIGN_IN),
    **dict.fromkeys(("accounts.to_provider", "accounts.from_provider"), Rule(look=Action.SIGN_IN)),
    "accounts.sign_in": Rule(change=Action.SIGN_IN),
    "administration": Rule(Action.ADMINISTER, Action.ADMINISTER),
}
"""By endpoint, or by blueprint for those of its endpoints that are not listed."""
CLOSED = Rule(Action.ADMINISTER, Action.ADMINISTER)
"""For addresses that somebody forgot to list."""


def action_of(endpoint: str | None, method: str) -> Action | None:
    """What a request asks for; None if everybody may. An unknown address is treated like a page."""
    if endpoint in OPEN:
        return None
    rule = STANDARD if endpoint is None else _rule(endpoint)
    return rule.look if method in SAFE_METHODS else rule.change


def _rule(endpoint: str) -> Rule:
    blueprint = endpoint.rpartition(".")[0]
    of_plugin = STANDARD if blueprint in current_app.extensions.get(PLUGIN_PAGES, ()) else CLOSED
    return RULES.get(endpoint) or RULES.get(blueprint) or of_plugin


def refusal(caller: Caller, action: Action | None, *, view_only: bool) -> Response | None:
    """None if ``caller`` may do it. Otherwise the way to the page to sign in; raises Forbidden or Unauthenticated."""
    if action is None or action in caller.may:
        return None
    if view_only:
        raise Forbidden(
            "this server is view-only: it cannot start, cancel or evaluate anything",
            "use a server whose MODE is workstation",
        )
    if caller.token:
        raise Forbidden(f"the API token {caller.token!r} does not allow this: {action}", "use one with more scopes")
    if caller.role is not None:
        raise Forbidden(f"your role, {caller.role}, does not allow this: {action}", "ask an admin of this server")
    if request.method != "GET" or wants_json() or request.headers.get("Sec-Fetch-Mode", "navigate") != "navigate":
        remedy = f"sign in at {url_for(LOGIN)}, or send an API token"
        raise Unauthenticated("this server needs to know who you are", remedy)
    return make_response(redirect(url_for(LOGIN, next=_here()), 302))


def _here() -> str | None:
    """The address that was asked for; None for the first page, and for one too long to come back to."""
    here = request.full_path.removesuffix("?")
    return None if here == "/" or len(here) > LONGEST_NEXT else here
