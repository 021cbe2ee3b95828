"""A restart of the server in the middle of a conversion: nothing of the studio lives in its memory."""

import json

import pytest
from fake_steps import picture
from waiting import wait_until

from flows.serving.workers import Worker, running
from tests.flows.studio.conftest import Client


@pytest.mark.slow
def test_a_restart_of_the_server_loses_nothing(studio: Client) -> None:
    draft = studio.draft(("lynx.png", picture("a lynx fit_motion=sleep:8").encode()))
    run = studio.post(f"/drafts/{draft}/runs", {})[1]["id"]
    wait_until(lambda: json.loads(studio.read(f"/runs/{run}/status")[1])["state"] == "running")
    studio.server.stop()
    studio.server.start()
    address = studio.server.wait()
    Worker("process-cpu", studio.server.folder).start(address)
    wait_until(lambda: running(studio.server.folder))
    status = studio.ended(run)
    assert (status["state"], status["message"]) == ("done", "")
    assert studio.read(f"/drafts/{draft}")[0] == 200
    assert studio.read(status["asset"].removeprefix("/dg4d/studio"))[0] == 200
