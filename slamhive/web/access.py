"""Permissions of requests, lines of the audit log, and callers; asked once per request, before any page code runs."""

from __future__ import annotations

import threading
import uuid
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import cast

from cachetools import TTLCache, cached
from flask import Flask, Response, current_app, make_response, redirect, request, session, url_for
from flask_login import LoginManager, UserMixin, current_user, login_user, logout_user

from slamhive.base.bounds import parse_json_object, whole_number
from slamhive.base.clock import monotonic_s, utc_now
from slamhive.base.errors import Forbidden, InvalidInput, SlamHiveError, Unauthenticated
from slamhive.base.settings import Mode, NewRuns
from slamhive.domain.accounts import (
    ANYBODY,
    EVERYTHING,
    NOBODY_MAY,
    VISITOR_MAY,
    WITHOUT_ACCOUNTS,
    Action,
    Caller,
    Role,
    Viewer,
    Visibility,
)
from slamhive.services.accounts import AccountSession
from slamhive.services.hive import Hive
from slamhive.services.stored_analyses import may_analyse
from slamhive.store import AuditAct, Store
from slamhive.store.accounts import in_ranges
from slamhive.web.caching import KEPT_S
from slamhive.web.errors import wants_json

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
LOGIN = "accounts.form"
PLUGIN_PAGES = "slamhive-plugin-pages"
"""Extension of the application: the names of the blueprints of plug-ins."""
LONGEST_NEXT = 2000


@dataclass(frozen=True, slots=True)
class AccessRule:
    """The actions that addresses ask for: ``look`` with GET, ``change`` with POST."""

    look: Action = Action.VIEW
    change: Action = Action.CHANGE


STANDARD = AccessRule()
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
        AccessRule(change=Action.SUBMIT),
    ),
    **dict.fromkeys(
        ("claims", "configurations", "dashboard", "datasets", "experiment_builder", "experiments", "help", "imports"),
        STANDARD,
    ),
    **dict.fromkeys(("finding", "public_datasets", "questions", "run_plots", "runs", "searches"), STANDARD),
    **dict.fromkeys(("scenes", "search_actions", "selected_runs", "start", "trash"), STANDARD),
    "analyses.create": AccessRule(change=Action.ANALYSE),
    "analyses.check": AccessRule(change=Action.ANALYSE),
    "trash.empty": AccessRule(change=Action.ADMINISTER),
    "api.import_algorithm": AccessRule(change=Action.ADMINISTER),
    "api.empty_trash": AccessRule(change=Action.ADMINISTER),
    **dict.fromkeys(("nodes", "api.drain_node", "api.undrain_node"), AccessRule(change=Action.ADMINISTER)),
    "accounts": AccessRule(Action.OWN, Action.OWN),
    LOGIN: AccessRule(look=Action.SIGN_IN),
    **dict.fromkeys(("accounts.to_provider", "accounts.from_provider"), AccessRule(look=Action.SIGN_IN)),
    "accounts.sign_in": AccessRule(change=Action.SIGN_IN),
    **dict.fromkeys(("administration", "server_imports"), AccessRule(Action.ADMINISTER, Action.ADMINISTER)),
}
"""By endpoint, or by blueprint for those of its endpoints that are not listed."""
CLOSED = AccessRule(Action.ADMINISTER, Action.ADMINISTER)
"""For addresses that somebody forgot to list."""


def action_of(endpoint: str | None, method: str) -> Action | None:
    """The action that a request asks for; None if everybody may. An unknown address is treated like a page."""
    if endpoint in OPEN:
        return None
    rule = STANDARD if endpoint is None else _rule(endpoint)
    return rule.look if method in SAFE_METHODS else rule.change


def _rule(endpoint: str) -> AccessRule:
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
        raise Unauthenticated("sign-in required", remedy)
    return make_response(redirect(url_for(LOGIN, next=_here()), 302))


def _here() -> str | None:
    """The address that was asked for; None for the first page, and for one too long to come back to."""
    here = request.full_path.removesuffix("?")
    return None if here == "/" or len(here) > LONGEST_NEXT else here


# -- lines of the audit log, about requests that change something ------------------------------------------------------

PAGES = "pages"
_LARGEST = 2**53 - 1
_MOST_NUMBERS = 1000
_NAMED = ("name", "group", "title", "executor", "node", "path", "visibility", "search")
"""Fields of web forms that say on what something is done."""


def acting(store: Store, caller: Caller, new_runs: NewRuns) -> AbstractContextManager[None]:
    """Let what this thread stores be done by the caller of this request, and belong to them."""
    # Values of the address, and selected runs and names of the web form. Never what could be a secret.
    values = request.view_args or {}
    parts = [f"{name.removesuffix('_id')} {value}" for name, value in values.items()]
    parts += [f"{name} {request.form[name]}" for name in _NAMED if request.form.get(name)]
    return store.acting(_act(caller, "; ".join([*parts, *_selected()])), Visibility(new_runs))


def signing_in(store: Store, name: str) -> AbstractContextManager[None]:
    """Let this thread store the session of ``name``. Nothing is stored of somebody who is not let in."""
    return store.acting(_act(Caller(frozenset(), name[:64]), ""))


def _act(caller: Caller, subject: str) -> AuditAct:
    return AuditAct(
        uid=uuid.uuid4().hex,
        at=utc_now(),
        account=caller.account,
        via=f"token {caller.token}" if caller.token else PAGES,
        address=(request.remote_addr or "")[:64],
        action=str(request.endpoint)[:64],
        subject=subject,
    )


def _selected() -> list[str]:
    """The runs that the web form or the JSON of the request names."""
    try:
        body = parse_json_object(request.get_data(), "the body") if request.is_json else {}
        sent = request.form.getlist("run")[:_MOST_NUMBERS]
        runs = {whole_number(text, "run", 1, _LARGEST) for text in sent}
    except InvalidInput:  # the view says so
        return []
    if isinstance(body.get("runs"), list):
        runs = {run for run in body["runs"][:_MOST_NUMBERS] if type(run) is int}
    visibility = [f"visibility {body['visibility']}"] if body.get("visibility") in list(Visibility) else []
    found = [f"search {body['where']}"] if isinstance(body.get("where"), str) else []
    return [*visibility, *found, *([in_ranges(sorted(runs))] if runs else [])]


# -- callers: the one place that says who sends a request, for pages and for the web API -------------------------------

NOBODY = Caller(NOBODY_MAY)
_LOCAL = Caller(EVERYTHING)
_BEARER = "bearer "
_SESSION = "_user_id"


class _SignedIn(UserMixin):  # type: ignore[misc]
    """The content of the session's cookie, kept by Flask-Login: the secret of a session, and nothing else."""

    def __init__(self, secret: str, caller: Caller) -> None:
        self.id = secret
        self.caller = caller


class _Manager(LoginManager):  # type: ignore[misc]
    """Flask-Login without its cookies that outlive a session: none is ever made, so none is read."""

    def _load_user_from_remember_cookie(self, _cookie: str) -> None:
        return None


class Callers:
    """Says who calls.

    Args:
        app: The application, before any blueprint is registered.
        hive: The services.
        needed: Whether callers have to sign in.
    """

    def __init__(self, app: Flask, hive: Hive, *, needed: bool) -> None:
        self._hive = hive
        self.needed = needed
        # Asked with each request, also for pages that are kept: the answer may be as old as they are.
        self._accounts_in_use = cached(TTLCache(1, KEPT_S, monotonic_s), lock=threading.Lock())(hive.accounts.in_use)
        self.unknown = NOBODY if needed else _LOCAL
        """Whom pages are shown to that refuse a request before its caller is looked for."""
        if needed:
            manager = _Manager(app, add_context_processor=False)
            manager.session_protection = None  # sessions can be ended; addresses of laptops change
            manager.user_loader(self._load)

    def find(self) -> Caller:
        """The caller of this request; raises Unauthenticated for an API token that is not valid."""
        settings = self._hive.settings
        if settings.mode is Mode.VIEW_ONLY:
            return Caller(VISITOR_MAY | {Action.ANALYSE} if may_analyse(settings) else VISITOR_MAY)
        if not self.needed:
            return _LOCAL
        token = _bearer()
        if token is not None:
            return self._hive.accounts.by_token(token)
        return cast("Caller", current_user.caller) if current_user.is_authenticated else NOBODY

    def viewer(self, caller: Caller) -> Viewer | None:
        """The viewer that ``caller`` is for runs, experiments and analyses; None sees everything.

        Visitors of a view-only server see what is public; without accounts, all that is not private.
        """
        if self.needed:
            return None if caller.role is Role.ADMIN else Viewer(caller.account, signed_in=caller.role is not None)
        if self._hive.settings.mode is not Mode.VIEW_ONLY:
            return None
        return ANYBODY if self._accounts_in_use() else WITHOUT_ACCOUNTS

    def watch(self) -> Callable[[], bool]:
        """A function that says, also after this request, whether its caller would still be let in."""
        if not self.needed:
            return lambda: True
        accounts, token, secret = self._hive.accounts, _bearer(), session.get(_SESSION, "")

        def still() -> bool:
            try:
                return accounts.by_token(token) is not None if token else accounts.by_session(secret) is not None
            except SlamHiveError:  # an invalid token, or no database
                return False

        return still

    def begin(self, opened: AccountSession) -> None:
        """Put a new session into the cookie. End the one that was in it, and forget the rest: it may be of others."""
        if _SESSION in session:
            self._hive.accounts.sign_out(session[_SESSION])
        session.clear()
        login_user(_SignedIn(opened.secret, opened.caller))

    def end(self) -> None:
        """End the session of this request."""
        self._hive.accounts.sign_out(session.get(_SESSION, ""))
        logout_user()
        session.clear()

    def _load(self, secret: str) -> _SignedIn | None:
        caller = self._hive.accounts.by_session(secret)
        return None if caller is None else _SignedIn(secret, caller)


def _bearer() -> str | None:
    """The API token of this request. Other kinds of authorization belong to a proxy in front of the server."""
    header = request.headers.get("Authorization", "")
    return header[len(_BEARER) :].strip() if header[: len(_BEARER)].lower() == _BEARER else None
