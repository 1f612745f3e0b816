"""Where the controller serves nodes, from the settings."""

from __future__ import annotations

from urllib.parse import urlsplit

from slamhive.errors import InvalidInput
from slamhive.executors.base import NodeAccess
from slamhive.settings import Settings

_ALL_ADDRESSES = ("0.0.0.0", "::")  # noqa: S104 - compared, not bound to


def node_access(settings: Settings) -> NodeAccess | None:
    """Return the way of data to nodes; None if they see the data root. Raises InvalidInput."""
    if settings.shared_storage:
        return None
    return NodeAccess(_url(settings), settings.node_cache, settings.node_cache_bytes)


def listening_address(settings: Settings) -> tuple[str, int] | None:
    """Host and port at which nodes are served; None if they are not. Raises InvalidInput."""
    if not settings.node_address:
        return None
    try:
        parts = urlsplit(f"//{settings.node_address}")
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if host is None or port is None or parts.path or parts.username is not None:
        raise InvalidInput(f"NODE_ADDRESS={settings.node_address!r} is no HOST:PORT", "write it as 10.0.0.1:5001")
    return host, port


def _url(settings: Settings) -> str:
    address = listening_address(settings)
    if settings.node_url:
        if urlsplit(settings.node_url).scheme not in ("http", "https"):
            raise InvalidInput(f"NODE_URL={settings.node_url!r} is no address", "write it as http://10.0.0.1:5001")
        return settings.node_url
    if address is not None and address[0] in _ALL_ADDRESSES:
        raise InvalidInput(
            f"nodes cannot reach NODE_ADDRESS={settings.node_address}", "set NODE_URL to an address that they reach"
        )
    return "" if address is None else f"http://{settings.node_address}"
