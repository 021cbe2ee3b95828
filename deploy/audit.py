"""Summary of pip-audit's findings, from its JSON reports.

    python deploy/audit.py REPORT...

Exit code: 0 no known vulnerability in the audited packages; 1 known vulnerabilities; 69 a report has no audited
package, so nothing is known about its packages.
"""

import json
import sys
from pathlib import Path

SHOWN = 3  # packages that are named of those that could not be audited


def summary(reports: list[str]) -> tuple[list[str], int]:
    """Return the lines to print and the exit code."""
    lines: list[str] = []
    found = {}
    incomplete = False
    for report in reports:
        try:
            packages = json.loads(report)["dependencies"]
        except (ValueError, KeyError, TypeError):
            lines.append("audit: pip-audit wrote no report; its message is above")
            incomplete = True
            continue
        if all("skip_reason" in package for package in packages):
            lines.append(f"audit: none of {len(packages)} packages could be audited; the package index has no data")
            incomplete = True
        found |= {(package["name"], package.get("version")): package for package in packages}
    audited = [package for package in found.values() if "skip_reason" not in package]
    vulnerable = [package for package in audited if package["vulns"]]
    lines += [
        f"audit: {package['name']} {package['version']}: {flaw['id']}, fixed in "
        f"{', '.join(flaw['fix_versions']) or 'no version yet'}"
        for package in vulnerable
        for flaw in package["vulns"]
    ]
    if audited:
        lines.append(f"audit: vulnerabilities are known of {len(vulnerable)} of {len(audited)} packages")
        if skipped := [name for (name, _), package in found.items() if "skip_reason" in package]:
            names = ", ".join(skipped[:SHOWN]) + (", ..." if len(skipped) > SHOWN else "")
            lines.append(f"audit: {len(skipped)} more could not be audited ({names})")
    return lines, 1 if vulnerable else 69 if incomplete else 0


if __name__ == "__main__":
    said, status = summary([Path(name).read_text(encoding="utf-8") for name in sys.argv[1:]])
    sys.stdout.writelines(f"{line}\n" for line in said)
    sys.exit(status)
