"""Location and verification of weights: a path, a name in the weights folder, or the Hugging Face cache."""

import hashlib
import json
import os
import threading
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path, PurePath
from typing import Any

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.weights.lock import LockEntry, read_lock, write_json
from dg4d_lib.weights.registry import KNOWN, Weights, lookup_weights

TENSOR_SUFFIXES = frozenset([".safetensors", ".bin", ".pth", ".pt", ".onnx"])
READABLE_SUFFIXES = TENSOR_SUFFIXES | {".json", ".txt", ".model"}  # files that loading may read
NO_TENSORS = f"has no tensors ({', '.join(sorted(TENSOR_SUFFIXES))})"
DIGEST_CACHE = "digests.json"  # sha256 of large files, so that they are hashed once and not at every run
PARTIAL = ".cache/huggingface/download"  # in the folder of a download: the hub's client keeps unfinished files here
CONTENT_MARK = "@"  # separates a folder's name from the first digits of its content digest
CHUNK = 1 << 22  # bytes hashed at a time


def find_weights(name_or_folder: str | Path, home: Path | None = None) -> Path:
    """Return the folder (or the single file) of some weights; download nothing.

    Args:
        name_or_folder: a name of the registry, a hub id, or a folder, which is used as it is.
        home: the weights folder, with one subfolder per name; pulled files are compared with its lock.

    Raises:
        BadInput: neither a known name nor an existing folder.
        BackendUnavailable: the weights are missing or incomplete; the message names the command to run.
    """
    name = str(name_or_folder)
    if (path := given_folder(name_or_folder)) is not None:
        return path
    if CONTENT_MARK in name:
        return _linked_folder(name, home)
    weights = lookup_weights(name)
    if home is not None and (folder := home / folder_name(weights)).exists():
        locked = read_lock(home).get(weights.name)
        if wrong := find_problems(folder, weights, locked, home / DIGEST_CACHE):
            first = " ".join(next(iter(wrong.items()))) + ", and more" * (len(wrong) > 1)
            raise BackendUnavailable(
                f"weights {name} in {folder} are incomplete or changed: {first}; "
                f"`dg4d weights check {name}` lists all problems, `dg4d weights pull {name}` downloads them again"
            )
        return folder
    cached = hub_cache_snapshot(weights)
    if cached is not None and not find_problems(cached, weights):
        return cached
    raise BackendUnavailable(f"weights {name} are not on this machine; run `dg4d weights pull {name}`")


def given_folder(name_or_folder: str | Path) -> Path | None:
    """Return the folder or file that the user gave as a path; None for a name or a hub id.

    Raises:
        BadInput: a path that does not exist, or an unknown name.
    """
    name = str(name_or_folder)
    path = Path(name).expanduser()
    if name in KNOWN and not isinstance(name_or_folder, Path):
        return None
    if path.exists():
        return path.absolute()
    if isinstance(name_or_folder, Path) or path.is_absolute() or name.startswith(".") or name.count("/") > 1:
        raise BadInput(f"weights {name}: there is no such folder or file; give an existing path")
    if "/" not in name and CONTENT_MARK not in name:
        raise BadInput(
            f"unknown weights {name!r}; give a folder, an id of the Hugging Face hub (owner/name), or one of: "
            f"{', '.join(KNOWN)}"
        )
    return None


def folder_name(weights: Weights) -> str:
    """Return the name of the subfolder of these weights in the weights folder."""
    return weights.name.replace("/", "--")


def content_name(folder: Path, home: Path) -> str:
    """Return a name for a user's folder that depends on its content alone; a link in `home` records its path.

    Equal folders have equal names on every machine, so results do not depend on the path of the weights.
    """
    home.mkdir(parents=True, exist_ok=True)
    digest = identity(digests(folder, cache=home / DIGEST_CACHE)).removeprefix("sha256:")
    name = f"{folder.stem}{CONTENT_MARK}{digest[:12]}"
    link = home / name
    if not link.is_symlink() or link.readlink() != folder:
        scratch = home / f".{name}.{os.getpid()}-{threading.get_ident()}"
        scratch.unlink(missing_ok=True)
        scratch.symlink_to(folder)
        scratch.replace(link)
    return name


def find_problems(
    folder: Path, weights: Weights, locked: LockEntry | None = None, cache: Path | None = None
) -> dict[str, str]:
    """Return the problem of every missing or changed file; empty if the weights are complete.

    Args:
        folder: of the weights.
        weights: their entry of the registry.
        locked: the lock entry of the pull; without one, only missing files and unfinished downloads are found.
        cache: as in `digests`.
    """
    if locked is None:
        begun = any((folder / PARTIAL).rglob("*.incomplete"))
        return find_missing(folder, weights.parts) | ({PARTIAL: "has unfinished files"} if begun else {})
    wrong: dict[str, str] = {}
    for name, file in locked.files.items():
        path = folder / name
        if not path.is_file():
            wrong[name] = "is missing"
        elif path.stat().st_size != file.size:
            wrong[name] = f"has {path.stat().st_size} bytes, recorded are {file.size}"
    have = _digests_of([folder / name for name in locked.files if name not in wrong], cache)
    changed = {path.relative_to(folder).as_posix(): digest for path, digest in have.items()}
    other = {name for name, digest in changed.items() if digest != locked.files[name].sha256}
    return wrong | dict.fromkeys(sorted(other), "differs from the pulled file (sha256)")


def find_missing(folder: Path, parts: tuple[str, ...]) -> dict[str, str]:
    """Return missing parts and shards, models without tensors, and lists of them that cannot be read.

    Args:
        folder: of the weights.
        parts: needed folders or files; empty: the folders that model_index.json lists.
    """
    missing = {part: "is missing" for part in parts if not (folder / part).exists()}
    files = list(_files(folder, parts))
    if not any(path.suffix in TENSOR_SUFFIXES for path in files):
        missing[folder.name] = NO_TENSORS
    for path in files:
        here = {other.name for other in files if other.parent == path.parent}
        if path.name == "config.json" and not any(Path(name).suffix in TENSOR_SUFFIXES for name in here):
            missing[path.parent.name] = NO_TENSORS
        try:
            if path.name.endswith(".index.json"):
                shards = set(json.loads(path.read_text(encoding="utf-8")).get("weight_map", {}).values())
                absent = [path.with_name(shard).relative_to(folder).as_posix() for shard in sorted(shards - here)]
                missing |= dict.fromkeys(absent, "is missing")
            elif path == folder / "model_index.json" and not parts:
                listed = _components(json.loads(path.read_text(encoding="utf-8")))
                missing |= {name: "is missing" for name in listed if not (folder / name).is_dir()}
        except (OSError, ValueError, TypeError, AttributeError):
            missing[path.relative_to(folder).as_posix()] = "cannot be read"
    return missing


def find_unpublished(folder: Path, weights: Weights) -> dict[str, str]:
    """Return the problem of every file that differs from its published digest; unknown and missing files pass.

    Args:
        folder: of the weights.
        weights: their entry of the registry.
    """
    have = _digests_of([path for name in weights.published if (path := folder / name).is_file()], None)
    found = {path.relative_to(folder).as_posix(): digest for path, digest in have.items()}
    where = f" at revision {weights.revision[:10]}" if weights.revision else ""
    other = [name for name, digest in found.items() if digest != weights.published[name]]
    return dict.fromkeys(other, f"differs from the published file{where} (sha256)")


def digests(folder: Path, parts: tuple[str, ...] = (), cache: Path | None = None) -> dict[str, str]:
    """Return the sha256 (64 hexadecimal digits) of every file that loading may read, by its path in the folder.

    Args:
        folder: of the weights; or a single file.
        parts: subfolders to read; empty: all.
        cache: a JSON file of digests by path, size and modification time, so that an unchanged file is not hashed
            again.
    """
    files = sorted(_files(folder, parts))
    root = folder if folder.is_dir() else folder.parent
    have = _digests_of(files, cache)
    return {path.relative_to(root).as_posix(): have[path] for path in files}


def is_part(path: PurePath, parts: tuple[str, ...]) -> bool:
    """Return True for a file that is one of the parts, or in a folder that is."""
    return path.parts[0] in parts or path.as_posix() in parts


def identity(files: dict[str, str]) -> str:
    """Return one digest of the result of `digests`; it depends on names and content, not on the folder's path."""
    listing = json.dumps(files, sort_keys=True, separators=(",", ":"))
    return "sha256:" + hashlib.sha256(listing.encode()).hexdigest()


def hub_cache_snapshot(weights: Weights) -> Path | None:
    """Return the Hugging Face cache's snapshot of the pinned commit, else of `main`; None if there is neither."""
    if find_spec("huggingface_hub") is None:
        return None
    from huggingface_hub import constants  # noqa: PLC0415 - reads the environment on import

    repository = Path(constants.HF_HUB_CACHE) / f"models--{weights.hub_id.replace('/', '--')}"
    main = repository / "refs" / "main"
    commits = [weights.revision or "", main.read_text(encoding="utf-8").strip() if main.is_file() else ""]
    snapshots = [repository / "snapshots" / commit for commit in commits if commit]
    return next((snapshot for snapshot in snapshots if snapshot.is_dir()), None)


def _linked_folder(name: str, home: Path | None) -> Path:
    link = home / name if home is not None else Path(name)
    if not link.exists():
        raise BackendUnavailable(f"the folder of the weights {name} no longer exists; give its new path")
    return link.readlink()


def _files(folder: Path, parts: tuple[str, ...]) -> Iterator[Path]:
    if folder.is_file():
        yield folder
        return
    for path in folder.rglob("*"):
        inside = path.relative_to(folder)
        wanted = not parts or is_part(inside, parts) or inside.name == "model_index.json"
        if (
            wanted
            and path.suffix in READABLE_SUFFIXES
            and path.is_file()
            and not any(p.startswith(".") for p in inside.parts)
        ):
            yield path


def _components(model_index: dict[str, Any]) -> list[str]:
    """Return the folders of a pipeline of diffusers; an absent component is a list of nulls.

    A name with a path would lead out of the folder: it is not a component, and a pull would remove files there.
    """
    return [
        name
        for name, classes in model_index.items()
        if not name.startswith(("_", "."))
        and PurePath(name).name == name
        and isinstance(classes, list)
        and any(classes)
    ]


def _digests_of(files: list[Path], cache: Path | None) -> dict[Path, str]:
    known = _cached(cache)
    found: dict[Path, str] = {}
    computed: dict[str, list[str]] = {}
    for path in files:
        status = path.stat()
        key, stamp = str(path.resolve()), f"{status.st_size} {status.st_mtime_ns}"
        if key in known and known[key][0] == stamp:
            found[path] = known[key][1]
        else:
            found[path] = _sha256(path)
            computed[key] = [stamp, found[path]]
    if computed and cache is not None and cache.parent.is_dir():
        write_json(cache, {**_cached(cache), **computed})
    return found


def _cached(cache: Path | None) -> dict[str, list[str]]:
    """Return cached digests; a missing or unreadable cache counts as empty, because digests can be computed again."""
    if cache is None:
        return {}
    try:
        return dict(json.loads(cache.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return {}


def _sha256(path: Path) -> str:
    content = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            content.update(chunk)
    return content.hexdigest()
