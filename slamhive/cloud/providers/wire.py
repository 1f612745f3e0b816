"""Signed calls of a provider's API, by the connection of a Libcloud driver.

Libcloud's own methods set tags, shutdown behaviour and release time after a machine runs, if at all. A controller that
is killed in between would leave a machine that nobody finds. So calls are made here, one action each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Self
from urllib.parse import urlsplit
from xml.etree.ElementTree import Element

from slamhive.base.clock import Clock
from slamhive.base.errors import Forbidden, InvalidInput, SlamHiveError, Unavailable

RETRIES_S = (1.0, 2.0, 4.0, 8.0, 16.0)
"""How long to wait before a call is repeated."""
THROTTLED = ("Throttling", "RequestLimitExceeded", "EC2ThrottledException", "ServiceUnavailable")
UNSURE = ("InternalError", "InternalFailure", "InternalServerError", "Unavailable")
CREDENTIALS = (
    *("AuthFailure", "InvalidClientTokenId", "SignatureDoesNotMatch", "ExpiredToken", "RequestExpired"),
    *("IncompleteSignature", "InvalidAccessKeyId", "InvalidSecurityToken", "OptInRequired", "MissingSecurityToken"),
)
FORBIDDEN = ("UnauthorizedOperation", "Forbidden", "NoPermission", "AccessDenied")
BUSY = (
    *("DependencyViolation", "IncorrectInstanceStatus", "IncorrectInstanceState", "InvalidGroup.InUse", "VolumeInUse"),
    *("InvalidSnapshot.InUse", "IncorrectDiskStatus", "InvalidOperation.ImageUsed", "OperationConflict", "ImageUsing"),
)
GONE = (
    *("InvalidInstanceID.NotFound", "InvalidAMIID.NotFound", "InvalidAMIID.Unavailable", "InvalidSnapshot.NotFound"),
    *("InvalidVolume.NotFound", "InvalidGroup.NotFound"),
    *("InvalidInstanceId.NotFound", "InvalidImageId.NotFound", "InvalidSnapshotId.NotFound", "InvalidDiskId.NotFound"),
    *("InvalidSecurityGroupId.NotFound", "InvalidResourceId.NotFound"),
)
"""The resource does not exist any more."""


class CallFailed(Exception):
    """A provider refused a call. ``code`` is its word for the reason; empty if it did not answer."""

    def __init__(self, action: str, code: str, message: str) -> None:
        super().__init__(f"{action}: {code}: {message}")
        self.action, self.code, self.message = action, code, message

    def is_one_of(self, codes: Iterable[str]) -> bool:
        """Tell if the code is one of ``codes``, or a special case of one."""
        return any(self.code == code or self.code.startswith(f"{code}.") for code in codes)


class Wire:
    """Calls actions of a query API. Answers are trees without namespaces.

    Args:
        connection: Of a Libcloud driver; signs and sends.
        provider: Its name in messages.
        clock: Waits between attempts.
    """

    def __init__(self, connection: Any, provider: str, clock: Clock) -> None:
        connection.responseCls = _explicit(connection.responseCls)
        self._connection = connection
        self._provider = provider
        self._clock = clock

    def call(self, action: str, params: Mapping[str, str | int] | None = None) -> Element:
        """Call ``action``; raises CallFailed if it is refused.

        A call that was throttled, or has no answer, is repeated: it may have taken effect already.
        """
        for wait_s in (*RETRIES_S, None):
            try:
                return self._call(action, params or {})
            except CallFailed as error:
                if wait_s is None or (error.code and not error.is_one_of((*THROTTLED, *UNSURE))):
                    raise
                self._clock.sleep(wait_s)
        raise AssertionError("the last attempt returns or raises")

    def call_unless(
        self, done: Iterable[str], action: str, params: Mapping[str, str | int], later: Iterable[str] = ()
    ) -> bool:
        """Call ``action``; False if it is refused because it is not possible yet.

        A refusal in ``done`` means that it was done before, one in ``later`` that it is not possible yet. Others become
        errors for users.
        """
        with self.explaining():
            try:
                self.call(action, params)
            except CallFailed as error:
                if error.is_one_of(later):
                    return False
                if not error.is_one_of(done):
                    raise
        return True

    def pages(
        self, action: str, params: Mapping[str, str | int], following: Callable[[Element], Mapping[str, str | int]]
    ) -> Iterator[Element]:
        """Every page of a list; ``following`` returns what asks for the next page, and nothing for the last."""
        more: Mapping[str, str | int] = {}
        while True:
            page = self.call(action, {**params, **more})
            yield page
            more = following(page)
            if not more:
                return

    @contextmanager
    def explaining(self) -> Iterator[None]:
        """Refused calls in the block become errors for users."""
        try:
            yield
        except CallFailed as error:
            raise self._explained(error) from None

    def _explained(self, error: CallFailed) -> SlamHiveError:
        """The error for a user: one line, without keys."""
        text = f"{self._provider} refused {error.action}: {error.code}: {error.message}"
        if not error.code:
            return Unavailable(f"{self._provider} does not answer: {error.message}", "check region and network")
        if error.is_one_of(CREDENTIALS):
            return Forbidden(
                f"{self._provider} does not accept the credentials ({error.code}): {error.message}",
                "renew the access key",
            )
        if error.is_one_of(FORBIDDEN):
            return Forbidden(text, f"the access key needs the right to {error.action}")
        if error.is_one_of((*THROTTLED, *UNSURE)):
            return Unavailable(text, "try again later")
        return InvalidInput(text, "check the cloud file")

    def _call(self, action: str, params: Mapping[str, str | int]) -> Element:
        # Importing Libcloud takes a moment, which only those who rent machines wait for.
        from libcloud.common.types import LibcloudError  # noqa: PLC0415

        try:
            return _plain(self._connection.request("/", params={"Action": action, **params}).object)
        except CallFailed as error:
            raise CallFailed(action, error.code, error.message) from None
        except LibcloudError:
            raise CallFailed(action, UNSURE[0], "the answer is no XML") from None
        except OSError as error:  # requests' errors are OSErrors, too
            raise CallFailed(action, "", type(error).__name__) from None


def _explicit(kind: Any) -> Any:
    """The class of a driver's answers, with refusals as CallFailed; drivers word them in different ways."""

    class Answer(kind):  # type: ignore[misc]
        def parse_error(self) -> None:
            found = self.parse_body()
            tree = _plain(found) if isinstance(found, Element) else Element("empty")
            code = next((text_of(entry, ".") for entry in tree.iter("Code")), f"HTTP{self.status}")
            raise CallFailed("", code, next((text_of(entry, ".") for entry in tree.iter("Message")), ""))

    return Answer


def _plain(tree: Element) -> Element:
    """The same tree without namespaces."""
    for entry in tree.iter():
        entry.tag = entry.tag.rpartition("}")[2]
    return tree


def text_of(element: Element, path: str) -> str:
    """The text at ``path``, empty without one."""
    return (element.findtext(path) or "").strip()


# Another server that speaks a provider's API.


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
        """Arguments of a driver of Libcloud."""
        return {"host": self.host, "port": self.port, "secure": self.secure}
