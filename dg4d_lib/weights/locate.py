"""Finding weights on this machine, whole: a folder, a name in the folder of all weights, or the Hugging Face cache."""

import hashlib
import json
import os
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.weights.lock import LockEntry, read_lock, write_json
from dg4d_lib.weights.registry import KNOWN, Weights, lookup_weights

TENSOR_SUFFIXES = frozenset([".safetensors", ".bin", ".pth", ".pt"])  # suffixes
READABLE_SUFFIXES = TENSOR_SUFFIXES | {".json", ".txt", ".model"}  # suffixes of what loading reads
NO_TENSORS = f"has no tensors ({', '.join(sorted(TENSOR_SUFFIXES))})"
DIGEST_CACHE = "digests.json"  # digests of large files, so that they are read once and not at every run
CONTENT_MARK = "@"  # between a folder's name and the first digits of its identity
CHUNK = 1 << 22  # bytes read at a time


def find_weights(name_or_folder: str | Path, home: Path | None = None) -> Path:
    """The folder (or the single file) of some weights; nothing is downloaded.

    Args:
        name_or_folder: a name of the registry, a hub id, or a folder, which is taken as it is.
        home: the folder of all weights, one folder per name; what was pulled into it is compared with its lock.

    Raises:
        BadInput: this can be neither a name nor a folder.
        BackendUnavailable: they are not here, or not whole; says which command mends it.
    """
    name = str(name_or_folder)
    if (path := given_folder(name_or_folder)) is not None:
        return path
    if CONTENT_MARK in name:
        return _called_by_content(name, home)
    weights = lookup_weights(name)
    if home is not None and (folder := home / folder_name(weights)).exists():
        locked = read_lock(home).get(weights.name)
        if wrong := find_problems(folder, weights, locked, home / DIGEST_CACHE):
            first = " ".join(next(iter(wrong.items()))) + ", and more" * (len(wrong) > 1)
            raise BackendUnavailable(
                f"weights {name} in {folder} are not whole: {first}; "
                f"`dg4d weights check {name}` lists what is wrong, `dg4d weights pull {name}` gets it again"
            )
        return folder
    cached = hub_cache_snapshot(weights)
    if cached is not None and not find_problems(cached, weights):
        return cached
    raise BackendUnavailable(f"weights {name} are not on this machine: `dg4d weights pull {name}` gets them")


def given_folder(name_or_folder: str | Path) -> Path | None:
    """The folder or file that a user named by its path; None for a name or a hub id.

    Raises:
        BadInput: a path that does not exist, or a name that nobody knows.
    """
    name = str(name_or_folder)
    path = Path(name).expanduser()
    if name in KNOWN and not isinstance(name_or_folder, Path):
        return None
    if path.exists():
        return path.absolute()
    if isinstance(name_or_folder, Path) or path.is_absolute() or name.startswith(".") or name.count("/") > 1:
        raise BadInput(f"weights {name}: there is no such folder")
    if "/" not in name and CONTENT_MARK not in name:
        raise BadInput(
            f"unknown weights {name!r}; give a folder, an id of the Hugging Face hub (owner/name), or one of: "
            f"{', '.join(KNOWN)}"
        )
    return None


def folder_name(weights: Weights) -> str:
    """What the folder of these weights is called within the folder of all weights."""
    return weights.name.replace("/", "--")


def content_name(folder: Path, home: Path) -> str:
    """A name for a user's folder that says its content and not its place; `home` remembers the place.

    Equal folders have equal names on every machine, so nothing that is made with them depends on where they lie.
    """
    home.mkdir(parents=True, exist_ok=True)
    name = f"{folder.stem}{CONTENT_MARK}{identity(digests(folder, memory=home / DIGEST_CACHE)).removeprefix('sha256:')[:12]}"
    link = home / name
    if not link.is_symlink() or link.readlink() != folder:
        scratch = home / f".{name}.{os.getpid()}"
        scratch.unlink(missing_ok=True)
        scratch.symlink_to(folder)
        scratch.replace(link)
    return name


def find_problems(
    folder: Path, weights: Weights, locked: LockEntry | None = None, memory: Path | None = None
) -> dict[str, str]:
    """What keeps weights from being whole: for a file or a part, what is wrong with it; nothing where they are whole.

    Args:
        folder: where they lie.
        weights: what they should be.
        locked: what was pulled; without it, only what is missing can be told.
        memory: as in `digests`.
    """
    if locked is None:
        return _lacking(folder, weights.parts)
    wrong: dict[str, str] = {}
    for name, file in locked.files.items():
        path = folder / name
        if not path.is_file():
            wrong[name] = "is missing"
        elif path.stat().st_size != file.size:
            wrong[name] = f"has {path.stat().st_size} bytes instead of {file.size}"
    have = _digests_of([folder / name for name in locked.files if name not in wrong], memory)
    changed = {path.relative_to(folder).as_posix(): digest for path, digest in have.items()}
    other = {name for name, digest in changed.items() if digest != locked.files[name].sha256}
    return wrong | dict.fromkeys(sorted(other), "is not the file that was pulled: its sha256 differs")


def find_unpublished(folder: Path, weights: Weights, memory: Path | None = None) -> dict[str, str]:
    """Files that are not what was published, and how so; files of which nothing is known, or that are not here, pass.

    Args:
        folder: where the weights lie.
        weights: what they should be.
        memory: as in `digests`.
    """
    have = _digests_of([path for name in weights.published if (path := folder / name).is_file()], memory)
    found = {path.relative_to(folder).as_posix(): digest for path, digest in have.items()}
    where = f" at revision {weights.revision[:10]}" if weights.revision else ""
    other = [name for name, digest in found.items() if digest != weights.published[name]]
    return dict.fromkeys(other, f"is not the file that was published{where}: its sha256 differs")


def digests(folder: Path, parts: tuple[str, ...] = (), memory: Path | None = None) -> dict[str, str]:
    """The sha256 (64 hexadecimal digits) of every file that loading may read, by its path within the folder.

    Args:
        folder: of some weights; or a single file.
        parts: only these; empty: everything.
        memory: a file that remembers digests by place, size and time of change, so that an unchanged file is not read
            again.
    """
    files = sorted(_files(folder, parts))
    root = folder if folder.is_dir() else folder.parent
    have = _digests_of(files, memory)
    return {path.relative_to(root).as_posix(): have[path] for path in files}


def identity(files: dict[str, str]) -> str:
    """One digest for all of `digests`: equal content under equal names has an equal identity, wherever it lies."""
    listing = json.dumps(files, sort_keys=True, separators=(",", ":"))
    return "sha256:" + hashlib.sha256(listing.encode()).hexdigest()


def hub_cache_snapshot(weights: Weights) -> Path | None:
    """What other programs downloaded: the snapshot of the pinned commit, else the newest; None where there is none."""
    if find_spec("huggingface_hub") is None:
        return None
    from huggingface_hub import constants  # noqa: PLC0415 - reads the environment when it is imported

    repository = Path(constants.HF_HUB_CACHE) / f"models--{weights.hub_id.replace('/', '--')}"
    main = repository / "refs" / "main"
    commits = [weights.revision or "", main.read_text(encoding="utf-8").strip() if main.is_file() else ""]
    snapshots = [repository / "snapshots" / commit for commit in commits if commit]
    return next((snapshot for snapshot in snapshots if snapshot.is_dir()), None)


def _called_by_content(name: str, home: Path | None) -> Path:
    link = home / name if home is not None else Path(name)
    if not link.exists():
        raise BackendUnavailable(f"the folder of the weights {name} is gone; name the folder once more where it is now")
    return link.readlink()


def _files(folder: Path, parts: tuple[str, ...]) -> Iterator[Path]:
    if folder.is_file():
        yield folder
        return
    for path in folder.rglob("*"):
        inside = path.relative_to(folder)
        wanted = not parts or inside.parts[0] in parts or inside.name == "model_index.json"
        if (
            wanted
            and path.suffix in READABLE_SUFFIXES
            and path.is_file()
            and not any(p.startswith(".") for p in inside.parts)
        ):
            yield path


def _lacking(folder: Path, parts: tuple[str, ...]) -> dict[str, str]:
    """Parts that are not there, models without tensors, and shards that an index names in vain."""
    lacking = {part: "is missing" for part in parts if not (folder / part).exists()}
    files = list(_files(folder, parts))
    if not any(path.suffix in TENSOR_SUFFIXES for path in files):
        lacking[folder.name] = NO_TENSORS
    for path in files:
        here = {other.name for other in files if other.parent == path.parent}
        if path.name == "config.json" and not any(Path(name).suffix in TENSOR_SUFFIXES for name in here):
            lacking[path.parent.name] = NO_TENSORS
        if path.name.endswith(".index.json"):
            shards = set(json.loads(path.read_text(encoding="utf-8")).get("weight_map", {}).values())
            lacking |= {f"{path.parent.name}/{shard}": "is missing" for shard in sorted(shards - here)}
    return lacking


def _digests_of(files: list[Path], memory: Path | None) -> dict[Path, str]:
    known = _remembered(memory)
    found: dict[Path, str] = {}
    fresh: dict[str, list[str]] = {}
    for path in files:
        facts = path.stat()
        key, stamp = str(path.resolve()), f"{facts.st_size} {facts.st_mtime_ns}"
        if key in known and known[key][0] == stamp:
            found[path] = known[key][1]
        else:
            found[path] = _sha256(path)
            fresh[key] = [stamp, found[path]]
    if fresh and memory is not None and memory.parent.is_dir():
        write_json(memory, {**_remembered(memory), **fresh})
    return found


def _remembered(memory: Path | None) -> dict[str, list[str]]:
    """What was computed before; a memory that is broken is no memory."""
    if memory is None:
        return {}
    try:
        return dict(json.loads(memory.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return {}


def _sha256(path: Path) -> str:
    content = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            content.update(chunk)
    return content.hexdigest()
