"""Program of the background server.

`python -m flows.serving.server_program FD` serves the application on a listening socket that it inherits.
"""

import socket
import sys

import uvicorn

from steps.runtime.process_setup import garbage_collection_paused


def serve(listener: socket.socket) -> None:
    """Serve the application on a bound socket until the process is stopped."""
    with garbage_collection_paused():
        from flows.serving.server_app import create_app  # noqa: PLC0415 - a slow import

        config = uvicorn.Config(create_app(), log_level="warning")
    uvicorn.Server(config).run(sockets=[listener])


if __name__ == "__main__":
    serve(socket.socket(fileno=int(sys.argv[1])))
