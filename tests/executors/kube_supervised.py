"""``kube`` of ``../shared/kubernetes``, whose supervisors start every daemon again that ends.

``kube`` keeps no reference to the daemons that it starts. Python then takes the exit code of one that has ended
whenever the next process starts, so ``os.wait()`` never names it. A controller manager that ended while etcd was being
restarted stayed away for good. Here each process is held.
"""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

KUBE = Path(__file__).resolve().parents[3] / "shared" / "kubernetes" / "kube"


class HeldPopen(subprocess.Popen[bytes]):
    """A process whose exit code is left to whoever waits for it."""

    _held: list[HeldPopen] = []  # noqa: RUF012 - of all processes, by intention

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._held.append(self)


if __name__ == "__main__":
    subprocess.Popen = HeldPopen  # type: ignore[assignment, misc]
    # kube starts its supervisors from __file__, which therefore has to be this one.
    exec(compile(KUBE.read_bytes(), KUBE, "exec"), {"__name__": "__main__", "__file__": __file__})
