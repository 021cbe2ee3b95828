"""Private folders under `$DG4D_HOME`, and the environment for the import of Prefect."""

import os
import stat
from contextlib import suppress
from pathlib import Path

from dg4d_lib.errors import BadInput
from steps.store.artifact_store import ArtifactStore
from steps.store.files import home, walk
from steps.store.opening import open_store

OTHERS = 0o077  # permission bits of group and others
CLIENT_SETTINGS = {
    "DO_NOT_TRACK": "1",
    "PREFECT_CLIENT_SERVER_VERSION_CHECK_ENABLED": "false",
    "PREFECT_TELEMETRY_ENABLE_RESOURCE_METRICS": "false",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_CLI_PROMPT": "false",
    "PREFECT_CLIENT_MAX_RETRIES": "7",  # 4 minutes, enough for a restart of the server; 10 are 34 minutes
    "PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL": "CRITICAL",  # commands print their own messages; logs go to the server
    "PREFECT_LOGGING_INTERNAL_LEVEL": "CRITICAL",  # of threads that lose the server; their callers try again
}


def store() -> ArtifactStore:
    """Return the artifact store: `$DG4D_STORE`, by default the folder `store` under `$DG4D_HOME`.

    Raises:
        BadInput: `$DG4D_STORE` is not the address of a store.
    """
    make_private(home())
    return open_store()


def records() -> Path:
    """Return the folder of the result records of steps."""
    return home() / "results"


def locks() -> Path:
    """Return the folder of lock files."""
    return home() / "locks"


def failures() -> Path:
    """Return the folder of pictures that explain failures."""
    return home() / "failures"


def cutouts() -> Path:
    """Return the folder of pictures that show source, matte and cut-out side by side."""
    return home() / "cutouts"


def first_looks() -> Path:
    """Return the folder of pages that show the static splats of assets whose motion is being fitted."""
    return home() / "first-looks"


def studio() -> Path:
    """Return the folder of the studio page: uploads, and the packages that it asked for."""
    return home() / "studio"


def uploads() -> Path:
    """Return the folder of files that were handed in through the studio page."""
    return studio() / "uploads"


def studio_assets() -> Path:
    """Return the output folder of conversions that the studio page started."""
    return studio() / "assets"


def make_private(folder: Path) -> None:
    """Create a folder with mode 0700, or remove the permissions of others from an existing one and its content.

    Raises:
        BadInput: it belongs to another user.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not folder.stat().st_mode & OTHERS:
        return
    try:
        folder.chmod(0o700)
    except PermissionError as error:
        raise BadInput(
            f"{folder} can be read by other users and belongs to one of them; set DG4D_HOME to a folder of your own"
        ) from error
    if folder.stat().st_mode & OTHERS:
        return  # a file system without permissions
    for path in walk(folder):
        with suppress(OSError):  # removed meanwhile, or a file system without permissions
            if not path.is_symlink():
                path.chmod(stat.S_IMODE(path.stat().st_mode) & ~OTHERS)


def set_environment(api_url: str) -> None:
    """Set Prefect's server, home folder and client settings before its import; variables set by the user win."""
    for name, value in {**CLIENT_SETTINGS, "PREFECT_HOME": str(home() / "prefect"), "PREFECT_API_URL": api_url}.items():
        os.environ.setdefault(name, value)
