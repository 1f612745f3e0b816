"""The documentation says what the code does, and the site needs nothing from the internet."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

import pytest
import yaml

from slamhive.base.settings_sources import describe
from slamhive.domain.run import FailureReason, RunState
from slamhive.executors.registry import declared_settings

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def generator():
    sys.path.insert(0, str(ROOT / "tools"))  # as for a script
    spec = importlib.util.spec_from_file_location("slamhive_generate_docs", ROOT / "tools" / "generate_docs.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def site():
    return yaml.safe_load((ROOT / "mkdocs.yml").read_text())


def pages(entries) -> list[str]:
    found: list[str] = []
    for entry in entries:
        value = next(iter(entry.values()))
        found += pages(value) if isinstance(value, list) else [value]
    return found


@pytest.mark.integration  # loads the whole command line and every form of analysis
def test_generated_pages_are_up_to_date(generator):
    assert generator.out_of_date() == []


@pytest.mark.integration
def test_check_names_the_stale_page_and_the_command(generator, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(generator, "DOCS", tmp_path)
    assert generator.main(["--check"]) == 1
    assert "docs/settings.md is out of date; run: .venv/bin/python tools/generate_docs.py" in capsys.readouterr().err
    assert generator.main([]) == 0
    assert generator.main(["--check"]) == 0


@pytest.mark.parametrize("entry", describe(declared_settings()), ids=lambda entry: entry.name)
def test_every_setting_is_documented(entry):
    page = (DOCS / "settings.md").read_text()
    assert f"| `{entry.name}` | `{entry.environment}` |" in page
    assert entry.help
    assert entry.help[0].isupper() or entry.help.split()[0].strip(",") in {"workstation", "auto"}


def test_every_state_and_reason_is_explained():
    page = (DOCS / "how-a-run-works.md").read_text()
    assert [state for state in RunState if f"`{state}`" not in page] == []
    assert [reason for reason in FailureReason if f"`{reason}`" not in page] == []


def test_site_lists_every_page_once(site):
    listed = pages(site["nav"])
    assert sorted(listed) == sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))


def test_site_loads_nothing_from_elsewhere(site):
    assert site["theme"]["font"] is False
    assert not {"extra_css", "extra_javascript"} & set(site)


def test_links_of_the_readme_lead_somewhere():
    targets = re.findall(r"\]\((?!https?:)([^)#]+)", (ROOT / "README.md").read_text())
    assert [target for target in targets if not (ROOT / target).exists()] == []


def test_settings_named_in_prose_exist():
    known = {entry.name for entry in describe(declared_settings())} | {"DATABASE_IMAGE"}
    pattern = re.compile(r"`((?:RUN|WORKER|LEASE|DATABASE|ASSOCIATION|GAP|POLL|SAMPLE|STOP)_[A-Z_]+)`")
    named = {(path.name, name) for path in DOCS.glob("*.md") for name in pattern.findall(path.read_text())}
    assert [entry for entry in sorted(named) if entry[1] not in known] == []


def test_pre_commit_downloads_nothing_and_checks_no_types():
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())
    (local,) = hooks["repos"]
    assert local["repo"] == "local"
    programs = [hook["entry"].split()[0] for hook in local["hooks"]]
    assert set(programs) == {".venv/bin/ruff", ".venv/bin/lint-imports"}


def test_the_start_page_leads_to_every_page():
    pages = {path.name for path in (ROOT / "docs").glob("*.md")} - {"index.md"}
    linked = set(re.findall(r"\]\(([\w-]+\.md)", (ROOT / "docs" / "index.md").read_text()))
    assert linked == pages


def test_the_readme_addresses_each_kind_of_reader_after_one_picture_and_one_block_of_commands():
    opening, *_ = (ROOT / "README.md").read_text().split("## ")[:1]
    readers = re.findall(r"^- \*\*(.+?)\*\*: .*\]\(docs/", opening, re.MULTILINE)
    assert len(readers) == 5
    before = opening[: opening.index(f"- **{readers[0]}")]
    assert (before.count("<img"), before.count("```sh")) == (1, 1)
    assert len(re.findall(r"^make ", before, re.MULTILINE)) == 2
