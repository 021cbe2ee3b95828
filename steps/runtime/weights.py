"""Weights that settings name: their files, digests and licenses. Imports no torch.

Settings called `weights` or `*_weights` hold a name of the registry, a hub id or a folder; empty is none. So does
`matting`, unless it names a method that needs no further weights. Requests and records never hold the path of a folder,
but its name and the beginning of its digest.
"""

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.input_settings import MATTING_METHODS
from dg4d_lib.weights.card import card_license
from dg4d_lib.weights.locate import (
    CONTENT_MARK,
    DIGEST_CACHE,
    content_name,
    digests,
    find_weights,
    given_folder,
    identity,
)
from dg4d_lib.weights.lock import read_lock
from dg4d_lib.weights.registry import License, lookup_weights
from steps.store.files import home


@dataclass(frozen=True)
class LocatedWeights:
    """Installed weights.

    Attributes:
        folder: folder of their files.
        digests: digest of every file, for `StepReport.weights`.
        licenses: their license by name, for `StepReport.licenses`.
    """

    folder: Path
    digests: dict[str, str]
    licenses: dict[str, str]


def weights_home() -> Path:
    """Return the folder of all weights: `$DG4D_WEIGHTS`, else `weights` under the home folder.

    Raises:
        BadInput: `$DG4D_WEIGHTS` names a file.
    """
    given = os.environ.get("DG4D_WEIGHTS")
    if not given:
        return home() / "weights"
    folder = Path(given).expanduser().absolute()
    if folder.is_file():
        raise BadInput(f"$DG4D_WEIGHTS is not a folder: {folder}; name the folder of the weights")
    return folder


def open_weights(name: str) -> LocatedWeights:
    """Return installed weights by name.

    Raises:
        BadInput: the name is neither in the registry, nor a hub id, nor a folder.
        BackendUnavailable: they are not installed or not complete; says which command installs them.
    """
    folder = find_weights(name, weights_home())
    digests = {f"{name}/{file}": f"sha256:{digest}" for file, digest in _digests(name, folder).items()}
    return LocatedWeights(folder, digests, {name: str(license_of(name))})


def require_weights(names: Iterable[str]) -> None:
    """Refuse weights that are not installed.

    Raises:
        BadInput: a name is neither in the registry, nor a hub id, nor a folder.
        BackendUnavailable: names all that are missing or not complete, and the command that installs them.
    """
    missing = {}
    for name in names:
        try:
            open_weights(name)
        except BackendUnavailable as error:
            missing[name] = error
    if len(missing) == 1:
        raise next(iter(missing.values()))
    if missing:
        sizes = {name: lookup_weights(name).about_gb for name in missing}
        shown = ", ".join(f"{name} (about {size:g} GB)" if size else name for name, size in sizes.items())
        raise BackendUnavailable(
            f"weights are not on this machine, or not complete: {shown}; run `dg4d weights pull {' '.join(missing)}`"
        )


def license_of(name: str) -> License:
    """Return the license of weights from the registry, else by their files, their name or path, and their card."""
    if locked := read_lock(weights_home()).get(name):
        return lookup_weights(name, locked.license, locked.digests).license
    with suppress(BadInput, BackendUnavailable):
        if CONTENT_MARK in name or given_folder(name) is not None:
            folder = find_weights(name, weights_home())
            return lookup_weights(str(folder), card_license(folder), set(_digests(name, folder).values())).license
    return lookup_weights(name).license


def license_note(name: str) -> str:
    """Return a sentence about the license that was found for weights."""
    return f"License found for {name}: {license_of(name)}."


def offload_notes(offload: str) -> tuple[str, ...]:
    """Return a sentence for the run if networks were moved to the GPU in parts, else nothing."""
    parts = {"model": "one network at a time", "sequential": "layer by layer, which is slow"}
    return (
        (f"the networks did not fit on the GPU together and were moved there {parts[offload]}",)
        if offload in parts
        else ()
    )


def weights_in(tree: Mapping[str, Any]) -> Iterator[str]:
    """Yield the weights that a dumped settings tree names, each once."""
    yield from dict.fromkeys(value for _, _, value in _places(tree))


def without_paths(tree: dict[str, Any]) -> dict[str, Any]:
    """Replace folders in a dumped settings tree by their name and digest; change and return the same tree.

    Raises:
        BadInput: a folder does not exist.
    """
    for branch, key, value in _places(tree):
        if (folder := given_folder(value)) is not None:
            branch[key] = content_name(folder, weights_home())
    return tree


def identities(names: Iterable[str]) -> dict[str, str]:
    """Return one digest per weights, by name, without those that are not installed: steps that need these will raise.

    Raises:
        BadInput: a name is neither in the registry, nor a hub id, nor a folder.
    """
    found = {}
    for name in names:
        with suppress(BackendUnavailable):
            found[name] = identity(_digests(name, find_weights(name, weights_home())))
    return found


def check_unchanged(weights: Mapping[str, str]) -> None:
    """Refuse weights whose digests differ from those of a request.

    Raises:
        BadInput: names the weights that changed.
    """
    here = identities(weights)
    if changed := sorted(name for name, digest in weights.items() if here.get(name) != digest):
        raise BadInput(f"the weights {', '.join(changed)} changed in between; run the same command again")


def _digests(name: str, folder: Path) -> dict[str, str]:
    return digests(folder, lookup_weights(name).parts, weights_home() / DIGEST_CACHE)


def _places(tree: Any) -> Iterator[tuple[dict[str, Any], str, str]]:
    """Yield every setting that names weights: its section, key and value."""
    if not isinstance(tree, dict):
        return
    for key, value in tree.items():
        if isinstance(value, str) and value and _names_weights(key, value):
            yield tree, key, value
        yield from _places(value)


def _names_weights(key: str, value: str) -> bool:
    if key == "matting":
        return value not in MATTING_METHODS
    return key == "weights" or key.endswith("_weights")
