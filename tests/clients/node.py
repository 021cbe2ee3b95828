"""Other people's readers, run by Node.js: `make clients` installs what they need, from the locked list beside this."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

CLIENTS = Path(__file__).parent


def run_node(script: str, *arguments: str, timeout_s: float = 120.0) -> dict[str, Any]:
    """Run a script of this folder; gives the JSON object that it prints as its last line.

    Skips the test where Node.js, its packages or a browser is missing: a script says the latter by {"missing": "..."}.
    """
    node = shutil.which("node")
    if node is None:
        pytest.skip("Node.js is not here; install node 20 or later, then `make clients`")
    if not (CLIENTS / "node_modules").is_dir():
        pytest.skip("tests/clients/node_modules is not here; `make clients` installs it")
    done = subprocess.run(
        [node, str(CLIENTS / script), *arguments], capture_output=True, text=True, timeout=timeout_s, check=False
    )
    if done.returncode != 0:
        raise AssertionError(f"{script} ended with status {done.returncode}:\n{done.stdout}{done.stderr}")
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    if "missing" in result:
        pytest.skip(f"{result['missing']}; see `make clients`")
    return result
