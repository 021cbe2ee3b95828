"""Says what pip-audit found, from its JSON on standard input.

Exit status: 0 nothing is known against what could be audited · 1 weaknesses are known · 69 nothing could be audited, so
nothing is known either way.
"""

import json
import sys

SHOWN = 3  # packages that are named of those that could not be audited


def told(report: str) -> tuple[list[str], int]:
    """Lines for people, and the exit status."""
    try:
        found = json.loads(report)["dependencies"]
    except (ValueError, KeyError, TypeError):
        return ["audit: pip-audit gave no report; what it said stands above"], 69
    skipped = [package["name"] for package in found if "skip_reason" in package]
    audited = [package for package in found if "skip_reason" not in package]
    if not audited:
        return [f"audit: none of {len(found)} packages could be audited; the package index does not tell of any"], 69
    weak = [package for package in audited if package["vulns"]]
    lines = [
        f"audit: {package['name']} {package['version']}: {flaw['id']}, mended in "
        f"{', '.join(flaw['fix_versions']) or 'no version yet'}"
        for package in weak
        for flaw in package["vulns"]
    ]
    lines.append(f"audit: weaknesses are known of {len(weak)} of {len(audited)} packages")
    if skipped:
        names = ", ".join(skipped[:SHOWN]) + (", ..." if len(skipped) > SHOWN else "")
        lines.append(f"audit: {len(skipped)} more could not be audited ({names})")
    return lines, 1 if weak else 0


if __name__ == "__main__":
    said, status = told(sys.stdin.read())
    sys.stdout.writelines(f"{line}\n" for line in said)
    sys.exit(status)
