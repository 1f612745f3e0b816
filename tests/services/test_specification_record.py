"""A specification survives its record, also one of a run that an earlier version had started."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.documents.limits import Limits
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.base import Capabilities, ImageMissing
from slamhive.executors.spec import Limit, ResourceLimits, RunInput, RunOutput, RunSpec
from slamhive.executors.transfer import make_own_copies, written_places
from slamhive.services.runs.record import spec_from_json, spec_to_json
from slamhive.services.runs.specification import check_executor, cpu_limit
from tests.services.fake_executor import FakeExecutor


def spec(root: Path) -> RunSpec:
    return RunSpec(
        key="k", run_id=7, package="tiny", package_folder=root / "tiny", image="i:1", identity="sha256:1",
        command=("python3", "/slamhive/mapping.py"),
        inputs=(RunInput("slamhive", root / "work" / "slamhive", "/slamhive", own_copy=True),
                RunInput("slamhive/config.yaml", root / "config.yaml", "/slamhive/config.yaml")),
        outputs=(RunOutput("result", root / "result", "/slamhive/result"),),
        environment={"A": "b"}, limits=ResourceLimits(1.0, 5, 6, (0, 1), 7, 8), timeout_s=9.0, work=root / "work",
    )  # fmt: skip


def test_there_and_back(tmp_path):
    assert spec_from_json(spec_to_json(spec(tmp_path))) == spec(tmp_path)


def test_a_record_with_mounts_is_read(tmp_path):
    content = spec_to_json(spec(tmp_path))
    del content["inputs"], content["outputs"], content["work"]
    content["log_path"] = str(tmp_path / "log.txt")
    content["mounts"] = [
        {"source": str(tmp_path / "work" / "slamhive"), "target": "/slamhive", "read_only": False},
        {"source": str(tmp_path / "config.yaml"), "target": "/slamhive/config.yaml", "read_only": True},
        {"source": str(tmp_path / "result"), "target": "/slamhive/result", "read_only": False},
    ]
    read = spec_from_json(content)
    assert read == spec(tmp_path)
    # The earlier version has made the copy already.
    (tmp_path / "work" / "slamhive").mkdir(parents=True)
    make_own_copies(read)
    assert written_places(read) == {
        "/slamhive": tmp_path / "work" / "slamhive",
        "/slamhive/result": tmp_path / "result",
    }


class Unlimited(FakeExecutor):
    """Enforces nothing, and runs no package without environment."""

    name = "unlimited"
    capabilities = Capabilities()

    def check_package(self, package: AlgorithmPackage) -> None:
        if package.name != "tiny":
            raise ImageMissing(f"{package.name} has no requirements.txt")


def test_limits_that_a_user_asks_for_are_enforced_or_refused():
    package = AlgorithmPackage("tiny", Path(), "Tiny", "1", "", "", "")
    check_executor(Unlimited(), package, Limits(timeout_s=5.0))
    with pytest.raises(InvalidInput, match="unlimited does not limit cores and memory; leave the limit out"):
        check_executor(Unlimited(), package, Limits(cpu_cores=1.0, memory_mb=100))
    check_executor(FakeExecutor(), package, Limits(cpu_cores=1.0, memory_mb=100))
    with pytest.raises(InvalidInput, match=r"has no requirements\.txt"):
        check_executor(Unlimited(), replace(package, name="other"), Limits())


class WholeCores(FakeExecutor):
    """Gives whole cores, as a machine without a controller of CPU time does."""

    def no_part_of_a_core(self) -> str | None:
        return "runs are bound to whole cores here"


class Nodes(FakeExecutor):
    """Runs on nodes, whose cores are not known beforehand."""

    capabilities = Capabilities(limits=frozenset(Limit), shares_files=False)


def test_a_slow_down_that_cannot_be_held_is_refused():
    package = AlgorithmPackage("tiny", Path(), "Tiny", "1", "", "", "")
    slowed = Limits(slow_down=4.0)
    check_executor(FakeExecutor(), package, slowed)
    for executor, reason in ((WholeCores(), "bound to whole cores"), (Unlimited(), "unlimited does not limit cores")):
        with pytest.raises(InvalidInput, match=f"a slow-down of 4 cannot be held: .*{reason}.*; leave slow_down out"):
            check_executor(executor, package, slowed)
    with pytest.raises(InvalidInput, match="needs a CPU limit"):
        check_executor(Nodes(), package, slowed)
    check_executor(Nodes(), package, Limits(slow_down=4.0, cpu_cores=2.0))
    with pytest.raises(InvalidInput, match=r"0\.1 cores slowed down by 20 are less than 0\.01 cores"):
        check_executor(FakeExecutor(), package, Limits(slow_down=20.0, cpu_cores=0.1))


@pytest.mark.parametrize(
    ("asked", "slot", "here", "expected"),
    [
        (Limits(slow_down=4.0), (0, 1), True, 0.5),
        (Limits(slow_down=4.0, cpu_cores=1.0), (0, 1), True, 0.25),
        (Limits(slow_down=4.0, cpu_cores=8.0), (0, 1), True, 0.5),
        (Limits(slow_down=4.0, cpu_cores=8.0), None, False, 2.0),
        (Limits(cpu_cores=8.0), (0, 1), True, 8.0),
    ],
)
def test_a_slowed_run_gets_a_part_of_the_time_of_the_cores_it_has(asked, slot, here, expected):
    assert cpu_limit(asked, None, slot, here=here) == expected
