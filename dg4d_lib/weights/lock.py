"""What was pulled: revision, license, and the digest of every file. Later uses are compared with it.

`weights.lock.json` lies in the folder of all weights. Trust on first use: what the first pull got is right from then
on; copy the file to other machines to have the same there.
"""

import json
import os
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from dg4d_lib.errors import BadInput

LOCK = "weights.lock.json"


class LockedFile(BaseModel):
    """One file: its sha256 as 64 hexadecimal digits, and its size in bytes."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    sha256: str
    size: int


class LockEntry(BaseModel):
    """One set of weights as it was pulled.

    Attributes:
        hub_id: owner and repository.
        revision: the commit of the hub.
        license: what the model card calls it, for example "openrail++"; empty where it says nothing.
        files: by their path within the folder.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    hub_id: str
    revision: str
    license: str = ""
    files: dict[str, LockedFile]


def read_lock(home: Path) -> dict[str, LockEntry]:
    """Everything that was pulled into the folder `home`, by name; nothing where there is no lock.

    Raises:
        BadInput: the lock cannot be read.
    """
    path = home / LOCK
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        return {name: LockEntry.model_validate(entry) for name, entry in entries.items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, AttributeError, ValidationError) as error:
        raise BadInput(f"{path} cannot be read ({error}); delete it and pull the weights again") from error


def write_lock(home: Path, name: str, locked: LockEntry) -> None:
    """Remember what was pulled under a name, in place of what was there."""
    entries = {**read_lock(home), name: locked}
    write_json(home / LOCK, {key: entries[key].model_dump() for key in sorted(entries)})


def write_json(path: Path, content: object) -> None:
    """Write a JSON file so that a reader sees the old content or the new one, never a part."""
    scratch = path.with_name(f".{path.name}.{os.getpid()}")
    scratch.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    scratch.replace(path)
