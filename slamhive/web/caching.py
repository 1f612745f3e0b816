"""What browsers may keep: pages as long as they are the same, assets whose address changes with them for a year."""

from __future__ import annotations

from flask import Flask, Response, request

YEAR_S = 365 * 86_400
_ASSETS = "static"


def add_caching(app: Flask) -> None:
    """Answers get an ETag, and 304 where the browser has them; register before the security headers."""

    @app.after_request
    def mark(response: Response) -> Response:
        if request.endpoint == _ASSETS and "v" in request.args and response.status_code == 200:
            response.cache_control.no_cache = None
            response.cache_control.max_age = YEAR_S
            response.cache_control.immutable = True
            response.cache_control.public = True
            return response
        plain = response.status_code == 200 and not response.is_streamed and not response.direct_passthrough
        if request.method in ("GET", "HEAD") and plain and "no-store" not in response.headers.get("Cache-Control", ""):
            if response.get_etag()[0] is None:
                response.add_etag(weak=True)
            response.make_conditional(request)
        return response
