"""Requests over HTTP: a few redirects, time limits, no token for a strange host; every failure has a kind.

Proxies come from the environment, as requests reads it. Bodies are never decoded: the bytes that are stored count.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC
from email.utils import parsedate_to_datetime
from typing import TYPE_CHECKING, Any
from urllib.parse import urljoin, urlsplit

from slamhive import __version__
from slamhive.base.clock import utc_now
from slamhive.base.errors import Unavailable

if TYPE_CHECKING:
    import requests

# Why a request failed, and what that means for the download.


class Refused(Unavailable):
    """This address will not give the file, however often it is asked."""


class Interrupted(Unavailable):
    """The transfer failed, but may work when it is tried again.

    Args:
        message: What happened.
        wait_s: How long the server asks to wait, None if it does not say.
    """

    def __init__(self, message: str, wait_s: float | None = None) -> None:
        super().__init__(message)
        self.wait_s = wait_s


class Changed(Unavailable):
    """The file at the address is not the one whose first bytes were received."""


MOST_REDIRECTS = 8
_REDIRECTS = {301, 302, 303, 307, 308}
_TRY_AGAIN = {408, 425, 429, 500, 502, 503, 504}
_MEANING = {
    401: "wants a login",
    403: "refuses access",
    404: "does not have the file",
    410: "does not have the file any more",
    429: "gets too many requests",
}


@dataclass(frozen=True, slots=True)
class AccessToken:
    """A secret for one host. It is sent over https only, or to this machine."""

    host: str
    value: str

    def allowed(self, address: str) -> bool:
        """Tell if ``address`` may get it."""
        parts = urlsplit(address)
        return parts.hostname == self.host and (parts.scheme == "https" or self.host in {"127.0.0.1", "localhost"})


@dataclass(frozen=True, slots=True)
class Timeouts:
    """Time-outs of the connection and of the next bytes, in s."""

    connect_s: float = 15.0
    read_s: float = 30.0


class Web:
    """Requests of one thread.

    Args:
        timeouts: For connecting and for reading.
        token: Sent to its host.
    """

    def __init__(self, timeouts: Timeouts, token: AccessToken | None = None) -> None:
        import requests  # noqa: PLC0415 - importing it takes 50 ms, and few commands download

        self._session = requests.Session()
        self._session.auth = lambda request: request  # instead of the passwords of ``~/.netrc``, which would be sent
        self._session.headers.update({"User-Agent": f"slamhive/{__version__}", "Accept-Encoding": "identity"})
        self._timeouts = timeouts
        self._token = token

    @contextmanager
    def get(self, address: str, headers: dict[str, str] | None = None) -> Iterator[requests.Response]:
        """The answer to GET after redirects, with status 200, 206 or 416, its body unread.

        Raises:
            Refused: the address is no use.
            Interrupted: it may work later.
        """
        with explained(address):
            response = self._follow(address, headers or {})
            try:
                check_status(response)
                yield response
            finally:
                response.close()

    def _follow(self, address: str, headers: dict[str, str]) -> requests.Response:
        asked = address
        for _ in range(MOST_REDIRECTS + 1):
            own = dict(headers)
            if self._token is not None and self._token.allowed(asked):
                own["Authorization"] = f"Bearer {self._token.value}"
            timeout = (self._timeouts.connect_s, self._timeouts.read_s)
            response = self._session.get(asked, headers=own, stream=True, allow_redirects=False, timeout=timeout)
            if response.status_code not in _REDIRECTS:
                return response
            response.close()
            location = response.headers.get("Location", "")
            following = urljoin(asked, location)
            parts = urlsplit(following)
            if parts.scheme not in {"http", "https"} or not parts.hostname:
                raise Refused(f"{asked} redirects to {location[:200]!r}, which is no http or https address")
            asked = following
        raise Refused(f"{address} redirects more than {MOST_REDIRECTS} times")


def body(response: requests.Response, piece_bytes: int) -> Iterator[bytes]:
    """The body in pieces, as it was sent."""
    while piece := response.raw.read(piece_bytes, decode_content=False):
        yield piece


def check_status(response: requests.Response) -> None:
    """Raise Refused or Interrupted unless the status is 200, 206 or 416."""
    code = response.status_code
    if code in {200, 206, 416}:
        return
    meaning = _MEANING.get(code, "fails" if code >= 500 else "does not give the file")
    message = f"{urlsplit(response.url).hostname} {meaning} (HTTP status {code})"
    if code in _TRY_AGAIN:
        raise Interrupted(message, _wait_s(response.headers.get("Retry-After")))
    raise Refused(message)


@contextmanager
def explained(address: str) -> Iterator[None]:
    """Turn what requests and urllib3 raise during the block into Refused or Interrupted."""
    import requests  # noqa: PLC0415
    import urllib3  # noqa: PLC0415

    host = urlsplit(address).hostname
    try:
        yield
    except requests.exceptions.SSLError as error:
        raise Refused(f"{host} has no valid certificate: {_cause(error)}") from None
    except (requests.exceptions.Timeout, urllib3.exceptions.ReadTimeoutError):
        raise Interrupted(f"{host} sends nothing any more") from None
    except (requests.exceptions.InvalidURL, requests.exceptions.InvalidSchema) as error:
        raise Refused(f"{address} cannot be asked: {error}") from None
    except requests.exceptions.ProxyError as error:
        raise Interrupted(f"the proxy for {host} does not answer: {_cause(error)}") from None
    except requests.exceptions.ConnectionError as error:
        raise Interrupted(f"{host} cannot be reached: {_cause(error)}") from None
    except (requests.exceptions.RequestException, urllib3.exceptions.HTTPError) as error:
        raise Interrupted(f"{host} breaks off: {_cause(error)}") from None


def _wait_s(text: str | None) -> float | None:
    """The seconds of a Retry-After header, which holds a number or a date; None for anything else."""
    if text is None:
        return None
    if text.strip().isdecimal():
        return float(text)
    try:
        until = parsedate_to_datetime(text)
    except ValueError:
        return None
    return max(0.0, (until.replace(tzinfo=until.tzinfo or UTC) - utc_now()).total_seconds())


def _cause(error: BaseException) -> str:
    """The innermost reason: ``Connection refused``, not the chain of exceptions around it."""
    reason: Any = error
    while True:
        inner = getattr(reason, "reason", None) or next((a for a in reason.args if isinstance(a, BaseException)), None)
        if not isinstance(inner, BaseException):
            break
        reason = inner
    text = getattr(reason, "strerror", None) or str(reason)
    return text.rsplit(": ", 1)[-1] or type(reason).__name__
