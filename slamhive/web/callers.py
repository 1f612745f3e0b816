"""Who sends a request: the one place that says it, for pages and for the web API."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import cast

from cachetools import TTLCache, cached
from flask import Flask, request, session
from flask_login import LoginManager, UserMixin, current_user, login_user, logout_user

from slamhive.clock import monotonic_s
from slamhive.domain.accounts import EVERYTHING, NOBODY_MAY, VISITOR_MAY, Action, Caller, Role
from slamhive.domain.visibility import ANYBODY, Viewer
from slamhive.errors import SlamHiveError
from slamhive.services.accounts import Session
from slamhive.services.analyses import may_analyse
from slamhive.services.hive import Hive
from slamhive.settings import Mode
from slamhive.web.caching import KEPT_S

NOBODY = Caller(NOBODY_MAY)
_LOCAL = Caller(EVERYTHING)
_BEARER = "bearer "
_SESSION = "_user_id"


class _SignedIn(UserMixin):  # type: ignore[misc]
    """What Flask-Login keeps in the cookie of the session: the secret of :class:`Session`, and nothing else."""

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
        """What ``caller`` may see of runs, experiments and analyses; None for everything.

        Visitors of a view-only server see what is public, if the installation has accounts.
        """
        if self.needed:
            return None if caller.role is Role.ADMIN else Viewer(caller.account, signed_in=caller.role is not None)
        return ANYBODY if self._hive.settings.mode is Mode.VIEW_ONLY and self._accounts_in_use() else None

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

    def begin(self, opened: Session) -> None:
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
