"""The weights that settings name: found, identified by content, and with their licenses. Imports no torch.

Every knob called `weights`, or ending in `_weights`, names some: a name of the registry, a hub id or a folder; empty is
none. Requests and records never hold the path of a folder, but its name and the first digits of its content.
"""

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.weights.locate import DIGEST_CACHE, content_name, digests, find_weights, given_folder, identity
from dg4d_lib.weights.lock import read_lock
from dg4d_lib.weights.registry import License, lookup_weights
from steps.store.files import home


@dataclass(frozen=True)
class Opened:
    """Weights that a step is about to load.

    Attributes:
        folder: where they lie.
        digests: of every file, for `StepReport.weights`.
        licenses: for `StepReport.licenses`.
    """

    folder: Path
    digests: dict[str, str]
    licenses: dict[str, str]


def weights_home() -> Path:
    """The folder of all weights: `$DG4D_WEIGHTS`, else `weights` under the home folder."""
    given = os.environ.get("DG4D_WEIGHTS")
    return Path(given).expanduser().absolute() if given else home() / "weights"


def open_weights(name: str) -> Opened:
    """Find weights for loading.

    Raises:
        BadInput: nothing can be called so.
        BackendUnavailable: they are not here or not whole; says which command mends it.
    """
    folder = find_weights(name, weights_home())
    files = _digests(name, folder)
    return Opened(
        folder=folder,
        digests={f"{name}/{file}": f"sha256:{digest}" for file, digest in files.items()},
        licenses={name: str(license_of(name))},
    )


def license_of(name: str) -> License:
    """What the registry says of weights, else the model card that was read when they were pulled."""
    locked = read_lock(weights_home()).get(name)
    return lookup_weights(name, locked.license if locked else "").license


def weights_in(tree: Mapping[str, Any]) -> Iterator[str]:
    """The weights that a dumped settings tree names, each once."""
    yield from dict.fromkeys(value for _, _, value in _places(tree))


def without_paths(tree: dict[str, Any]) -> dict[str, Any]:
    """Change a dumped settings tree so that folders are called by name and content; the same tree.

    Raises:
        BadInput: a folder that does not exist.
    """
    for branch, key, value in _places(tree):
        if (folder := given_folder(value)) is not None:
            branch[key] = content_name(folder, weights_home())
    return tree


def identities(names: Iterable[str]) -> dict[str, str]:
    """One digest for all that loading some weights may read, by name.

    Those that are not here are left out: a step may do without, and the one that cannot says so.

    Raises:
        BadInput: nothing can be called so.
    """
    found = {}
    for name in names:
        try:
            found[name] = identity(_digests(name, find_weights(name, weights_home())))
        except BackendUnavailable:
            continue
    return found


def require_same(weights: Mapping[str, str]) -> None:
    """Refuse weights that are not what a request was made for.

    Raises:
        BadInput: says which.
    """
    here = identities(weights)
    if changed := sorted(name for name, digest in weights.items() if here.get(name) != digest):
        raise BadInput(f"the weights {', '.join(changed)} changed in between; run the same command again")


def _digests(name: str, folder: Path) -> dict[str, str]:
    return digests(folder, lookup_weights(name).parts, weights_home() / DIGEST_CACHE)


def _places(tree: Any) -> Iterator[tuple[dict[str, Any], str, str]]:
    """Every knob that names weights: the branch it is in, its key, its value."""
    if not isinstance(tree, dict):
        return
    for key, value in tree.items():
        if isinstance(value, str) and value and (key == "weights" or key.endswith("_weights")):
            yield tree, key, value
        yield from _places(value)
