import pytest

from slamhive.base.errors import InvalidInput
from slamhive.services.imports.reading import PathPattern


@pytest.mark.parametrize(
    ("pattern", "path", "fields"),
    [
        (
            "<algorithm>/<dataset>/<trial>.txt",
            "orb/MH_01/3.txt",
            {"algorithm": "orb", "dataset": "MH_01", "trial": "3"},
        ),
        (
            "<algorithm>/<dataset>/<trial>.txt",
            "orb/MH_01/a.b.txt",
            {"algorithm": "orb", "dataset": "MH_01", "trial": "a.b"},
        ),
        ("<algorithm>/<dataset>/<trial>.txt", "MH_01/groundtruth.txt", None),
        ("<algorithm>/<dataset>/<trial>.txt", "orb/MH_01/3.csv", None),
        ("<algorithm>/<dataset>/<trial>.txt", "orb/deep/MH_01/3.txt", None),
        (
            "<dataset>/stamped_traj_estimate<trial>.txt",
            "MH/stamped_traj_estimate4.txt",
            {"dataset": "MH", "trial": "4"},
        ),
        ("*/<dataset>_<algorithm>.txt", "any/MH_orb.txt", {"dataset": "MH", "algorithm": "orb"}),
        ("a.b/<dataset>", "aXb/MH", None),
        ("", "anything", None),
    ],
)
def test_patterns_read_names_out_of_paths(pattern, path, fields):
    assert PathPattern(pattern).match(path) == fields


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("<algo>/<dataset>.txt", "unknown field <algo>"),
        ("<dataset>/<dataset>.txt", "<dataset> twice"),
        ("<algorithm>.txt", "lacks <dataset>"),
        ("../<algorithm>/<dataset>", "leaves the folder"),
        ("/<algorithm>/<dataset>", "leaves the folder"),
    ],
)
def test_patterns_that_cannot_be_meant_are_refused(pattern, message):
    with pytest.raises(InvalidInput, match=message):
        PathPattern(pattern, needed=("algorithm", "dataset"))
