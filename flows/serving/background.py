"""The background server that the commands of a user share."""

import os

from flows.home import make_private, set_environment
from flows.serving.server import Server
from steps.store.files import home


def background_server() -> Server:
    """The server that commands share unless PREFECT_API_URL names another."""
    make_private(home())
    return Server(home() / "server", home() / "prefect")


def set_own_server(server: Server, address: str) -> None:
    """As `set_environment`, for the background server, with its secret; a secret of another server does not count."""
    os.environ["PREFECT_API_AUTH_STRING"] = server.auth_string()
    set_environment(f"{address}/api")
