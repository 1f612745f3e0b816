"""Messages to people when an experiment ends, or begins to fail."""

from __future__ import annotations

from slamhive.services.notices.channels import Channel, channels_of
from slamhive.services.notices.sending import Notices, notices_of

__all__ = ["Channel", "Notices", "channels_of", "notices_of"]
