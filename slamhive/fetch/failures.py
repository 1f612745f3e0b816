"""Why a request failed, and what that means for the download."""

from __future__ import annotations

from slamhive.errors import Unavailable


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
