"""The time table from records that are made up."""

import hashlib
import json
from pathlib import Path

import pytest

from benchmarks.times import PAPER, average_rows, hardware_line, read_package_times, table

CPU = {"processor": "A Processor", "cores": "2", "system": "Linux"}
GPU = {**CPU, "gpu": "A GPU"}


def package(folder: Path, seconds: float, iterations: int = 200, machine: dict[str, str] = CPU) -> Path:
    folder.mkdir()
    (folder / "asset.glb").write_bytes(b"glb")
    digest = f"sha256:{hashlib.sha256(b'glb').hexdigest()}"
    refiner = {"kind": "video_to_video", "texture": {"iterations": 50}} if machine is GPU else {"kind": "identity"}
    steps = [
        {"step": "fit_gaussians", "settings": {"static": {"iterations": 500}}},
        {"step": "fit_motion", "settings": {"motion": {"iterations": iterations}}},
        {"step": "refine_texture", "settings": {"refiner": refiner}},
    ]
    ran = [
        {"step": step, "cached": False, "duration_s": duration_s, "machine": machine}
        for step, duration_s in (
            ("fit_gaussians", seconds),
            ("fit_motion", 2 * seconds),
            ("extract_mesh 1/2", 1.0),
            ("extract_mesh 2/2", 3.0),
        )
    ]
    record = {
        "files": {"asset.glb": {"digest": digest, "size_bytes": 3}},
        "steps": steps,
        "run": {"steps": [*ran, {"step": "refine_texture", "cached": True, "duration_s": 5.0, "machine": CPU}]},
    }
    (folder / "provenance.json").write_text(json.dumps(record))
    (folder / "report.json").write_text(json.dumps({"profile": "paper"}))
    return folder


def test_seconds_are_by_stage_and_parts_are_added_up(tmp_path: Path) -> None:
    row = read_package_times(package(tmp_path / "a", 10.0))
    assert row.seconds == {"static": 10, "dynamic": 20, "mesh": 4, "refinement": 5}
    assert row.total == 39
    assert row.profile == "paper"


def test_iterations_are_those_that_were_asked_for(tmp_path: Path) -> None:
    assert read_package_times(package(tmp_path / "a", 1.0)).iterations == {"static": 500, "dynamic": 200}
    assert read_package_times(package(tmp_path / "b", 1.0, machine=GPU)).iterations["refinement"] == 50


def test_machines_are_named_by_their_gpu_where_there_is_one(tmp_path: Path) -> None:
    assert hardware_line(GPU) == "A GPU"
    assert hardware_line(CPU) == "A Processor, 2 cores"
    assert hardware_line({}) == "not recorded"
    assert read_package_times(package(tmp_path / "a", 1.0, machine=GPU)).machine == "A GPU; A Processor, 2 cores"


def test_packages_of_a_kind_are_averaged_and_others_are_not(tmp_path: Path) -> None:
    rows = [
        read_package_times(package(tmp_path / "a", 10.0)),
        read_package_times(package(tmp_path / "b", 30.0)),
        read_package_times(package(tmp_path / "c", 50.0, iterations=100)),
        read_package_times(package(tmp_path / "d", 70.0, machine=GPU)),
    ]
    found = average_rows(rows)
    assert [row.packages for row in found] == [2, 1, 1]
    assert found[0].seconds["static"] == pytest.approx(20)
    assert table([*found, *PAPER]).row_count == 4


def test_the_papers_stages_add_up_to_its_totals() -> None:
    """6.5 minutes for both sorts of Gaussians, 10 with the texture, and a minute for the video."""
    seconds = PAPER[0].seconds
    assert seconds["static"] + seconds["dynamic"] == 6.5 * 60
    assert PAPER[0].total - seconds["video"] == 10 * 60
