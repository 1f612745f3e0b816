"""The providers of machines, behind one seam."""

from __future__ import annotations

import os
from collections.abc import Mapping

from slamhive.base.clock import SYSTEM_CLOCK, Clock
from slamhive.base.errors import Forbidden, Unavailable
from slamhive.cloud.plan import ProviderName
from slamhive.cloud.providers.wire import Endpoint
from slamhive.cloud.resources import Credentials, Provider

KEYS = {
    ProviderName.EC2: ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN"),
    ProviderName.ECS: ("ALIBABA_CLOUD_ACCESS_KEY_ID", "ALIBABA_CLOUD_ACCESS_KEY_SECRET", None),
}
"""The environment variables with key, secret and token, as the tools of the providers call them."""


def open_provider(
    name: ProviderName,
    region: str,
    endpoint: str = "",
    environment: Mapping[str, str] = os.environ,
    clock: Clock = SYSTEM_CLOCK,
) -> Provider:
    """A region of a provider.

    Raises Forbidden without credentials in ``environment``, NotFound for a region that EC2 does not have, and
    Unavailable without Libcloud.
    """
    key, secret, token = KEYS[name]
    missing = [variable for variable in (key, secret) if not environment.get(variable)]
    if missing:
        raise Forbidden(f"{name} needs credentials: {' and '.join(missing)} not set", "set them in the environment")
    credentials = Credentials(environment[key], environment[secret], environment.get(token) if token else None)
    try:
        return _opened(name, region, credentials, Endpoint.of(endpoint), clock)
    except ImportError:
        raise Unavailable("Apache Libcloud is not installed", "pip install 'slamhive[cloud]'") from None


def _opened(
    name: ProviderName, region: str, credentials: Credentials, endpoint: Endpoint | None, clock: Clock
) -> Provider:
    # A provider imports what only it needs.
    from slamhive.cloud.providers.ec2 import Ec2  # noqa: PLC0415
    from slamhive.cloud.providers.ecs import Ecs  # noqa: PLC0415

    kind: type[Ec2 | Ecs] = Ec2 if name is ProviderName.EC2 else Ecs
    return kind(region, credentials, endpoint, clock)
