"""Lock file of pulled weights: revision, license and the digest of every file.

`weights.lock.json` is in the weights folder. Trust on first use: the first pull records digests, later uses are
compared with them. Copy the file to other machines to pull the same files there.
"""

import json
import os
import threading
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from dg4d_lib.errors import BadInput

LOCK = "weights.lock.json"


class LockedFile(BaseModel):
    """Digest (sha256, 64 hexadecimal digits) and size in bytes of one file."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    sha256: str
    size: int


class LockEntry(BaseModel):
    """Record of one pull.

    Attributes:
        hub_id: owner and repository.
        revision: commit on the hub.
        license: id on the model card, for example "openrail++"; empty if the card has none.
        files: by their path in the folder.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    hub_id: str
    revision: str
    license: str = ""
    files: dict[str, LockedFile]

    @property
    def digests(self) -> set[str]:
        """Digests of all files."""
        return {file.sha256 for file in self.files.values()}


def read_lock(home: Path) -> dict[str, LockEntry]:
    """Read the lock of the weights folder `home`, by name; empty if there is no lock file.

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
    """Record a pull under a name, in place of an older record."""
    entries = {**read_lock(home), name: locked}
    write_json(home / LOCK, {key: entries[key].model_dump() for key in sorted(entries)})


def write_json(path: Path, content: object) -> None:
    """Write a JSON file atomically: a reader sees the old content or the new one."""
    scratch = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}")
    scratch.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    scratch.replace(path)
