"""All tables of this version. Importing the store itself loads only the tables that are read."""

from __future__ import annotations

from slamhive.store import account_models, configuration_models, models  # noqa: F401 - each adds its tables
from slamhive.store.tables import Base

METADATA = Base.metadata
