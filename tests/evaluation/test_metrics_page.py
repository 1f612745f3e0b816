from pathlib import Path

from slamhive.domain.metrics import CATALOGUE

PAGE = Path(__file__).resolve().parent.parent.parent / "docs" / "metrics.md"


def test_the_page_lists_every_metric_as_the_catalogue_defines_it() -> None:
    rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    expected = [
        f"| `{metric.key}` | {metric.label} | {metric.unit or '1'} | {metric.direction.value} | {metric.definition} |"
        for metric in CATALOGUE.values()
    ]
    assert rows == expected
