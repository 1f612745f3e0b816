"""An executor whose runs end at once, beside a machine that was as busy as the test says."""

from __future__ import annotations

from collections.abc import Iterator

from slamhive.executors.spec import RunSpec
from slamhive.executors.status import Exited
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.host_columns import COLUMNS
from tests.services.fake_executor import FakeExecutor, write_trajectory

BUSY, QUIET = (1.9,), (0.1,)


def counters(*others_cores: float) -> str:
    """``host.csv`` of a machine with two cores where others kept so many busy, second by second."""
    busy_s, lines = 0.0, [",".join(COLUMNS)]
    for second in range(len(others_cores) + 1):
        lines.append(f"{second},2,{busy_s},0,0,0,0,0,,")
        busy_s += others_cores[min(second, len(others_cores) - 1)]
    return "\n".join([*lines, "# not measured: CPU frequency: there is no such file"]) + "\n"


def beside(*others_cores: float, exit_code: int = 0) -> FakeExecutor:
    """The machine did the same beside every run."""
    return beside_each(iter(lambda: others_cores, None), exit_code=exit_code)


def beside_each(machine: Iterator[tuple[float, ...]], *, exit_code: int = 0) -> FakeExecutor:
    """The machine did something else beside each run."""
    leave = write_trajectory(3)

    def on_start(spec: RunSpec) -> None:
        leave(spec)
        RunFolder(spec.work.parent).host.write_text(counters(*next(machine)))

    return FakeExecutor([Exited(exit_code)], on_start)
