"""A step in a container: what docker or podman is told, so that it reaches its own files and nothing else.

Every folder has the same path inside as outside: the store, the scratch folder of this step, compiled kernels, and the
weights that the request names, which may only be read. The rest of the container cannot be written to. Secrets that
a store asks for are handed over by name in the environment; no other variable of the caller gets in.
"""

import functools
import json
import os
import shutil
import subprocess
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.weights.locate import find_weights
from flows.engine.resources import Resource, environment, resource_of
from steps.contract import StepRequest
from steps.runtime.weights import weights_home
from steps.store.endpoints import ENDPOINTS, LOOPBACK
from steps.store.files import home

ENGINES = ("docker", "podman")
IMAGES = {  # for steps that use a resource: which variable names the image, and what deploy/containers.sh calls it
    "cpu": ("DG4D_IMAGE_CPU", "dg4d/cpu"),
    "gpu": ("DG4D_IMAGE_CUDA", "dg4d/cuda"),
}
ANSWER_S = 60.0  # for an engine to answer a question
HANDED_ON = ("DG4D_CODE_VERSION", "OMP_NUM_THREADS")


@dataclass(frozen=True)
class Container:
    """One container that is about to run a step.

    Attributes:
        command: runs it in the foreground; the arguments of `steps.main` follow.
        engine: docker or podman.
        name: of the container.
    """

    command: list[str]
    engine: str
    name: str

    def remove(self) -> None:
        """End it at once, if it runs."""
        subprocess.run([self.engine, "rm", "--force", self.name], capture_output=True, timeout=ANSWER_S, check=False)


def container(request: StepRequest, folder: Path, store: str) -> Container:
    """The container of one step.

    Args:
        request: what it will do; whether it needs a GPU says which image.
        folder: its scratch folder, with `request.json`; `result.json` will be there.
        store: address of the artifacts.

    Raises:
        BackendUnavailable: there is no engine, or no such image.
    """
    binary, resource = engine(), resource_of(request)
    variable, usual = IMAGES[resource]
    image = _image(binary, os.environ.get(variable) or usual)
    kernels = home() / "kernels" / image.key
    own = f"dg4d-{request.step}-{uuid.uuid4().hex[:12]}"
    command = [
        *(binary, "run", "--rm", "--interactive", "--name", own, "--log-driver", "none"),
        *("--user", f"{os.getuid()}:{os.getgid()}", "--cap-drop", "all", "--security-opt", "no-new-privileges"),
        *("--read-only", "--tmpfs", "/tmp"),
        *_as_caller(binary),
        *_limits(binary, resource),
        *_network(store),
        *_mounts(request, folder, store, kernels),
        *_environment(store, folder, image, kernels),
        image.id,
    ]
    return Container(command=command, engine=binary, name=own)


def engine() -> str:
    """The program that runs containers: `$DG4D_ENGINE`, else docker where its daemon answers, else podman.

    Raises:
        BackendUnavailable: there is none.
    """
    if given := os.environ.get("DG4D_ENGINE"):
        if Path(given).name not in ENGINES or shutil.which(given) is None:
            raise BackendUnavailable(f"$DG4D_ENGINE is {given!r}; give docker or podman, installed on this machine")
        return given
    return _answering_engine()


@functools.cache
def _answering_engine() -> str:
    for name in ENGINES:
        if shutil.which(name) is not None and _ask([name, "ps", "--quiet"]) is not None:
            return name
    raise BackendUnavailable(
        "neither docker nor podman runs containers here: install one, or start its daemon, or unset $DG4D_EXECUTOR"
    )


@dataclass(frozen=True)
class _Image:
    id: str  # what is run: a name could come to mean another image in between
    reference: str  # for the record: NAME@sha256:..., where a registry knows it by its own digest

    @property
    def key(self) -> str:
        return self.id.removeprefix("sha256:")[:12]


def _image(binary: str, name: str) -> _Image:
    """The image that a name means now."""
    answer = _ask([binary, "image", "inspect", name])
    if answer is None:
        raise BackendUnavailable(
            f"{binary} has no image {name}: make it with `deploy/containers.sh build`, or pull it, or name another in "
            "$DG4D_IMAGE_CPU or $DG4D_IMAGE_CUDA"
        )
    facts = json.loads(answer)[0]
    content = str(facts["Id"]).removeprefix("sha256:")
    published = [reference for reference in facts.get("RepoDigests") or () if "@sha256:" in reference]
    return _Image(content, published[0] if published else f"{name.partition('@')[0]}@sha256:{content}")


def _ask(command: list[str]) -> str | None:
    """What an engine answers; None if it refuses or does not answer."""
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=ANSWER_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


def _as_caller(binary: str) -> Iterator[str]:
    """The caller's numbers mean the caller: a podman without root would map them to others."""
    if Path(binary).name == "podman" and os.getuid() != 0:
        yield from ("--userns", "keep-id")


def _limits(binary: str, resource: Resource) -> Iterator[str]:
    if memory := os.environ.get("DG4D_MEMORY"):
        yield from ("--memory", memory, "--memory-swap", memory)
    if resource == "gpu":
        yield from ("--device", "nvidia.com/gpu=all") if Path(binary).name == "podman" else ("--gpus", "all")


def _network(store: str) -> Iterator[str]:
    """None, but what an object store needs; one on this machine is reached through the machine's own network."""
    if "://" not in store:
        yield from ("--network", "none")
    elif any(urlsplit(os.environ.get(name, "")).hostname in LOOPBACK for name in ENDPOINTS):
        yield from ("--network", "host")


def _mounts(request: StepRequest, folder: Path, store: str, kernels: Path) -> Iterator[str]:
    written = [folder, kernels, *([] if "://" in store else [Path(store)])]
    for place in written:
        place.mkdir(parents=True, exist_ok=True)
        yield from ("--mount", f"type=bind,source={place},target={place}")
    for place in _weights(request):
        yield from ("--mount", f"type=bind,source={place},target={place},readonly")


def _weights(request: StepRequest) -> list[Path]:
    """The folder of all weights and, of those that the request names, what lies elsewhere."""
    if not request.weights:
        return []
    every = weights_home()
    found = (find_weights(name, every).absolute() for name in request.weights)
    elsewhere = (_hub_repository(place) for place in found if not place.is_relative_to(every))
    return sorted({every, *elsewhere})


def _hub_repository(place: Path) -> Path:
    """A snapshot of the Hugging Face cache is links to files in a folder beside it."""
    return place.parent.parent if place.parent.name == "snapshots" else place


def _environment(store: str, folder: Path, image: _Image, kernels: Path) -> Iterator[str]:
    values = {
        "DG4D_HOME": folder / "home",
        "DG4D_IMAGE": image.reference,
        "DG4D_WEIGHTS": weights_home(),
        "HF_HUB_CACHE": _hub_cache(),
        "HOME": folder,
        "NUMBA_CACHE_DIR": kernels,
        "TMPDIR": folder,
        **environment(),
    }
    for name, value in values.items():
        yield from ("--env", f"{name}={value}")
    secrets = [name for name in os.environ if name.startswith("AWS_")] if "://" in store else []
    for name in (*HANDED_ON, *secrets):
        if name in os.environ:
            yield from ("--env", name)  # without its value, which everyone could read in the list of processes


def _hub_cache() -> Path:
    """Where other programs keep what they downloaded from the Hugging Face hub."""
    cache = os.environ.get("HF_HOME") or Path.home() / ".cache" / "huggingface"
    return Path(os.environ.get("HF_HUB_CACHE") or Path(cache) / "hub")
