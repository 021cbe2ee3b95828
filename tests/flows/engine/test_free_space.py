import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from fake_steps import picture

from flows.engine.free_space import NEEDED_BYTES, require_free_space
from steps.store.files import DiskFull


@pytest.mark.parametrize(("free", "refused"), [(NEEDED_BYTES, False), (NEEDED_BYTES - 1, True), (0, True)])
def test_a_disk_with_less_than_is_needed_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free: int, refused: bool
) -> None:
    asked: list[Path] = []

    def usage(place: Path) -> SimpleNamespace:
        asked.append(place)
        return SimpleNamespace(free=free)

    monkeypatch.setattr(shutil, "disk_usage", usage)
    if refused:
        with pytest.raises(DiskFull, match=f"{free / 1e6:.1f} MB are free, and 67 MB are needed"):
            require_free_space(tmp_path / "not" / "there")
    else:
        require_free_space(tmp_path / "not" / "there")
    assert asked == [tmp_path]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    (tmp_path / "disk").mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(tmp_path / "disk")], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("mounts a disk of 2 MB, which only root may, outside of most containers")
    yield tmp_path / "disk"
    subprocess.run(["umount", str(tmp_path / "disk")], check=True)


def test_a_home_on_a_full_disk_is_named_at_once_and_no_server_is_started(small_disk: Path, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text(picture("a cat"))
    begun = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-m", "flows.cli", "make", "a.png", "-o", "out"],
        cwd=tmp_path,
        env={
            **os.environ, "DG4D_HOME": str(small_disk / "home"), "DG4D_CATALOG": "fake_steps:STEPS",
            "PYTHONPATH": str(Path(__file__).parents[1]),
        },
        capture_output=True,
        text=True,
        check=False,
    )  # fmt: skip
    assert (done.returncode, "is full" in done.stderr) == (65, True), done.stderr
    assert time.monotonic() - begun < 60
    assert not (small_disk / "home" / "server").exists()
