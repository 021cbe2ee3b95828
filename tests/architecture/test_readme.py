"""Documents against the program: tree, commands, settings, files of a package, version."""

import re
import runpy
import tomllib
from pathlib import PurePosixPath

import pytest
import repository

import flows.cli
import flows.commands.endings
from dg4d_lib.assets.scenes.scene import Scene, SceneItem
from flows.inputs.manifest import parse_changes
from flows.inputs.package_record import RECORD
from flows.packages.report import BESIDE
from steps.artifacts import package_files
from steps.profiles import PROFILES, profile, revise
from steps.sources.banks import BankIndex

README = repository.text("README.md")
USAGE = repository.text("docs/usage.md")
README_LINES = 150
DOCUMENTS = [path for path in repository.files() if path.endswith(".md")]
FOLDED = (
    "tests/",
    "dg4d_lib/assets/viewer/src/",
    "docs/gallery/",
    "integrations/comfyui/workflows/",
)  # folders whose one line stands for everything in them
LINE = re.compile(r"( *)(\S+)(?: {2,}(\S.*))?")


def named_in(block: str) -> dict[str, str]:
    """The paths of a drawn tree, folders with a slash at the end, and what it says about each."""
    paths: dict[str, str] = {}
    above: list[str] = []
    for line in filter(None, block.splitlines()):
        match = LINE.fullmatch(line)
        assert match and len(match[1]) % 2 == 0, f"not a line of a tree: {line!r}"
        depth = len(match[1]) // 2
        assert depth <= len(above), f"indented below nothing: {line!r}"
        del above[depth:]
        paths["".join(above) + match[2]] = match[3] or ""
        if match[2].endswith("/"):
            above.append(match[2])
    return paths


def lost(named: dict[str, str], files: tuple[str, ...]) -> list[str]:
    """The lines that name nothing on disk."""
    folders = {f"{parent}/" for path in files for parent in PurePosixPath(path).parents}
    return sorted(set(named) - set(files) - folders)


def uncovered(named: dict[str, str], files: tuple[str, ...]) -> list[str]:
    """The files without a line: `__init__.py` is covered by its folder's, and so is all that is folded."""

    def covered(path: str) -> bool:
        folder = f"{PurePosixPath(path).parent}/"
        folded = any(path.startswith(above) and above in named for above in FOLDED)
        return path in named or folded or (path.endswith("__init__.py") and folder in named)

    return [path for path in files if not covered(path)]


TREE = named_in(repository.fenced(repository.text("ARCHITECTURE.md"), "## The tree"))


def test_every_line_of_the_tree_names_something_on_disk() -> None:
    assert not lost(TREE, repository.files())


def test_everything_on_disk_has_a_line_in_the_tree() -> None:
    assert not uncovered(TREE, repository.files())


def test_every_line_of_the_tree_says_something() -> None:
    assert not [path for path, meaning in TREE.items() if not meaning]


def test_a_tree_that_is_not_true_would_be_noticed() -> None:
    named = named_in("a/  folder\n  b.py  file\ntests/  folded\nlost.py  gone\n")
    files = ("a/__init__.py", "a/b.py", "a/new.py", "c.py", "tests/x/test_y.py")
    assert lost(named, files) == ["lost.py"]
    assert uncovered(named, files) == ["a/new.py", "c.py"]


def test_the_commands_of_make_in_documents_are_in_the_makefile() -> None:
    targets = set(re.findall(r"^([\w-]+):", repository.text("Makefile"), re.MULTILINE))
    commands = re.findall(r"^make (\w+)", repository.fenced(README, "## Install"), re.MULTILINE)
    assert commands == ["demo"]
    mentioned = set(re.findall(r"`make ([\w-]+)", "".join(repository.text(path) for path in DOCUMENTS)))
    assert {*commands, *mentioned} <= targets


def test_ci_runs_make_test_and_nothing_else() -> None:
    lines = [
        line for line in repository.text(".ci/run").splitlines() if line and not line.startswith(("#", "set ", "cd "))
    ]
    assert lines == ["exec make test"]


def test_the_changelog_has_this_version() -> None:
    version = tomllib.loads(repository.text("pyproject.toml"))["project"]["version"]
    assert re.search(
        rf"^## \[?{re.escape(version)}\]? - \d{{4}}-\d\d-\d\d$", repository.text("CHANGELOG.md"), re.MULTILINE
    )


def test_every_command_has_an_example_and_every_example_is_a_command() -> None:
    commands = {command.callback.__name__ for command in flows.cli.app.registered_commands if command.callback}
    commands |= {
        str(group.typer_instance.info.name) for group in flows.cli.app.registered_groups if group.typer_instance
    }
    commands |= {str(command.name) for command in flows.cli.app.registered_commands if command.name}
    commands -= {"list_settings"}
    mentioned = set(re.findall(r"(?:^|[` ])dg4d ([a-z]+)", USAGE, re.MULTILINE))
    assert mentioned == commands
    assert set(re.findall(r"(?:^|`)dg4d ([a-z]+)", README, re.MULTILINE)) <= commands | {"converts"}


@pytest.mark.parametrize("path", [path for path in DOCUMENTS if path not in {"docs/cli.md", "docs/settings.md"}])
def test_every_setting_in_a_document_can_be_set(path: str) -> None:
    pairs = re.findall(r"--set '?([^\s`']+=[^\s`']+)", repository.text(path))
    for pair in pairs:
        revise(profile("preview"), parse_changes([pair]))


def test_the_settings_of_the_models_of_open_can_be_set() -> None:
    table = repository.text("docs/gpu.md").split("\n## The profile open\n")[1].split("\n- `generate_views`")[0]
    rows = [
        re.findall(r"`([\w.]+)=([^`]+)`", line.split("|")[-2]) for line in table.splitlines() if line.startswith("|")
    ]
    assert sum(map(bool, rows)) == 3
    for row in rows:
        revise(profile("open"), parse_changes([f"{name}={value}" for name, value in row]))


def test_the_examples_of_data_formats_are_valid() -> None:
    page = repository.text("docs/data.md")
    items = Scene.model_validate_json(repository.fenced(page, "## Scene")).items
    default = SceneItem(package="demo").model_dump()
    assert items[0].model_dump() == default
    assert "and `duration_s`" in page and Scene(items=items).duration_s is None
    assert len(BankIndex.model_validate_json(repository.fenced(page, "## View bank")).views) == 2


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) <= README_LINES


@pytest.mark.parametrize("page", ["cli.md", "settings.md", "provenance.schema.json"])
def test_generated_pages_are_up_to_date(page: str) -> None:
    generated = runpy.run_path(str(repository.ROOT / "docs" / "generate.py"))["pages"]()
    assert generated[page] == repository.text(f"docs/{page}"), "run `make docs`"


@pytest.mark.parametrize("path", ["README.md", *(path for path in DOCUMENTS if path.startswith("docs/"))])
def test_numbers_have_a_leading_zero(path: str) -> None:
    assert not re.findall(r"(?<![\w.\])`/])\.\d+\b", repository.text(path))


def test_every_page_is_in_the_navigation_of_the_site() -> None:
    navigation = repository.text("docs/mkdocs.yml").split("\nnav:\n")[1]
    assert not [path for path in DOCUMENTS if path.startswith("docs/") and f" {path}\n" not in navigation]


def test_the_pictures_of_the_documents_are_small() -> None:
    sizes = {path: (repository.ROOT / path).stat().st_size for path in repository.files() if "docs/images/" in path}
    assert sizes and max(sizes.values()) <= 1_500_000


def test_every_profile_is_explained() -> None:
    assert not [name for name in PROFILES if f"`{name}`" not in README]


def test_the_exit_codes_are_those_of_the_command() -> None:
    codes = {value for name, value in vars(flows.commands.endings).items() if name.startswith("EXIT_")}
    section = USAGE.split("\n## Exit codes\n", 1)[1].split("\n## ", 1)[0]
    assert set(map(int, re.findall(r"^\| (\d+) \|", section, re.MULTILINE))) == {0, 2, *codes}


def test_every_file_of_a_package_is_explained() -> None:
    names = [value for name, value in vars(package_files).items() if name.isupper() and isinstance(value, str)]
    assert len(names) > 5
    assert not [name for name in (*names, RECORD, *BESIDE) if f"`{name}" not in repository.text("docs/package.md")]


def test_every_environment_variable_is_explained() -> None:
    name = re.compile(r"\bDG4D_[A-Z0-9_]*[A-Z0-9](?![A-Z0-9_])")
    code = "".join(repository.text(path) for path in repository.modules(*repository.PACKAGES, "integrations", "tests"))
    deployed = "".join(repository.text(path) for path in repository.files() if path.startswith("deploy/"))
    documents = "".join(repository.text(path) for path in DOCUMENTS)
    assert set(name.findall(code + deployed)) == set(name.findall(documents))
    assert set(name.findall(deployed)) <= set(name.findall(repository.text("docs/environment.md")))


@pytest.mark.parametrize("path", DOCUMENTS)
def test_every_link_leads_somewhere(path: str) -> None:
    folder = (repository.ROOT / path).parent
    links = [link for link in re.findall(r"\]\(([^)#\s]+)", repository.text(path)) if "://" not in link]
    assert not [link for link in links if not (folder / link).exists()]


def test_decisions_are_numbered_and_complete() -> None:
    entries = repository.text("DECISIONS.md").split("\n## ")[1:]
    assert [int(entry.split(".")[0]) for entry in entries] == list(range(1, len(entries) + 1))
    for entry in entries:
        words = re.findall(r"^(Choice|Reason|Price|Would change our mind): \S", entry, re.MULTILINE)
        assert words == ["Choice", "Reason", "Price", "Would change our mind"], entry.splitlines()[0]


def test_the_license_is_the_one_that_pyproject_names() -> None:
    assert tomllib.loads(repository.text("pyproject.toml"))["project"]["license"] == "Apache-2.0"
    license_text = repository.text("LICENSE")
    assert "Apache License" in license_text and "Version 2.0, January 2004" in license_text
    assert "Copyright 2026 the dg4d authors" in license_text
