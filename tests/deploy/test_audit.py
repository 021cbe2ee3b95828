"""What `make audit` says of pip-audit's report."""

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
    ("packages", "status", "said"),
    [
        ([FINE], 0, ["weaknesses are known of 0 of 1 packages"]),
        ([FINE, UNKNOWN], 0, ["of 0 of 1 packages", "1 more could not be audited (dg4d)"]),
        ([WEAK, OPEN, FINE], 1, ["pillow 9.0: CVE-1, mended in 9.1", "CVE-2, mended in no version yet", "of 2 of 3"]),
        ([UNKNOWN, UNKNOWN], 69, ["none of 2 packages could be audited"]),
        (None, 69, ["pip-audit gave no report"]),
    ],
)
def test_what_is_known_is_told_and_what_is_not_is_no_good_news(
    packages: list[dict[str, Any]] | None, status: int, said: list[str]
) -> None:
    report = "" if packages is None else json.dumps({"dependencies": packages, "fixes": []})
    done = subprocess.run([sys.executable, PROGRAM], input=report, capture_output=True, text=True, check=False)
    assert done.returncode == status, done.stderr
    assert all(words in done.stdout for words in said), done.stdout
