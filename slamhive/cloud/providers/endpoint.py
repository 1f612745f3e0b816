"""Another server that speaks a provider's API."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self
from urllib.parse import urlsplit

from slamhive.errors import InvalidInput


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Where an API answers."""

    host: str
    port: int
    secure: bool

    @classmethod
    def of(cls, url: str) -> Self | None:
        """The endpoint that the setting CLOUD_ENDPOINT names; None if it is empty. Raises InvalidInput."""
        if not url:
            return None
        try:
            parts = urlsplit(url)
            host, port, secure = parts.hostname, parts.port, parts.scheme == "https"
        except ValueError:
            host, port, secure = None, None, False
        if host is None or parts.scheme not in ("http", "https") or parts.path.strip("/") or parts.query:
            raise InvalidInput(f"CLOUD_ENDPOINT={url!r} is no address", "write it as https://HOST:PORT")
        return cls(host, port or (443 if secure else 80), secure)

    @property
    def arguments(self) -> dict[str, Any]:
        """What a driver of Libcloud takes."""
        return {"host": self.host, "port": self.port, "secure": self.secure}
