"""Access control: modes, origins, hosts, headers and keys."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import ExitStack, suppress

from flask import Flask, Response, g, request
from flask.sessions import SecureCookieSessionInterface

from slamhive.base.errors import Forbidden, InvalidInput, Unavailable
from slamhive.base.settings import Mode, Settings
from slamhive.domain.accounts import Viewer
from slamhive.services.accounts import LOOPBACK_HOSTS, accounts_needed
from slamhive.services.hive import Hive
from slamhive.store import Store
from slamhive.web import access, context
from slamhive.web.access import SAFE_METHODS, Callers, action_of, refusal
from slamhive.web.request_input import bound_requests, host_name, origin_host

API_HEADER = "X-SLAM-Hive"
EMPTY_STYLE = "'sha256-47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU='"
"""plotly.js gives colour bars an empty style attribute, which the browser would report as an attack."""

_SOURCES = {
    "default-src": "'none'",
    "script-src": "'self'",
    "style-src": "'self'",
    "style-src-attr": f"'unsafe-hashes' {EMPTY_STYLE}",
    "img-src": "'self' data: blob:",
    "font-src": "'self'",
    "connect-src": "'self'",
    "form-action": "'self'",
    "base-uri": "'none'",
    "frame-ancestors": "'none'",
}
CONTENT_SECURITY_POLICY = "; ".join(f"{directive} {sources}" for directive, sources in _SOURCES.items())
FIGURES_POLICY = CONTENT_SECURITY_POLICY.replace("script-src 'self'", "script-src 'self' 'unsafe-eval'")
"""For pages with WebGL plots: plotly.js compiles shaders from text. Scripts still come from this server only."""
SECURITY_HEADERS = {
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}


class _Sessions(SecureCookieSessionInterface):
    """The cookie of a session that came over https, perhaps through a trusted proxy, is sent over https only."""

    def get_cookie_secure(self, app: Flask) -> bool:  # noqa: ARG002 - the signature of Flask
        return request.is_secure


def protect(app: Flask, hive: Hive, host: str) -> Callers:
    """Install the checks of every request: from where, who, and whether they may. Returns what says who calls.

    Args:
        app: The application, before any blueprint is registered.
        hive: The services.
        host: Address the server binds to.
    """
    settings = hive.settings
    callers = Callers(app, hive, needed=accounts_needed(settings, host))
    # A server for this machine alone has these names: under another one, a page of a stranger has rebound its own. A
    # proxy on this machine passes on the name that people have asked for.
    own_names: set[str | None] | None = None
    if not callers.needed and host in LOOPBACK_HOSTS:
        own_names = {*LOOPBACK_HOSTS, host_name(origin_host(settings.public_url))}
    app.extensions[context.CALLERS_EXTENSION] = callers
    app.session_interface = _Sessions()

    @app.before_request
    def refuse() -> Response | None:
        name = host_name(request.host)
        if name is None or (own_names is not None and name not in own_names):
            raise InvalidInput(
                f"this server does not accept the host {request.headers.get('Host', '')[:80]!r}",
                "open http://127.0.0.1; behind a proxy, set PUBLIC_URL to the address that people open;"
                " or bind the server to a network address with --host",
            )
        g.caller = caller = callers.find()
        g.sight = ExitStack()
        g.sight.enter_context(hive.store.seen_by(callers.viewer(caller), caller.account))
        action = action_of(request.endpoint, request.method)
        refused = refusal(caller, action, view_only=settings.mode is Mode.VIEW_ONLY)
        if request.method not in SAFE_METHODS:
            origin, referrer = request.headers.get("Origin"), request.headers.get("Referer")
            if origin and origin_host(origin) != request.host:
                raise Forbidden(
                    f"pages of {origin[:80]!r} may not change anything here", "use the pages of this server"
                )
            if referrer and origin_host(referrer) is None:
                raise Forbidden(f"the Referer {referrer[:80]!r} is not an address", "use the pages of this server")
        if refused is None and caller.account and request.method not in SAFE_METHODS:
            g.act = ExitStack()
            g.act.enter_context(access.acting(hive.store, caller, settings.new_runs))
        return refused

    @app.teardown_request
    def end_act(_error: BaseException | None) -> None:
        g.pop("act", ExitStack()).close()
        g.pop("sight", ExitStack()).close()

    @app.after_request
    def go_on_seeing(response: Response) -> Response:
        viewer = hive.store.viewer
        if viewer is not None and response.is_streamed and not response.direct_passthrough:
            response.response = _seen_by(hive.store, viewer, response.iter_encoded())
        return response

    bound_requests(app)

    @app.after_request
    def add_headers(response: Response) -> Response:
        for name, value in SECURITY_HEADERS.items():
            response.headers.setdefault(name, value)
        if request.endpoint and not response.cache_control.max_age:
            response.headers.setdefault("Cache-Control", "private, no-cache" if callers.needed else "no-cache")
        return response

    return callers


def _seen_by(store: Store, viewer: Viewer, pieces: Iterator[bytes]) -> Iterator[bytes]:
    """The pieces of an answer that is made after its request has ended, read for the same viewer."""
    try:
        while True:
            with store.seen_by(viewer):
                piece = next(pieces, None)
            if piece is None:
                return
            yield piece
    finally:
        close = getattr(pieces, "close", None)
        if close is not None:
            close()


def require_api_header() -> None:
    """Require our header for API changes: a page of another site cannot set it without a preflight request.

    It cannot set an API token either.
    """
    if request.method not in SAFE_METHODS and API_HEADER not in request.headers and not context.caller().token:
        raise Forbidden(f"changes through the API need the header {API_HEADER}: 1", "see docs/api.md")


def secret_key(settings: Settings) -> str:
    """The key from the settings, or one created once in ``<data>/secret_key`` and readable by its owner only."""
    if settings.secret_key:
        return settings.secret_key
    path = settings.data / "secret_key"
    try:
        stored = path.read_text(encoding="ascii").strip() if path.exists() else ""
        if stored:
            return stored
        path.parent.mkdir(parents=True, exist_ok=True)
        aside = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
        descriptor = os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        try:
            with os.fdopen(descriptor, "w", encoding="ascii") as stream:
                stream.write(secrets.token_hex(32) + "\n")
                stream.flush()
                os.fsync(stream.fileno())
            # Servers that start at the same time all use the first key written: unlike a rename, a link fails if
            # another server was faster.
            with suppress(FileExistsError):
                path.hardlink_to(aside)
        finally:
            aside.unlink(missing_ok=True)
        return path.read_text(encoding="ascii").strip()
    except OSError as error:
        raise Unavailable(
            f"{path} cannot be used: {error.strerror}", "check its permissions, or set SECRET_KEY"
        ) from None
