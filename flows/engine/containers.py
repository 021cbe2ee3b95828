"""Docker or Podman command lines that run a step with access to its own files only.

Folders have the same path inside and outside: the store, the scratch folder of the step, compiled kernels, and the
weights that the request names, which are read-only like the rest of the container. Credentials of an object store are
passed by name in the environment; no other variable of the caller is visible.
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
IMAGES = {  # by resource: environment variable that names the image, and its name in deploy/containers.sh
    "cpu": ("DG4D_IMAGE_CPU", "dg4d/cpu"),
    "gpu": ("DG4D_IMAGE_CUDA", "dg4d/cuda"),
}
ANSWER_S = 60.0  # time limit of a query to the engine
HANDED_ON = ("DG4D_CODE_VERSION", "OMP_NUM_THREADS")


@dataclass(frozen=True)
class Container:
    """Container of a step.

    Attributes:
        command: command line that runs it in the foreground; the arguments of `steps.main` are appended.
        engine: docker or podman.
        name: name of the container.
    """

    command: list[str]
    engine: str
    name: str

    def remove(self) -> None:
        """Kill and remove the container."""
        subprocess.run([self.engine, "rm", "--force", self.name], capture_output=True, timeout=ANSWER_S, check=False)


def container(request: StepRequest, folder: Path, store: str) -> Container:
    """Return the container for a step.

    Args:
        request: request of the step; a step that needs a GPU runs in the CUDA image.
        folder: its scratch folder, with `request.json`; the step writes `result.json` there.
        store: address of the artifact store.

    Raises:
        BackendUnavailable: the engine or the image is missing.
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
    """Return the container engine: `$DG4D_ENGINE`, else docker if its daemon answers, else podman.

    Raises:
        BackendUnavailable: neither runs containers here.
    """
    if given := os.environ.get("DG4D_ENGINE"):
        if Path(given).name not in ENGINES or shutil.which(given) is None:
            raise BackendUnavailable(f"$DG4D_ENGINE is {given!r}; give docker or podman, installed on this machine")
        return given
    return _answering_engine()


@functools.cache
def _answering_engine() -> str:
    for name in ENGINES:
        if shutil.which(name) is not None and _query([name, "ps", "--quiet"]) is not None:
            return name
    raise BackendUnavailable(
        "neither docker nor podman runs containers here: install one, or start its daemon, or unset $DG4D_EXECUTOR"
    )


@dataclass(frozen=True)
class _Image:
    id: str  # a tag could move to another image between query and run
    reference: str  # for the record: NAME@sha256:..., the registry's digest where it has one

    @property
    def key(self) -> str:
        return self.id.removeprefix("sha256:")[:12]


def _image(binary: str, name: str) -> _Image:
    """Look an image up by its name."""
    answer = _query([binary, "image", "inspect", name])
    if answer is None:
        raise BackendUnavailable(
            f"{binary} has no image {name}: build it with `deploy/containers.sh build`, or name another in "
            "$DG4D_IMAGE_CPU or $DG4D_IMAGE_CUDA"
        )
    facts = json.loads(answer)[0]
    content = str(facts["Id"]).removeprefix("sha256:")
    published = [reference for reference in facts.get("RepoDigests") or () if "@sha256:" in reference]
    return _Image(content, published[0] if published else f"{name.partition('@')[0]}@sha256:{content}")


def _query(command: list[str]) -> str | None:
    """Return the output of an engine command; None if it fails or times out."""
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=ANSWER_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout if done.returncode == 0 else None


def _as_caller(binary: str) -> Iterator[str]:
    """Keep the caller's user and group ids, which rootless podman would map to others."""
    if Path(binary).name == "podman" and os.getuid() != 0:
        yield from ("--userns", "keep-id")


def _limits(binary: str, resource: Resource) -> Iterator[str]:
    if memory := os.environ.get("DG4D_MEMORY"):
        yield from ("--memory", memory, "--memory-swap", memory)
    if resource == "gpu":
        yield from ("--device", "nvidia.com/gpu=all") if Path(binary).name == "podman" else ("--gpus", "all")


def _network(store: str) -> Iterator[str]:
    """Disable the network, unless the store is remote; a store on this machine needs the host network."""
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
    """Return the folder of all weights and the folders of requested weights outside of it."""
    if not request.weights:
        return []
    every = weights_home()
    found = (find_weights(name, every).absolute() for name in request.weights)
    elsewhere = (_hub_repository(place) for place in found if not place.is_relative_to(every))
    return sorted({every, *elsewhere})


def _hub_repository(place: Path) -> Path:
    """Return the folder to mount: a snapshot of the Hugging Face cache links to files beside its parent."""
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
            yield from ("--env", name)  # without the value, which `ps` would show to every user


def _hub_cache() -> Path:
    """Return the cache of the Hugging Face hub."""
    cache = os.environ.get("HF_HOME") or Path.home() / ".cache" / "huggingface"
    return Path(os.environ.get("HF_HUB_CACHE") or Path(cache) / "hub")
