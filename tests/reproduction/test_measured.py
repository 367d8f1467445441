"""What REPRODUCTION.md shows is what the report that comes with the project says."""

import csv
import re
from pathlib import Path

import pytest

from hindrl_jax.reproduction.claims import CLAIMS, verdict
from hindrl_jax.reproduction.scales import RECIPE_NAMES

ROOT = Path(__file__).parent.parent.parent
REPORT = ROOT / "benchmarks" / "thesis"
TEXT = (ROOT / "REPRODUCTION.md").read_text()


def test_every_table_is_the_reports():
    rows = [line for line in TEXT.splitlines() if line.startswith("|")]
    assert len(rows) > 30
    assert set(rows) <= set((REPORT / "report.md").read_text().splitlines())


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.letter)
def test_verdicts_follow_from_the_findings(claim):
    rows = [row for row in csv.DictReader((REPORT / "claims.csv").read_text().splitlines()) if row["claim"] == claim.letter]
    worst = ("does not hold", "not run", "open", "holds")
    findings = {recipe: min((row["finding"] for row in rows if row["recipe"] == recipe), key=worst.index) for recipe in RECIPE_NAMES}
    (said,) = re.findall(rf"^\| \({claim.letter}\) .*? \| \*\*(.*?)\*\* \|", TEXT, re.MULTILINE)
    assert said == verdict(findings) == rows[0]["verdict"]
