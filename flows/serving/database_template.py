"""Database template for Prefect's server, created once per installation, since migrations take seconds per new home.

`python -m flows.serving.database_template` writes it below `sys.prefix`; new servers start from a copy.
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
    """Return the path of the template for this version of Prefect; it need not exist."""
    return Path(sys.prefix) / "share" / "dg4d" / f"prefect-{version('prefect')}.db"


def write_template(path: Path) -> None:
    """Run Prefect's migrations on an empty database and write it as one file.

    Raises:
        CalledProcessError: the migrations failed.
        OSError: the disk is full, or the folder cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".new-") as folder:
        command = python("-m", "prefect", "server", "database", "upgrade", "--yes")
        subprocess.run(command, env=without_prefect() | {"PREFECT_HOME": folder}, stdout=subprocess.DEVNULL, check=True)
        vacuumed = Path(folder) / "vacuumed.db"
        with closing(sqlite3.connect(Path(folder) / NAME)) as database:
            database.execute("VACUUM INTO ?", [str(vacuumed)])
        vacuumed.replace(path)


def copy_to(prefect_home: Path) -> None:
    """Copy the template for a server without a database; without a template the server creates its own."""
    if (prefect_home / NAME).exists() or not template().exists():
        return
    with tempfile.TemporaryDirectory(dir=prefect_home, prefix=".new-") as folder:
        Path(shutil.copyfile(template(), Path(folder) / NAME)).replace(prefect_home / NAME)


if __name__ == "__main__" and not template().exists():
    write_template(template())
