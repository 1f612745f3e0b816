"""Small pictures of the plots of an analysis that is still being written, over a part of its runs."""

from __future__ import annotations

import hashlib
import json
import logging
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from slamhive.clock import monotonic_s
from slamhive.errors import InvalidInput, Unavailable
from slamhive.files import write_aside
from slamhive.services.analyses.computing import computing
from slamhive.services.analyses.folder import PREVIEWS, SOURCE
from slamhive.settings import Settings
from slamhive.store import Store

logger = logging.getLogger(__name__)

MOST_PREVIEWED_RUNS = 200
MOST_PLOTS = 12
TIME_LIMIT_S = 60.0
MOST_WAIT_S = 20.0
"""A page waits so long while previews of another text are being computed."""
KEPT_S = 60.0
"""Runs may have been added since."""
MOST_KEPT = 20
LOOK_S = 0.05


@dataclass(frozen=True, slots=True)
class Preview:
    """One plot of the text: a PNG image in base64, or why there is none."""

    form: str
    title: str
    image: str | None
    note: str


class AnalysisPreviews:
    """Computes previews one text at a time, in a process with limited memory and time, and keeps the latest.

    ``busy`` is held meanwhile.

    Args:
        settings: For the computing process.
        store: Says who asks: previews hold what that person may see.
        project_root: The folder with ``algorithms/``.
        check: Raises InvalidInput for a text that is not valid.
    """

    def __init__(self, settings: Settings, store: Store, project_root: Path, check: Callable[[str], str]) -> None:
        self._settings = settings
        self._store = store
        self._project_root = project_root
        self._check = check
        self.busy = threading.Lock()
        self._kept: OrderedDict[str, tuple[float, tuple[Preview, ...]]] = OrderedDict()

    def of(self, text: str) -> tuple[Preview, ...]:
        """The first plots of the text, in order.

        Raises:
            InvalidInput: the text is not valid, or its plots cannot be computed within the limits.
            Unavailable: previews of another text are being computed.
        """
        self._check(text)
        viewer = self._store.viewer
        seen = {"viewer": None if viewer is None else asdict(viewer), "owner": self._store.account}
        key = hashlib.sha256(f"{json.dumps(seen)}\n{text}".encode()).hexdigest()
        if not self.busy.acquire(timeout=MOST_WAIT_S):
            raise Unavailable("previews of another analysis are being computed", "try again in a few seconds")
        try:
            known = self._kept.get(key)
            if known is not None and monotonic_s() - known[0] <= KEPT_S:
                return known[1]
            found = self._computed(text, seen)
            self._kept[key] = (monotonic_s(), found)
            self._kept.move_to_end(key)
            while len(self._kept) > MOST_KEPT:
                self._kept.popitem(last=False)
        finally:
            self.busy.release()
        return found

    def _computed(self, text: str, seen: Mapping[str, Any]) -> tuple[Preview, ...]:
        limits = {"time_limit_s": TIME_LIMIT_S, "preview_runs": MOST_PREVIEWED_RUNS, "preview_plots": MOST_PLOTS}
        deadline_s = monotonic_s() + TIME_LIMIT_S
        with tempfile.TemporaryDirectory(prefix="slamhive-preview-") as name:
            folder = Path(name)
            write_aside(folder / SOURCE, text)
            with computing(self._settings, self._project_root, folder, **limits, **seen) as process:
                while process.goes_on:
                    if monotonic_s() > deadline_s:
                        raise InvalidInput(f"the previews take longer than {TIME_LIMIT_S:g} s", "compute the analysis")
                    time.sleep(LOOK_S)
                said: dict[str, Any] = process.said()
            if "error" in said:
                raise InvalidInput(str(said["error"]))
            return tuple(Preview(**entry) for entry in json.loads((folder / PREVIEWS).read_text(encoding="utf-8")))
