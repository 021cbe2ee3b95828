"""Processes are told apart, also those of containers that have the name of their host."""

import subprocess
import sys

import pytest

from flows.processes import OWN_START, host_id, start_of

HOSTNAME_TOO = "import socket; from flows.processes import host_id; print(socket.gethostname(), host_id())"


def _said(*before: str) -> list[str]:
    done = subprocess.run([*before, sys.executable, "-c", HOSTNAME_TOO], capture_output=True, text=True, check=False)
    if before and done.returncode:
        pytest.skip("a process cannot have processes of its own here (it takes root)")
    return done.stdout.split()


def test_a_process_on_this_machine_is_in_the_same_place() -> None:
    assert _said()[1] == host_id()


def test_a_process_keeps_its_place_when_the_name_of_the_host_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    before = host_id()
    monkeypatch.setattr("socket.gethostname", lambda: "in-another-network")
    assert host_id() == before
    monkeypatch.setenv("DG4D_HOST_ID", "given")
    assert host_id() == "given"


def test_a_container_with_the_name_of_its_host_is_another_place() -> None:
    name, elsewhere = _said("unshare", "--pid", "--fork")
    assert name == _said()[0]
    assert elsewhere != host_id()


def test_the_start_of_a_process_is_known_as_long_as_it_lives() -> None:
    sleeping = subprocess.Popen(["sleep", "60"])
    assert int(start_of(sleeping.pid)) >= int(OWN_START) > 0
    sleeping.kill()
    sleeping.wait()
    assert start_of(sleeping.pid) == ""
