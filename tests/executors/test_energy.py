"""Energy counters on a tree of files laid out as the kernel's."""

import pytest

from slamhive.base.errors import Unavailable
from slamhive.executors.host_counters import HEADER, EnergyLog, PackageEnergy, read_packages


def counter(powercap, folder, name, energy_uj, range_uj=262143328850):
    (powercap / folder).mkdir(parents=True)
    for file, text in (("name", name), ("energy_uj", energy_uj), ("max_energy_range_uj", range_uj), ("enabled", 1)):
        (powercap / folder / file).write_text(f"{text}\n")


@pytest.fixture
def powercap(tmp_path):
    """Two packages with their cores and memory, and the platform's own counter, which holds them all."""
    root = tmp_path / "powercap"
    counter(root, "intel-rapl:0", "package-0", 61583423018)
    counter(root, "intel-rapl:0:0", "core", 42)
    counter(root, "intel-rapl:0:1", "dram", 43)
    counter(root, "intel-rapl:1", "package-1", 7)
    counter(root, "intel-rapl:2", "psys", 44)
    counter(root, "intel-rapl-mmio:0", "package-0", 45)
    (root / "intel-rapl").mkdir()
    return root


def test_packages_alone_are_read(powercap):
    assert read_packages(powercap) == [
        PackageEnergy(0, 61583423018, 262143328850),
        PackageEnergy(1, 7, 262143328850),
    ]


def test_the_log_holds_a_line_for_each_package_and_second(tmp_path, powercap):
    log = EnergyLog(tmp_path / "energy.csv", powercap)
    for time_s in (0.0, 0.1, 0.9, 1.05, 1.1):
        log.sample(time_s)
    (powercap / "intel-rapl:1" / "energy_uj").write_text("9\n")
    log.sample(1.2, last=True)
    lines = (tmp_path / "energy.csv").read_text().splitlines()
    assert lines[0] == HEADER.strip()
    assert [line.split(",")[0] for line in lines[1:]] == ["0.0000"] * 2 + ["1.0500"] * 2 + ["1.2000"] * 2
    assert lines[-1] == "1.2000,1,9,262143328850"


def test_a_log_is_continued(tmp_path, powercap):
    EnergyLog(tmp_path / "energy.csv", powercap).sample(0.0)
    EnergyLog(tmp_path / "energy.csv", powercap).sample(5.0)
    assert (tmp_path / "energy.csv").read_text().count(HEADER) == 1


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda root: root.rename(root.with_name("gone")), "there is no"),
        (lambda root: (root / "intel-rapl:0" / "energy_uj").unlink(), "there is no"),
        (lambda root: (root / "intel-rapl:0" / "energy_uj").write_text("many"), "'many'"),
        (lambda root: [(root / f"intel-rapl:{k}" / "name").write_text("psys") for k in (0, 1)], "no processor package"),
    ],
)
def test_why_there_is_none_is_one_line_told_once(tmp_path, powercap, spoil, message):
    spoil(powercap)
    with pytest.raises(Unavailable, match=message):
        read_packages(powercap)
    log = EnergyLog(tmp_path / "energy.csv", powercap)
    for time_s in (0.0, 2.0, 4.0):
        log.sample(time_s)
    (line,) = (tmp_path / "energy.csv").read_text().splitlines()
    assert line.startswith("# not measured: energy cannot be measured: ")
    assert message in line
