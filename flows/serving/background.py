"""Background server of this user."""

import os

from flows.home import make_private, set_environment
from flows.serving.server import Server
from steps.store.files import home


def background_server() -> Server:
    """Return the server that commands share unless PREFECT_API_URL names another."""
    make_private(home())
    return Server(home() / "server", home() / "prefect")


def set_own_server(server: Server, address: str) -> None:
    """Call `set_environment` for the background server, with its secret in place of that of another server."""
    os.environ["PREFECT_API_AUTH_STRING"] = server.auth_string()
    set_environment(f"{address}/api")
