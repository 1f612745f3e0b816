"""Signing in and out, and one's own account: password and API tokens."""

from __future__ import annotations

import secrets
from urllib.parse import urlsplit

from flask import Blueprint, Response, current_app, flash, make_response, redirect, render_template, request, session
from flask import url_for as address

from slamhive.base.bounds import whole_number
from slamhive.base.errors import (
    Conflict,
    InvalidInput,
    NotFound,
    SlamHiveError,
    TooManyRequests,
    Unauthenticated,
    unknown,
)
from slamhive.base.settings import NewAccounts
from slamhive.domain.accounts import Action, Role, Scope
from slamhive.services.accounts import LONGEST_TOKEN_DAYS, TokenRequest
from slamhive.web import access
from slamhive.web.access import LONGEST_NEXT
from slamhive.web.context import caller, callers, hive, provider, sign_in_limits
from slamhive.web.errors import status_of
from slamhive.web.oidc import IdentityProvider

blueprint = Blueprint("accounts", __name__)

TOKEN_DAYS = (7, 30, 90, LONGEST_TOKEN_DAYS)
_NEXT = "next"


@blueprint.get("/login")
def form() -> Response:
    """The page to sign in."""
    if caller().account:
        return _to_next(request.args.get(_NEXT, ""))
    return _login(request.args.get(_NEXT, ""))


@blueprint.post("/login")
def sign_in() -> Response:
    """Sign in. Goes on to the page that was asked for."""
    name, services = request.form.get("name", "").strip(), hive()
    try:
        with sign_in_limits().attempt(name, request.remote_addr or ""), access.signing_in(services.store, name):
            opened = services.accounts.sign_in(name, request.form.get("password", ""))
    except (Unauthenticated, TooManyRequests) as error:
        return make_response(_login(request.form.get(_NEXT, ""), error), status_of(error))
    callers().begin(opened)
    return _to_next(request.form.get(_NEXT, ""))


@blueprint.get("/login/provider")
def to_provider() -> Response:
    """Go to the provider of OpenID Connect, which asks who somebody is and sends them back."""
    session[_NEXT] = request.args.get(_NEXT, "")[:LONGEST_NEXT]
    return _provider().go(address("accounts.from_provider", _external=True))


@blueprint.get("/login/provider/back")
def from_provider() -> Response:
    """Sign in whom the provider vouches for. Goes on to the page that was asked for."""
    services, following = hive(), session.get(_NEXT, "")
    try:
        identity = _provider().returned()
        chosen = services.settings.oidc_new_accounts
        role = None if chosen is NewAccounts.NONE else Role(chosen.value)
        with access.signing_in(services.store, identity.name or identity.subject):
            opened = services.accounts.sign_in_as(identity, role)
    except SlamHiveError as error:
        return make_response(_login(following, error), status_of(error))
    callers().begin(opened)
    return _to_next(following)


@blueprint.post("/logout")
def sign_out() -> Response:
    """Sign out. The session ends wherever its cookie may be."""
    callers().end()
    return make_response(redirect(address("accounts.form"), 303))


@blueprint.get("/account")
def show() -> Response:
    """One's own account."""
    return _account()


@blueprint.post("/account/password")
def change_password() -> Response:
    """Replace one's own password. All other sessions end."""
    services, name, form_ = hive(), caller().account, request.form
    try:
        if form_.get("new", "") != form_.get("again", ""):
            raise InvalidInput("the two new passwords differ", "type the same twice")
        with sign_in_limits().attempt(name, request.remote_addr or ""):
            services.accounts.check_own_password(name, form_.get("old", ""))
        services.accounts.set_password(name, form_.get("new", ""))
    except SlamHiveError as error:
        return make_response(_account(error), 400 if isinstance(error, Unauthenticated) else status_of(error))
    callers().begin(services.accounts.sign_in(name, form_.get("new", "")))
    flash("The password is changed. Other sessions of this account have ended.", "success")
    return _to_account()


@blueprint.post("/account/tokens")
def create_token() -> Response:
    """Make an API token. The page shows its text once."""
    form_ = request.form
    try:
        scopes = [Scope(text) for text in form_.getlist("scope") if text in list(Scope)]
        days = whole_number(form_.get("days", ""), "days", 1, LONGEST_TOKEN_DAYS)
        wanted = TokenRequest(form_.get("name", "").strip(), scopes, days)
        _, text = hive().accounts.create_token(caller().account, wanted)
    except SlamHiveError as error:
        return make_response(_account(error), status_of(error))
    response = _account(text=text)
    response.headers["Cache-Control"] = "no-store"
    return response


@blueprint.post("/account/tokens/<int(max=2147483647):token_id>/revoke")
def revoke_token(token_id: int) -> Response:
    """End one of one's own API tokens."""
    revoked = hive().accounts.revoke(token_id, caller().account)
    flash(f"Token {revoked.name} is revoked.", "info")
    return _to_account()


def _provider() -> IdentityProvider:
    """The provider of the settings; raises NotFound if there is none."""
    found = provider()
    if found is None:
        raise NotFound("no OpenID Connect provider is configured", "sign in with name and password")
    return found


def _login(following: str, error: SlamHiveError | None = None) -> Response:
    return make_response(
        render_template(
            "accounts/login.html",
            following=following,
            error=error,
            name=request.form.get("name", "")[:64],
            nobody=not hive().accounts.exist(),
            provider=hive().settings.oidc_title if provider() is not None else "",
        )
    )


def _account(error: SlamHiveError | None = None, text: str = "") -> Response:
    services, name = hive(), caller().account
    scopes = [Scope.READ]
    if Action.CHANGE in caller().may:
        scopes.append(Scope.CHANGE)
    if Action.ADMINISTER in caller().may:
        scopes.append(Scope.ADMINISTER)
    return make_response(
        render_template(
            "accounts/account.html",
            account=services.accounts.named(name),
            tokens=services.accounts.tokens(name),
            scopes=scopes,
            token_days=TOKEN_DAYS,
            error=error,
            text=text,
        )
    )


def _to_account() -> Response:
    return make_response(redirect(address("accounts.show"), 303))


def _to_next(target: str) -> Response:
    return make_response(redirect(target if is_own_address(target) else address("dashboard.index"), 303))


def is_own_address(target: str) -> bool:
    """Tell if ``target`` is a path of this server: browsers take two slashes, either way round, for another one."""
    if not target.startswith("/") or target.startswith(("//", "/\\")) or len(target) > LONGEST_NEXT:
        return False
    try:
        parts = urlsplit(target)
    except ValueError:
        return False
    return not parts.scheme and not parts.netloc and "\\" not in target and target.isprintable()


# -- pages for admins: the accounts, and the audit log -----------------------------------------------------------------

administration_blueprint = Blueprint("administration", __name__)

PAGE_LENGTH = 100
_LARGEST_ID = 2**31 - 1


@administration_blueprint.get("/accounts")
def accounts() -> Response:
    """List the accounts and their API tokens."""
    return _accounts()


@administration_blueprint.post("/accounts")
def add_account() -> Response:
    """Add an account. The page shows its password once."""
    try:
        role = _role()
        password = new_password()
        added = hive().accounts.add(request.form.get("name", "").strip(), role, password)
    except SlamHiveError as error:
        return make_response(_accounts(error), status_of(error))
    return _accounts(secret_of=added.name, secret=password)


@administration_blueprint.post("/accounts/<name>/role")
def change_role(name: str) -> Response:
    """Give an account another role."""
    _refuse_own(name)
    changed = hive().accounts.set_role(name, _role())
    flash(f"{changed.name} is {changed.role.value} now.", "success")
    return _to_accounts()


@administration_blueprint.post("/accounts/<name>/password")
def replace_password(name: str) -> Response:
    """Replace the password of an account. The page shows it once; the sessions of the account end."""
    _refuse_own(name)
    password = new_password()
    changed = hive().accounts.set_password(name, password)
    return _accounts(secret_of=changed.name, secret=password)


@administration_blueprint.post("/accounts/<name>/disable")
def disable_account(name: str) -> Response:
    """Disable an account: its sessions end, and its tokens are refused."""
    _refuse_own(name)
    hive().accounts.disable(name)
    flash(f"{name} is disabled.", "info")
    return _to_accounts()


@administration_blueprint.post("/accounts/<name>/enable")
def enable_account(name: str) -> Response:
    """Let an account be used again."""
    hive().accounts.enable(name)
    flash(f"{name} is enabled.", "success")
    return _to_accounts()


@administration_blueprint.post("/accounts/tokens/<int(max=2147483647):token_id>/revoke")
def revoke_any_token(token_id: int) -> Response:
    """End an API token of any account."""
    revoked = hive().accounts.revoke(token_id)
    flash(f"Token {revoked.name} is revoked.", "info")
    return _to_accounts()


def new_password() -> str:
    """Make a password that nobody has chosen, with 120 random bits."""
    return secrets.token_urlsafe(15)


def _accounts(error: SlamHiveError | None = None, secret_of: str = "", secret: str = "") -> Response:
    services = hive().accounts
    response = make_response(
        render_template(
            "accounts/index.html",
            accounts=services.list(),
            tokens=services.tokens(),
            roles=list(Role),
            error=error,
            secret_of=secret_of,
            secret=secret,
        )
    )
    if secret:
        response.headers["Cache-Control"] = "no-store"
    return response


def _role() -> Role:
    text = request.form.get("role", "")
    if text not in list(Role):
        raise unknown("role", text, list(Role))
    return Role(text)


def _refuse_own(name: str) -> None:
    """Raise Conflict for one's own account: the last admin could lock everybody out."""
    if name == caller().account:
        raise Conflict("your own account cannot be changed here", "ask another admin, or use slamhive account")


def _to_accounts() -> Response:
    return make_response(redirect(address("administration.accounts"), 303))


@administration_blueprint.get("/audit")
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
    """An action of the audit log in words: the first sentence about the view of that name, or its name."""
    about = getattr(current_app.view_functions.get(action), "__doc__", None)
    return action if about is None else about.partition("\n")[0].partition(". ")[0].removesuffix(".")
