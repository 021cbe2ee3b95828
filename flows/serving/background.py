"""Background server of this user."""

import os
from pathlib import Path

from flows.home import make_private, set_environment
from flows.serving.server import Server
from steps.store.files import home


def background_server() -> Server:
    """Return the server that commands share unless PREFECT_API_URL names another."""
    make_private(home())
    folder = home() / "server"
    return _used.get(folder) or Server(folder, home() / "prefect")


def set_own_server(server: Server, address: str) -> None:
    """Use the background server for the rest of this process.

    Calls `set_environment` with its secret in place of that of another server.
    """
    _used[server.folder] = server
    os.environ["PREFECT_API_AUTH_STRING"] = server.auth_string()
    set_environment(f"{address}/api")


_used: dict[Path, Server] = {}  # kept alive: a server ends when no process uses it
