"""Citations in the words of YAML files as BibTeX."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from slamhive.domain.bibliography import TOOLS, Reference, bibtex, cited

ROOT = Path(__file__).parents[2]


def entry(text: str) -> str:
    return bibtex([Reference(("x",), text)])


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (
            "J.-M. Frahm, J. D. Tardós. Structure-from-Motion: A Review. IEEE Transactions on Robotics 33(5), 2017.",
            ["@article{frahm2017structurefrommotion,", "author = {J.-M. Frahm and J. D. Tardós}", "journal = {IEEE Tr"],
        ),
        ("T. Shan, B. Englot. LeGO-LOAM: A B. IROS 2018.", ["@inproceedings{shan2018legoloam,", "booktitle = {IROS}"]),
        (
            "A. Bee. In X. Or Y. arXiv:2506.04359, 2025.",
            ["doi = {10.48550/arXiv.2506.04359}", "title = {{In X. Or Y}}"],
        ),
        ("A. Bee et al. Title. ICRA 2020. doi:10.1/ab_c.", ["author = {A. Bee and others}", "doi = {10.1/ab_c}"]),
        ("Burri et al.: The EuRoC datasets. IJRR 2016", ["@article{burri2016euroc,", "{Burri and others}"]),
        ("Geiger, Lenz: Are we ready? Yes. CVPR 2012", ["{Geiger and Lenz}", "title = {{Are we ready? Yes}}"]),
        ("Two: A. Bee. Tea. ICRA, 2020. Six: C. Dee. U & V. RSS, 2021.", ["bee2020tea,", "dee2021u,", r"{{U \& V}}"]),
        ("Software of a university, 2026.", ["@misc{x,", "howpublished = {Software of a university, 2026.}"]),
        ("@book{own,\n title={T}}", ["% x\n@book{own,"]),
        ("", ["% no citation is known for x"]),
    ],
)
def test_a_citation_becomes_an_entry(text, parts):
    found = entry(text)
    assert [part for part in parts if part not in found] == []
    assert found.count("{") == found.count("}")


def test_a_doi_belongs_to_the_work_before_it():
    assert entry("A. Bee. Title. ICRA 2020. https://doi.org/10.1/x. C. Dee. Sea. RSS 2021.").count("@") == 2


def test_a_work_appears_once_and_different_works_have_different_keys():
    first, second = "A. Bee. Title one. ICRA, 2020.", "A. Bee. Title two. ICRA, 2020."
    references = cited([("a", first), ("b", first), ("c", f"{first} {second}"), ("d", ""), ("e", "")])
    assert [entry.names for entry in references] == [("a", "b"), ("c",), ("d", "e")]
    assert re.findall(r"@\w+{(.*),", bibtex(references)) == ["bee2020title", "bee2020title-2"]
    assert "% no citation is known for d, e" in bibtex(references)


def test_almost_every_citation_that_ships_is_understood():
    yaml = YAML(typ="safe")
    files = [*ROOT.glob("algorithms/*/algorithm.yaml"), *ROOT.glob("datasets/catalogue/*.yaml")]
    texts = {path: yaml.load(path)["citation"] for path in files}
    assert len(texts) > 30
    plain = [str(path) for path, text in texts.items() if "author = " not in entry(text)]
    assert len(plain) <= 1, plain


def test_the_citation_file_names_the_same_paper():
    paper = YAML(typ="safe").load(ROOT / "CITATION.cff")["preferred-citation"]
    own = bibtex(TOOLS[:1])
    assert all(author["family-names"] in own for author in paper["authors"])
    for value in (paper["title"], paper["doi"], str(paper["year"])):
        assert value in own
