import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from alembic.config import Config
from alembic.script import ScriptDirectory
from prefect.server.database import orm_models
from sqlalchemy.engine import make_url

from flows.serving import database_template


def test_the_database_that_the_set_up_made_is_what_this_prefect_migrates_to() -> None:
    config = Config()
    migrations = Path(orm_models.__file__).parent / "_migrations"
    config.set_main_option("path_separator", "os")
    config.set_main_option("script_location", str(migrations))
    config.set_main_option("version_locations", str(migrations / "versions" / "sqlite"))
    with closing(sqlite3.connect(f"file:{database_template.template()}?mode=ro", uri=True)) as database:
        assert database.execute("SELECT version_num FROM alembic_version").fetchall() == [
            (head,) for head in ScriptDirectory.from_config(config).get_heads()
        ]
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert database.execute("SELECT count(*) FROM flow_run").fetchone() == (0,)


def test_a_server_without_a_database_begins_with_a_copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "new.db").write_bytes(b"new")
    monkeypatch.setattr(database_template, "template", lambda: tmp_path / "new.db")
    home = tmp_path / "home"
    home.mkdir()
    database_template.copy_to(home)
    assert [(path.name, path.read_bytes()) for path in home.iterdir()] == [(database_template.NAME, b"new")]


def test_a_database_that_is_there_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "new.db").write_bytes(b"new")
    monkeypatch.setattr(database_template, "template", lambda: tmp_path / "new.db")
    (tmp_path / database_template.NAME).write_bytes(b"old")
    database_template.copy_to(tmp_path)
    assert (tmp_path / database_template.NAME).read_bytes() == b"old"


def test_where_none_was_made_the_server_makes_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database_template, "template", lambda: tmp_path / "missing.db")
    database_template.copy_to(tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_copy_has_all_block_types_and_a_database_of_earlier_days_may_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not database_template.has_block_types(tmp_path)
    database_template.copy_to(tmp_path)
    assert database_template.has_block_types(tmp_path)
    with closing(sqlite3.connect(tmp_path / database_template.NAME)) as database, database:
        assert database.execute("DELETE FROM block_schema WHERE checksum IN (SELECT min(checksum) FROM block_schema)")
    assert not database_template.has_block_types(tmp_path)
    monkeypatch.setattr(database_template, "template", lambda: tmp_path / "missing.db")
    assert not database_template.has_block_types(tmp_path)


@pytest.mark.parametrize("name", ["plain", "what?", "100%41", "a b#c$d"])
def test_the_database_lies_in_the_home_folder_whatever_its_name(tmp_path: Path, name: str) -> None:
    address = make_url(database_template.address(tmp_path / name))
    assert (address.drivername, address.database) == ("sqlite+aiosqlite", str(tmp_path / name / "prefect.db"))
