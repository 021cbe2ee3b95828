"""The database of the background server: nobody is sent away because somebody else wrote."""

import asyncio
from pathlib import Path

import pytest
from prefect.server.database.configurations import AioSqliteConfiguration
from sqlalchemy import text
from sqlalchemy.exc import OperationalError

from flows.serving.server_app import OneWriter


def test_transactions_that_read_before_they_write_take_turns(tmp_path: Path) -> None:
    assert asyncio.run(_both_add_one(OneWriter, tmp_path)) == 2


def test_what_prefect_does_otherwise(tmp_path: Path) -> None:
    with pytest.raises(OperationalError, match="locked"):
        asyncio.run(_both_add_one(AioSqliteConfiguration, tmp_path))


async def _both_add_one(kind: type[AioSqliteConfiguration], folder: Path) -> int:
    """Two at once read a number, wait for each other a while, and add one to it."""
    database = kind(connection_url=f"sqlite+aiosqlite:///{folder / 'numbers.db'}")
    engine = await database.engine()
    read = asyncio.Barrier(2)

    async def add_one() -> None:
        async with await database.session(engine) as session, database.begin_transaction(session):
            await session.execute(text("SELECT value FROM number"))
            with_company = asyncio.wait_for(read.wait(), 0.5)
            await asyncio.gather(with_company, return_exceptions=True)  # whoever has the lock waits alone
            await session.execute(text("UPDATE number SET value = value + 1"))

    async with await database.session(engine) as session, session.begin():
        await session.execute(text("CREATE TABLE number AS SELECT 0 AS value"))
    try:
        await asyncio.gather(add_one(), add_one())
        async with await database.session(engine) as session:
            return int((await session.execute(text("SELECT value FROM number"))).scalar_one())
    finally:
        await engine.dispose()
