"""Who may do what: one place for modes, origins, hosts, headers and keys."""

from __future__ import annotations

import os
import secrets
from contextlib import suppress
from pathlib import Path

from flask import Flask, Response, request

from slamhive.errors import Forbidden, InvalidInput, Unavailable
from slamhive.services.analyses import may_analyse
from slamhive.settings import Mode, Settings
from slamhive.web.request_input import bound_requests, host_name, origin_host

VISITOR_ENDPOINTS = frozenset({"analyses.create", "analyses.check"})
"""What view-only mode lets visitors do, unless NO_NEW_ANALYSIS is set: an analysis of their own, not listed."""
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
API_HEADER = "X-SLAM-Hive"
LOOPBACK_HOSTS = frozenset({"127.0.0.1", "localhost", "::1"})

_SOURCES = {
    "default-src": "'none'",
    "script-src": "'self'",
    "style-src": "'self'",
    "img-src": "'self' data: blob:",
    "font-src": "'self'",
    "connect-src": "'self'",
    "form-action": "'self'",
    "base-uri": "'none'",
    "frame-ancestors": "'none'",
}
CONTENT_SECURITY_POLICY = "; ".join(f"{directive} {sources}" for directive, sources in _SOURCES.items())
FIGURES_POLICY = CONTENT_SECURITY_POLICY.replace("script-src 'self'", "script-src 'self' 'unsafe-eval'")
"""For pages with figures drawn by WebGL, whose functions plotly.js makes out of text. Scripts are still ours alone."""
SECURITY_HEADERS = {
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}


def protect(app: Flask, settings: Settings, host: str) -> None:
    """Install the checks that every request goes through, whatever its view does.

    Args:
        app: The application, before any blueprint is registered.
        settings: The mode in force.
        host: Address the server binds to.
    """

    @app.before_request
    def refuse() -> None:
        _refuse_foreign_host(host)
        if request.method not in SAFE_METHODS:
            _refuse_change_where_only_viewing(settings)
            _refuse_foreign_origin()

    bound_requests(app)

    @app.after_request
    def add_headers(response: Response) -> Response:
        for name, value in SECURITY_HEADERS.items():
            response.headers.setdefault(name, value)
        if request.endpoint and not response.cache_control.max_age:
            response.headers.setdefault("Cache-Control", "no-cache")
        return response


def _refuse_foreign_host(host: str) -> None:
    """A page that rebinds its own name to 127.0.0.1 is turned away; bound to the network, any name may be ours."""
    name = host_name(request.host)
    if name is None or (host in LOOPBACK_HOSTS and name not in LOOPBACK_HOSTS):
        raise InvalidInput(
            f"this server does not answer to {request.headers.get('Host', '')[:80]!r}",
            "open it as http://127.0.0.1, or bind it to an address of the network with --host",
        )


def _refuse_change_where_only_viewing(settings: Settings) -> None:
    if not _may_change(settings, request.endpoint):
        raise Forbidden(
            "this installation only shows results: nothing can be started, cancelled or evaluated here",
            "MODE = view-only is set; use an installation in workstation mode",
        )


def _refuse_foreign_origin() -> None:
    origin, referrer = request.headers.get("Origin"), request.headers.get("Referer")
    if origin and origin_host(origin) != request.host:
        raise Forbidden(f"a page of {origin[:80]!r} may not change anything here", "use the pages of this server")
    if referrer and origin_host(referrer) is None:
        raise Forbidden(f"the Referer {referrer[:80]!r} is no address of a page", "use the pages of this server")


def _may_change(settings: Settings, endpoint: str | None) -> bool:
    """Whether this mode takes changes at ``endpoint``."""
    return settings.mode is not Mode.VIEW_ONLY or (endpoint in VISITOR_ENDPOINTS and may_analyse(settings))


def require_api_header() -> None:
    """Refuse an API change without our header: a page of another site cannot set it without being asked about first."""
    if request.method not in SAFE_METHODS and API_HEADER not in request.headers:
        raise Forbidden(f"changes through the API need the header {API_HEADER}: 1", "see docs/web.md")


def secret_key(settings: Settings) -> str:
    """The key from the settings, or one made once and kept in ``<data>/secret_key``, readable by the owner alone."""
    if settings.secret_key:
        return settings.secret_key
    path = settings.data / "secret_key"
    try:
        return _read_key(path) or _make_key(path)
    except OSError as error:
        raise Unavailable(f"{path} cannot be used: {error.strerror}", "check rights, or set SECRET_KEY") from None


def _read_key(path: Path) -> str | None:
    try:
        return path.read_text(encoding="ascii").strip() or None
    except FileNotFoundError:
        return None


def _make_key(path: Path) -> str:
    """Make the key; of several servers starting at once, all use the one that was there first."""
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    descriptor = os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    try:
        with os.fdopen(descriptor, "w", encoding="ascii") as stream:
            stream.write(secrets.token_hex(32) + "\n")
            stream.flush()
            os.fsync(stream.fileno())
        with suppress(FileExistsError):
            path.hardlink_to(aside)
    finally:
        aside.unlink(missing_ok=True)
    return path.read_text(encoding="ascii").strip()
