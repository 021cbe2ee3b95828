"""Download of weights from the Hugging Face hub into the weights folder, recorded in its lock."""

import errno
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.weights.locate import (
    DIGEST_CACHE,
    PARTIAL,
    READABLE_SUFFIXES,
    TENSOR_SUFFIXES,
    digests,
    find_missing,
    find_problems,
    folder_name,
    is_part,
)
from dg4d_lib.weights.lock import LockedFile, LockEntry, read_lock, write_lock
from dg4d_lib.weights.registry import Weights

HALF = ".fp16"  # part of the names of half-precision files
FORMATS = (
    (True, ".safetensors"),
    (False, ".safetensors"),
    (True, ".bin"),
    (False, ".bin"),
)  # (half precision, suffix), preferred first
BEGUN = f"{PARTIAL}/pull.incomplete"  # present until a pull is recorded; counts as an unfinished file


@dataclass(frozen=True)
class PullPlan:
    """Files of a download.

    Attributes:
        weights: entry of the registry.
        folder: destination.
        revision: commit on the hub.
        license: id on the model card; empty if the card has none.
        sizes: bytes of every needed file, by its path in the folder; 0 if the hub does not list it.
        published: sha256 of files whose digest is known before the download.
    """

    weights: Weights
    folder: Path
    revision: str
    license: str
    sizes: Mapping[str, int]
    published: Mapping[str, str]

    @property
    def total_bytes(self) -> int:
        """Size of all files."""
        return sum(self.sizes.values())

    @property
    def present_bytes(self) -> int:
        """Bytes that are here: whole files, and the beginnings of unfinished ones."""
        whole = {name for name, size in self.sizes.items() if _size_of(self.folder / name) == size}
        begun = sum(_size_of(path) for path in (self.folder / PARTIAL).rglob("*.incomplete"))
        missing = sum(size for name, size in self.sizes.items() if name not in whole)
        return self.total_bytes - missing + min(begun, missing)

    @property
    def missing_bytes(self) -> int:
        """Bytes to download."""
        return self.total_bytes - self.present_bytes


def pull(weights: Weights, home: Path) -> LockEntry:
    """Download the needed files of some weights; resume partial downloads and keep files that are complete.

    The revision is the lock's, else the registry's, else the newest.

    Returns:
        The new lock entry.

    Raises:
        BackendUnavailable: the hub cannot be reached or refuses access, or a file differs from the digest that the
            hub lists or the registry records.
        OSError: the disk is full.
    """
    return download(plan_pull(weights, home), home)


def plan_pull(weights: Weights, home: Path) -> PullPlan:
    """Return the files that a download needs, and remove damaged ones.

    Raises:
        BackendUnavailable: the hub cannot be reached or refuses access.
    """
    hub = _client()
    before = read_lock(home).get(weights.name)
    folder = home / folder_name(weights)
    for name in find_problems(folder, weights, before, home / DIGEST_CACHE):
        if (folder / name).is_file():
            (folder / name).unlink()  # the downloader may consider a damaged file complete
    with _hub_errors(weights):
        info = hub.HfApi().model_info(
            weights.hub_id, revision=before.revision if before else weights.revision, files_metadata=True
        )
    listed = info.siblings or []
    published = {file.rfilename: file.lfs.sha256 for file in listed if file.lfs is not None}
    if weights.revision in (None, info.sha):
        published |= weights.published
    selected = set(needed([file.rfilename for file in listed], weights.parts))
    sizes = {file.rfilename: int(file.size or 0) for file in listed if file.rfilename in selected}
    card = str(getattr(info.card_data, "license", None) or "")
    return PullPlan(weights, folder, info.sha or "", card, dict(sorted(sizes.items())), published)


def download(plan: PullPlan, home: Path) -> LockEntry:
    """Download the files of a plan, verify them and record them in the lock; see `pull`."""
    hub, weights, folder = _client(), plan.weights, plan.folder
    (folder / PARTIAL).mkdir(parents=True, exist_ok=True)
    (folder / BEGUN).touch()
    with _hub_errors(weights):
        hub.snapshot_download(
            weights.hub_id, revision=plan.revision or None, local_dir=folder, allow_patterns=list(plan.sizes)
        )
    have = {name: digest for name, digest in digests(folder, cache=home / DIGEST_CACHE).items() if name in plan.sizes}
    wrong = {name: "was not downloaded" for name in plan.sizes if name not in have}
    wrong |= find_missing(folder, weights.parts)
    for name in [name for name, digest in have.items() if plan.published.get(name, digest) != digest]:
        wrong[name] = "is damaged"
        (folder / name).unlink()
    if wrong:
        raise BackendUnavailable(
            f"the download of weights {weights.name} from {weights.hub_id} is incomplete: "
            f"{'; '.join(map(' '.join, wrong.items()))}; run `dg4d weights pull {weights.name}` again"
        )
    files = {name: LockedFile(sha256=have[name], size=(folder / name).stat().st_size) for name in plan.sizes}
    locked = LockEntry(hub_id=weights.hub_id, revision=plan.revision, license=plan.license, files=files)
    write_lock(home, weights.name, locked)
    (folder / BEGUN).unlink(missing_ok=True)
    return locked


def _client() -> Any:
    try:
        import huggingface_hub  # noqa: PLC0415 - an optional dependency
    except ModuleNotFoundError as error:
        raise BackendUnavailable(
            "downloading weights needs the package huggingface_hub; run `make setup CUDA=1`"
        ) from error
    return huggingface_hub


@contextmanager
def _hub_errors(weights: Weights) -> Iterator[None]:
    """Turn errors of the client in the block into one message; a full disk stays one."""
    try:
        yield
    except Exception as error:  # networks, proxies and servers fail in many ways
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise BackendUnavailable(_refusal(weights, error)) from error


def _size_of(path: Path) -> int:
    """Return the size of a file, -1 if there is none."""
    try:
        return path.stat().st_size
    except OSError:
        return -1


def needed(names: Iterable[str], parts: tuple[str, ...] = ()) -> list[str]:
    """Return the files of a repository to download: configurations, and the tensors of each folder in one format.

    Half precision is preferred to full, safetensors to pickles; single-file checkpoints beside `model_index.json`
    are left out, because the folders hold the same tensors.
    """
    everything = sorted(names)
    folders: dict[PurePosixPath, list[str]] = defaultdict(list)
    for name in everything:
        path = PurePosixPath(name)
        hidden = any(part.startswith(".") for part in path.parts)
        duplicate = "model_index.json" in everything and len(path.parts) == 1 and path.suffix in TENSOR_SUFFIXES
        other = ".non_ema." in name or path.name.startswith("openvino")
        wanted = is_part(path, parts) or path.name == "model_index.json" if parts else not duplicate
        if wanted and path.suffix in READABLE_SUFFIXES and not hidden and not other:
            folders[path.parent].append(name)
    return sorted(name for files in folders.values() for name in _one_format(files))


def _one_format(files: list[str]) -> list[str]:
    """Return the files of a folder without tensors, and those with tensors in the most preferred format."""

    def fits(name: str, half: bool, suffix: str) -> bool:
        return suffix in name and (HALF in name) == half

    tensors = [name for name in files if PurePosixPath(name).suffix in TENSOR_SUFFIXES]
    for half, suffix in FORMATS:
        if any(fits(name, half, suffix) for name in tensors):
            held = {name for name in files if name in tensors or ".index." in name}  # an index lists the shards
            return [name for name in files if name not in held or fits(name, half, suffix)]
    return files


def _refusal(weights: Weights, error: Exception) -> str:
    kind = type(error).__name__
    url = f"https://huggingface.co/{weights.hub_id}"
    if kind in ("GatedRepoError", "RepositoryNotFoundError"):
        remedy = f"accept its license at {url} and log in with `hf auth login`, or correct the id"
    elif kind == "RevisionNotFoundError":
        remedy = f"the pinned revision no longer exists; see {url}"
    else:
        remedy = (
            "connect this machine to the network and run the command again, or copy the folder from another machine "
            "and give its path"
        )
    reason = str(error).strip().splitlines()[0] if str(error).strip() else "no reason given"
    return f"weights {weights.name} could not be downloaded from {url} ({kind}: {reason}); {remedy}"
