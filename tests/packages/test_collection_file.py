"""The files of the catalogue of public collections, and every way to write a wrong one."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.collection import FileKind, NeedKind
from slamhive.domain.dataset import ATTRIBUTE_KINDS
from slamhive.domain.names import check_name
from slamhive.domain.sensors import SensorSetup
from slamhive.packages.collection_file import load_collection
from slamhive.recordings.importers.registry import IMPORTERS
from slamhive.recordings.importing import ImportOptions

FILES = sorted((Path(__file__).parents[2] / "datasets" / "catalogue").glob("*.yaml"))
WANTED = {
    *("bonn", "eth3d", "euroc", "hilti-2022", "icl-nuim", "kitti", "newer-college", "openloris", "tartanair"),
    *(
        "tum-rgbd",
        "tum-vi",
        "fusionportable",
        "grand-tour",
        "hilti-2026",
        "m2dgr",
        "msd",
        "geode",
        "rtk-slam",
        "subt-mrs",
    ),
}
GOOD = """
format: 1
name: some
title: Some
homepage: https://example.org/
licence: CC BY 4.0
citation: Somebody
importer: kitti-odometry
attributes: [indoor]
sensors: {camera: 2, imu: 1}
files:
  whole: {address: "https://example.org/{room}.zip", bytes: 12}
sources:
  main: [{file: whole, take: "{sequence}/mav0"}]
sequences:
  a: {values: {room: hall}, attributes: [dark]}
"""


def test_the_catalogue_is_complete() -> None:
    assert {path.stem for path in FILES} >= WANTED


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_each_file_makes_sense(path: Path) -> None:
    collection = load_collection(path)
    assert collection.citation
    unfit = set(collection.options) - IMPORTERS.get(collection.importer).options
    assert not unfit
    ImportOptions(**collection.options)  # type: ignore[arg-type]
    for sequence in collection.sequences:
        check_name("dataset", sequence.dataset_name)
        assert sequence.setups
        assert sequence.sources or collection.by_hand
        for kind in ATTRIBUTE_KINDS[2:]:
            assert " + " not in (kind.of(sequence.attributes) or ""), (sequence.name, kind.name)
        for parts in sequence.sources.values():
            folders = [(part.file.name, part.take, part.to) for part in parts]
            assert len(set(folders)) == len(folders)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_addresses_that_nobody_tried_say_so(path: Path) -> None:
    """Change this when somebody has run `slamhive dataset links` on the net."""
    assert load_collection(path).unverified


def test_the_uncertainty_of_ground_truth_is_that_of_the_sequence_or_of_the_collection(tmp_path: Path) -> None:
    euroc = load_collection(next(path for path in FILES if path.stem == "euroc"))
    stated = {sequence.name[:2]: sequence.uncertainty_m for sequence in euroc.sequences}
    assert stated == {"MH": 0.001, "V1": None, "V2": None}
    lines = GOOD.replace("sensors:", "uncertainty_m: 0.05\nsensors:").replace(
        "attributes: [dark]", "uncertainty_m: 0.01"
    )
    (tmp_path / "some.yaml").write_text(lines + "  b: {values: {room: hall}}\n")
    first, second = load_collection(tmp_path / "some.yaml").sequences
    assert (first.uncertainty_m, second.uncertainty_m) == (0.01, 0.05)


def test_a_good_file(tmp_path: Path) -> None:
    (tmp_path / "some.yaml").write_text(GOOD)
    (sequence,) = load_collection(tmp_path / "some.yaml").sequences
    assert sequence.full_name == "some/a"
    assert sequence.attributes == ("some", "indoor", "dark")
    assert SensorSetup.STEREO_INERTIAL in sequence.setups
    (part,) = sequence.parts
    assert (part.take, part.file.name, part.file.kind) == ("a/mav0", "hall.zip", FileKind.ZIP)
    assert part.file.addresses == ("https://example.org/hall.zip",)
    assert part.file.size_bytes == 12


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("name: some", "name: other", "name 'other' differs from the file's"),
        ("https://example.org/{room}.zip", "ftp://example.org/x.zip", "no http or https address"),
        ("https://example.org/{room}.zip", "https://me:secret@example.org/x.zip", "no http or https address"),
        ("https://example.org/{room}.zip", "https://example.org/{rom}.zip", r"\{rom\} in .* has no value"),
        ("https://example.org/{room}.zip", "https://example.org/", "cannot be a file name; give it a name"),
        ("file: whole", "file: hole", "there is no file 'hole'; use whole"),
        ("{sequence}/mav0", "../mav0", "is no path inside an archive or folder"),
        ("bytes: 12", "bytes: 0", "bytes"),
        ("bytes: 12", "checksum: 'sha256:12'", "checksum"),
        ("bytes: 12", "size: 12", "unknown key 'files.whole.size'"),
        ("attributes: [dark]", "sources: [other]", "there is no source 'other'; use main"),
        ("attributes: [dark]", "attributes: [Very Dark]", "attributes"),
        (
            "importer:",
            "needs: [{kind: token, text: Ask.}]\nimporter:",
            "a token, and nothing else, needs variable and host",
        ),
        ("  a: {", "  a b: {", "sequences"),
    ],
)
def test_mistakes(tmp_path: Path, old: str, new: str, problem: str) -> None:
    path = tmp_path / "some.yaml"
    path.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(InvalidInput, match=problem) as found:
        load_collection(path)
    assert str(path) in str(found.value)


def test_needs_are_typed(tmp_path: Path) -> None:
    need = "needs: [{kind: token, text: Ask., variable: A_TOKEN, host: example.org}, {kind: form, text: Fill it in.}]"
    (tmp_path / "some.yaml").write_text(f"{GOOD}{need}\n")
    collection = load_collection(tmp_path / "some.yaml")
    assert [entry.kind for entry in collection.needs] == [NeedKind.TOKEN, NeedKind.FORM]
    assert [entry.kind for entry in collection.by_hand] == [NeedKind.FORM]
