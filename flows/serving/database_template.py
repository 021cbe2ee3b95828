"""Database template for Prefect's server, created once per installation, since it takes seconds per new home.

It has the current tables and all block types, so that a server that starts from a copy registers none.

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
from urllib.parse import quote

from flows.processes import python, without_prefect

NAME = "prefect.db"  # in PREFECT_HOME
FILL = "import asyncio; from flows.prefect_compat import fill_database; asyncio.run(fill_database())"


def template() -> Path:
    """Return the path of the template for this version of Prefect; it need not exist."""
    return Path(sys.prefix) / "share" / "dg4d" / f"prefect-{version('prefect')}-filled.db"


def write_template(path: Path) -> None:
    """Let Prefect create and fill a database, and write it as one file.

    Raises:
        CalledProcessError: Prefect failed.
        OSError: the disk is full, or the folder cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".new-") as folder:
        command = python("-c", FILL)
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


def address(prefect_home: Path) -> str:
    """Return the address of the database for Prefect's server, whose own default does not quote the path."""
    return f"sqlite+aiosqlite:///{quote(str((prefect_home / NAME).absolute()))}"


def has_block_types(prefect_home: Path) -> bool:
    """Return true if the database has every block schema of the template."""
    try:
        here, wanted = (_block_schemas(path) for path in (prefect_home / NAME, template()))
    except sqlite3.Error:  # no database, no template, or tables of another version
        return False
    return bool(wanted) and wanted <= here


def _block_schemas(path: Path) -> set[str]:
    """Return the checksums of the block schemas of a database."""
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as database:
        return {checksum for (checksum,) in database.execute("SELECT checksum FROM block_schema")}


if __name__ == "__main__" and not template().exists():
    write_template(template())
