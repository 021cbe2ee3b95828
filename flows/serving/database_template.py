"""New database for Prefect's server, made once per installation: its migrations take seconds of every new home.

`python -m flows.serving.database_template` makes it beside the interpreter, for servers that start without a database.
"""

import shutil
import sqlite3
import subprocess
import sys
import tempfile
from contextlib import closing
from importlib.metadata import version
from pathlib import Path

from flows.processes import python, without_prefect

NAME = "prefect.db"  # in PREFECT_HOME


def template() -> Path:
    """Return where the new database of this Prefect is, if it was made."""
    return Path(sys.prefix) / "share" / "dg4d" / f"prefect-{version('prefect')}.db"


def make(path: Path) -> None:
    """Have Prefect make a new database, and write it as one file.

    Raises:
        CalledProcessError: Prefect cannot.
        OSError: there is no room, or the folder cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".new-") as folder:
        command = python("-m", "prefect", "server", "database", "upgrade", "--yes")
        subprocess.run(command, env=without_prefect() | {"PREFECT_HOME": folder}, stdout=subprocess.DEVNULL, check=True)
        whole = Path(folder) / "whole.db"
        with closing(sqlite3.connect(Path(folder) / NAME)) as database:
            database.execute("VACUUM INTO ?", [str(whole)])
        whole.replace(path)


def copy_to(prefect_home: Path) -> None:
    """Give a server without a database a copy; without a template the server makes its own."""
    if (prefect_home / NAME).exists() or not template().exists():
        return
    with tempfile.TemporaryDirectory(dir=prefect_home, prefix=".new-") as folder:
        Path(shutil.copyfile(template(), Path(folder) / NAME)).replace(prefect_home / NAME)


if __name__ == "__main__" and not template().exists():
    make(template())
