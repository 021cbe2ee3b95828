"""Summary that `make audit` prints of pip-audit's reports."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

PROGRAM = Path(__file__).parents[2] / "deploy" / "audit.py"
FINE = {"name": "numpy", "version": "2.0", "vulns": []}
WEAK = {"name": "pillow", "version": "9.0", "vulns": [{"id": "CVE-1", "fix_versions": ["9.1"], "aliases": []}]}
OPEN = {"name": "wheel", "version": "1.0", "vulns": [{"id": "CVE-2", "fix_versions": [], "aliases": []}]}
UNKNOWN = {"name": "dg4d", "skip_reason": "Dependency not found on PyPI and could not be audited: dg4d (0.1.0)"}


@pytest.mark.parametrize(
    ("reports", "status", "said"),
    [
        ([[FINE]], 0, ["vulnerabilities are known of 0 of 1 packages"]),
        ([[FINE, UNKNOWN]], 0, ["of 0 of 1 packages", "1 more could not be audited (dg4d)"]),
        ([[WEAK, OPEN, FINE]], 1, ["pillow 9.0: CVE-1, fixed in 9.1", "CVE-2, fixed in no version yet", "of 2 of 3"]),
        ([[UNKNOWN, UNKNOWN]], 69, ["none of 2 packages could be audited"]),
        ([None], 69, ["pip-audit wrote no report"]),
        ([[FINE], [FINE, WEAK]], 1, ["CVE-1", "of 1 of 2 packages"]),
        ([[FINE], None], 69, ["pip-audit wrote no report", "of 0 of 1 packages"]),
        ([None, [WEAK]], 1, ["pip-audit wrote no report", "of 1 of 1 packages"]),
    ],
)
def test_all_reports_are_summed_up_and_a_missing_one_is_no_good_news(
    reports: list[list[dict[str, Any]] | None], status: int, said: list[str], tmp_path: Path
) -> None:
    paths = [tmp_path / f"{number}.json" for number in range(len(reports))]
    for path, packages in zip(paths, reports, strict=True):
        path.write_text("" if packages is None else json.dumps({"dependencies": packages, "fixes": []}))
    done = subprocess.run([sys.executable, PROGRAM, *paths], capture_output=True, text=True, check=False)
    assert done.returncode == status, done.stderr
    assert all(words in done.stdout for words in said), done.stdout
