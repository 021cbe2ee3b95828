"""Places under `$DG4D_HOME`, private to the user, and the environment in which Prefect is imported."""

import os
import stat
from contextlib import suppress
from pathlib import Path

from dg4d_lib.errors import BadInput
from flows.serving.server import SETTINGS, Server
from steps.store.artifact_store import ArtifactStore
from steps.store.files import home
from steps.store.opening import open_store

OTHERS = 0o077  # permissions of group and others
CLIENT_SETTINGS = {
    "DO_NOT_TRACK": "1",
    "PREFECT_CLIENT_SERVER_VERSION_CHECK_ENABLED": "false",
    "PREFECT_TELEMETRY_ENABLE_RESOURCE_METRICS": "false",
    "PREFECT_SERVER_ANALYTICS_ENABLED": SETTINGS["PREFECT_SERVER_ANALYTICS_ENABLED"],
    "PREFECT_CLI_PROMPT": "false",
    "PREFECT_CLIENT_MAX_RETRIES": "7",  # four minutes: a database may be busy, a server begin again; 10: 34 minutes
    "PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL": "CRITICAL",  # the command says what matters; the rest goes to the server
}


def store() -> ArtifactStore:
    """Every artifact of this user: the folder `store` here, or what `$DG4D_STORE` names.

    Raises:
        BadInput: that is no address of a store.
    """
    make_private(home())
    return open_store()


def records() -> Path:
    """The folder that says what each request gave."""
    return home() / "results"


def locks() -> Path:
    """The folder of the locks of requests."""
    return home() / "locks"


def failures() -> Path:
    """The folder of pictures that explain why a step did not finish."""
    return home() / "failures"


def cutouts() -> Path:
    """Return the folder of pictures that show source, matte and cut-out side by side."""
    return home() / "cutouts"


def background_server() -> Server:
    """The server that commands share unless PREFECT_API_URL names another."""
    make_private(home())
    return Server(home() / "server", home() / "prefect")


def make_private(folder: Path) -> None:
    """Create a folder that only its owner can enter; close one that others can, with everything in it.

    Raises:
        BadInput: it belongs to somebody else.
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
    for path in folder.rglob("*"):
        with suppress(OSError):  # gone, or on a file system without permissions
            if not path.is_symlink():
                path.chmod(stat.S_IMODE(path.stat().st_mode) & ~OTHERS)


def set_environment(api_url: str) -> None:
    """Set what Prefect reads when it is imported: its server, its own folder, no telemetry. What the user set stays."""
    for name, value in {**CLIENT_SETTINGS, "PREFECT_HOME": str(home() / "prefect"), "PREFECT_API_URL": api_url}.items():
        os.environ.setdefault(name, value)


def set_own_server(server: Server, address: str) -> None:
    """As `set_environment`, for the background server, with its secret; a secret of another server does not count."""
    os.environ["PREFECT_API_AUTH_STRING"] = server.auth_string()
    set_environment(f"{address}/api")
