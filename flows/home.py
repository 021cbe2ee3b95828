"""The places under `$DG4D_HOME`, and the environment in which Prefect is imported."""

import os
from pathlib import Path

from flows.serving.server import SETTINGS, Server
from steps.opening import open_store
from steps.store import ArtifactStore, home

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
    return Server(home() / "server", home() / "prefect")


def set_environment(api_url: str) -> None:
    """What Prefect reads when it is imported: its server, its own folder, no telemetry. What the user set stays."""
    for name, value in {**CLIENT_SETTINGS, "PREFECT_HOME": str(home() / "prefect"), "PREFECT_API_URL": api_url}.items():
        os.environ.setdefault(name, value)
