"""Nodes for ComfyUI in a stand-in of its loader and executor, with the real worker and tiny settings."""

import json
import os
import shutil
import sys
import time
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from comfy_stand_in import Comfy, InterruptProcessingException, running
from PIL import Image

from steps.profiles import PROFILES, revise
from steps.profiles import profile as named_profile

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "integrations" / "comfyui"
QUICK = """
subject.size=64
driving.frames=4  # of the paper's 14
static.iterations=10
static.views=1
static.start.points=400
static.reference_size=48
static.resolution_schedule=[{"until": 1.0, "size": 48}]
motion.iterations=8
motion.reference_size=48
motion.resolution_schedule=[{"until": 1.0, "size": 48}]
mesh.grid=32
mesh.edge_length=0.06
mesh.texture_size=128
mesh.render_size=96
pack.preview_size=64
pack.preview_turns=1
pack.sheet_size=48
pack.sheet_frames=2
"""
WIDGETS = {"STRING", "INT", "FLOAT"}
SPECIAL = {"ASSET_4D", "IMAGE", "MASK", "STRING", "INT", "FLOAT"}


@pytest.fixture(scope="module")
def comfy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Comfy]:
    place = tmp_path_factory.mktemp("comfy")
    with running(place / "output") as comfy, pytest.MonkeyPatch.context() as patch:
        patch.setenv("DG4D_PYTHON", sys.executable)
        patch.setenv("DG4D_HOME", str(place / "home"))
        patch.setenv("PYTHONPATH", str(place))  # of ComfyUI, not of dg4d
        comfy.output.mkdir()
        comfy.load_custom_node(FOLDER)
        comfy.classes |= {"LoadImage": load_image(ROOT / "examples" / "newt.png"), "LoadFrames": LoadFrames}
        comfy.classes["Keep"] = keeper(kept := {})
        vars(comfy)["kept"] = kept
        yield comfy


@pytest.fixture(scope="module")
def module(comfy: Comfy) -> types.ModuleType:
    """The nodes' module `client`, as the loader named it."""
    return sys.modules[str(FOLDER).replace(".", "_x_") + ".client"]


def load_image(path: Path) -> type:
    """Return a node like Load Image: color "1 h w 3", and a mask that is 1 where the picture is transparent."""

    class LoadImage:
        RETURN_TYPES = ("IMAGE", "MASK")
        FUNCTION = "load_image"

        @classmethod
        def INPUT_TYPES(cls) -> dict[str, Any]:
            return {"required": {"image": ("STRING", {})}}

        def load_image(self, image: str) -> tuple[torch.Tensor, torch.Tensor]:
            pixels = torch.from_numpy(np.array(Image.open(path).convert("RGBA").resize((128, 128)))) / 255
            return pixels[None, ..., :3], 1 - pixels[None, ..., 3]

    return LoadImage


class LoadFrames:
    """A ball that moves before white, and its masks."""

    RETURN_TYPES = ("IMAGE", "MASK")
    FUNCTION = "load"

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        return {"required": {}}

    def load(self) -> tuple[torch.Tensor, torch.Tensor]:
        y, x = torch.meshgrid(torch.linspace(-1, 1, 96), torch.linspace(-1, 1, 96), indexing="ij")
        inside = torch.stack([(x - 0.1 * k) ** 2 + y**2 < 0.25 for k in range(3)])
        frames = torch.where(inside[..., None], torch.tensor([0.8, 0.2, 0.1]), torch.tensor(1.0))
        return frames, 1 - inside.float()


def keeper(kept: dict[str, Any]) -> type:
    """Return an output node that keeps what it is given."""

    class Keep:
        RETURN_TYPES = ()
        FUNCTION = "keep"
        OUTPUT_NODE = True

        @classmethod
        def INPUT_TYPES(cls) -> dict[str, Any]:
            return {"required": {"name": ("STRING", {})}, "optional": {"image": ("IMAGE",), "mask": ("MASK",)}}

        def keep(self, name: str, **values: Any) -> dict[str, Any]:
            kept[name] = values
            return {"ui": {}, "result": ()}

    return Keep


def prompt(**changes: Any) -> dict[str, dict[str, Any]]:
    """Return a workflow in API format: a picture, its asset, views, and a GLB."""
    made = {"name": "my newt", "profile": "preview", "seed": 0, "settings": QUICK, "motion": "sway"} | changes
    view = {"azimuth": 0.0, "elevation": 10.0, "turn": 180.0, "loops": 1, "count": 3, "size": 64, "background": "gray"}
    return {
        "1": {"class_type": "LoadImage", "inputs": {"image": "newt.png"}},
        "2": {"class_type": "Dg4dPictureTo4D", "inputs": {"image": ["1", 0], "mask": ["1", 1], **made}},
        "3": {"class_type": "Dg4dViews", "inputs": {"asset": ["2", 0], "show": "splats", **view}},
        "4": {"class_type": "Keep", "inputs": {"name": "views", "image": ["3", 0], "mask": ["3", 1]}},
        "5": {"class_type": "Keep", "inputs": {"name": "front", "image": ["2", 1]}},
        "6": {"class_type": "Dg4dSave", "inputs": {"asset": ["2", 0], "format": "GLB", "filename_prefix": "3d/newt"}},
    }


@pytest.mark.parametrize("name", ["Dg4dPictureTo4D", "Dg4dVideoTo4D", "Dg4dViews", "Dg4dSave"])
def test_every_node_keeps_the_contract(comfy: Comfy, name: str) -> None:
    node: Any = comfy.classes[name]
    inputs = node.INPUT_TYPES()
    assert set(inputs) <= {"required", "optional", "hidden"}
    arguments = set(inputs["required"]) | set(inputs.get("optional", {}))
    function = getattr(node, node.FUNCTION)
    named = set(function.__code__.co_varnames[1 : function.__code__.co_argcount])
    assert set(inputs["required"]) <= named <= arguments
    for kind, *options in {**inputs["required"], **inputs.get("optional", {})}.values():
        assert isinstance(kind, list) or kind in SPECIAL
        default = (options or [{}])[0].get("default")
        assert default is None or (options[0].get("min", default) <= default <= options[0].get("max", default))
    assert len(node.RETURN_TYPES) == len(node.RETURN_NAMES) == len(node.OUTPUT_TOOLTIPS)
    assert set(node.RETURN_TYPES) <= SPECIAL and node.CATEGORY == "3d/dg4d"


def test_names_of_profiles_and_motions_are_those_of_dg4d(comfy: Comfy) -> None:
    required = comfy.classes["Dg4dPictureTo4D"].INPUT_TYPES()["required"]  # type: ignore[attr-defined]  # by contract
    assert required["profile"][0] == list(PROFILES)
    for motion in required["motion"][0][1:]:
        revise(named_profile("preview"), {"driving.motion": motion})


def test_importing_the_nodes_does_not_import_dg4d(comfy: Comfy) -> None:
    for path in FOLDER.glob("*.py"):
        if path.name != "worker.py":
            assert "dg4d_lib" not in path.read_text() and "import dg4d" not in path.read_text()


@pytest.fixture(scope="module")
def done(comfy: Comfy) -> dict[str, Any]:
    """What the page is sent by a whole run."""
    return comfy.execute(prompt())


@pytest.mark.slow
def test_a_picture_becomes_views_and_a_file(comfy: Comfy, done: dict[str, Any]) -> None:
    kept = vars(comfy)["kept"]
    views, masks = kept["views"]["image"], kept["views"]["mask"]
    assert views.shape == (3, 64, 64, 3) and views.dtype == torch.float32 and masks.shape == (3, 64, 64)
    assert views.min() >= 0 and views.max() <= 1
    torch.testing.assert_close(views[masks == 1], torch.full_like(views[masks == 1], 0.5))
    assert 0.02 < (masks < 0.5).float().mean() < 0.8
    assert kept["front"]["image"].shape == (4, 256, 256, 3)
    assert (views[0] - views[1]).abs().mean() > 0.005  # the camera turned
    assert done["6"]["3d"] == [{"filename": "newt_00001_.glb", "subfolder": "3d", "type": "output"}]
    assert (comfy.output / "3d" / "newt_00001_.glb").read_bytes()[:4] == b"glTF"


@pytest.mark.slow
def test_the_progress_bar_reaches_its_end_and_never_goes_back(comfy: Comfy, done: dict[str, Any]) -> None:
    first = comfy.reported[: comfy.reported.index((1000, 1000)) + 1]
    assert len(first) > 8 and first == sorted(first)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("format_", "suffix", "count"),
    [("GLB with skeleton", ".glb", 1), ("USDZ", ".usdz", 1), ("splats (PLY)", ".ply", 4)],
)
def test_every_format_is_saved(comfy: Comfy, done: dict[str, Any], format_: str, suffix: str, count: int) -> None:
    workflow = prompt()
    workflow["6"]["inputs"] |= {"format": format_, "filename_prefix": f"kinds/{suffix[1:]}"}
    before = len(comfy.reported)
    files = comfy.execute(workflow)["6"]["3d"]
    assert len(comfy.reported) == before  # nothing is made again
    assert len(files) == count
    for file in files:
        path = comfy.output / file["subfolder"] / file["filename"]
        assert path.suffix == suffix and path.stat().st_size > 100


@pytest.mark.slow
def test_the_makers_path_is_one_that_preview_3d_shows(comfy: Comfy, done: dict[str, Any]) -> None:
    (made,) = [values for key, values in comfy.cache.items() if key[1] == "Dg4dPictureTo4D"]
    model_file = made[2][0]
    assert not Path(model_file).is_absolute() and model_file.startswith("dg4d/my-newt-")
    assert (comfy.output / model_file).read_bytes()[:4] == b"glTF"


@pytest.mark.slow
def test_a_video_becomes_an_asset_with_its_frame_rate(comfy: Comfy) -> None:
    made = {"name": "ball", "profile": "preview", "seed": 0, "settings": QUICK, "fps": 12.5}
    workflow: dict[str, dict[str, Any]] = {
        "1": {"class_type": "LoadFrames", "inputs": {}},
        "2": {"class_type": "Dg4dVideoTo4D", "inputs": {"frames": ["1", 0], "mask": ["1", 1], **made}},
        "3": {"class_type": "Keep", "inputs": {"name": "ball", "image": ["2", 1]}},
    }
    comfy.execute(workflow)
    assert len(vars(comfy)["kept"]["ball"]["image"]) == 3
    (folder,) = (comfy.output / "dg4d").glob("ball-*")
    assert json.loads((folder / "asset.json").read_text())["fps"] == 12.5


@pytest.mark.slow
def test_an_interrupt_ends_every_process_and_the_next_run_works(
    comfy: Comfy, module: types.ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COMFY_NODES_TEST", "interrupt")
    started = len(comfy.reported)
    comfy.interrupt_when = lambda: len(comfy.reported) > started
    with pytest.raises(InterruptProcessingException):
        comfy.execute(prompt(seed=7))
    comfy.interrupt_when = lambda: False
    until = time.monotonic() + 60
    while (left := processes_with("COMFY_NODES_TEST=interrupt")) and time.monotonic() < until:
        time.sleep(0.1)
    assert not left
    comfy.execute(prompt(seed=7))


def processes_with(variable: str) -> list[str]:
    """Return the commands of other processes that have a variable in their environment."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if variable in (path / "environ").read_text().split("\0") and path.name != str(os.getpid()):
                found.append((path / "cmdline").read_text())
        except OSError:
            continue
    return found


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"settings": "motion.iterations"}, "NAME=VALUE"),
        ({"name": "///"}, "no letter or digit"),
        ({"profile": "perfect"}, "Value not in list"),
        ({"seed": -1}, "out of range"),
        ({"image": ["1", 1]}, "MASK != IMAGE"),
    ],
)
def test_wrong_widgets_are_refused_before_any_work(comfy: Comfy, changes: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        comfy.execute(prompt(**changes))


def test_a_wrong_setting_is_shown_at_the_settings_alone(comfy: Comfy) -> None:
    (error,) = comfy.validate(prompt(settings="oops"))
    assert "settings - a setting is NAME=VALUE" in error


def test_errors_of_dg4d_arrive_with_their_sentence(comfy: Comfy, module: types.ModuleType) -> None:
    with pytest.raises(module.Dg4dError, match=r"motion.iterations"):
        comfy.execute(prompt(settings="motion.iteration=3"))


def test_a_missing_interpreter_is_named_with_the_remedy(
    comfy: Comfy, module: types.ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_PYTHON", "/nowhere/python")
    assert any("/nowhere/python, which does not exist" in error for error in comfy.validate(prompt()))
    monkeypatch.delenv("DG4D_PYTHON")
    monkeypatch.setattr(module, "CHECKOUT_PYTHON", Path("/nowhere"))
    with pytest.raises(module.Dg4dError, match="make setup"):
        module.interpreter()


def test_a_process_that_dies_is_reported_with_its_last_words(module: types.ModuleType, tmp_path: Path) -> None:
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\necho no memory >&2\nexit 9\n")
    python.chmod(0o755)
    with pytest.raises(module.Dg4dError, match="status 9:\nno memory"):
        module.call({"call": "make", "arguments": {}}, lambda event: None, lambda: None, python=python)


def test_a_child_that_ignores_the_interrupt_is_killed(
    module: types.ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\nexec sleep 60\n")
    python.chmod(0o755)
    monkeypatch.setattr(module, "GRACE_S", 0.3)
    before = time.monotonic()

    def check() -> None:
        raise InterruptProcessingException

    with pytest.raises(InterruptProcessingException):
        module.call({"call": "make", "arguments": {}}, lambda event: None, check, python=python)
    assert time.monotonic() - before < 40


def test_masks_of_another_size_or_number_are_refused(comfy: Comfy) -> None:
    picture = comfy.classes["Dg4dPictureTo4D"]()
    with pytest.raises(ValueError, match="32 x 32 pixels, the picture 64 x 64"):
        picture.make(  # type: ignore[attr-defined]  # by contract
            torch.zeros(1, 64, 64, 3), "sway", "x", "preview", 0, "", mask=torch.ones(1, 32, 32)
        )
    video = comfy.classes["Dg4dVideoTo4D"]()
    with pytest.raises(ValueError, match="one mask per frame"):
        video.make(  # type: ignore[attr-defined]  # by contract
            torch.zeros(3, 8, 8, 3), 12.0, "x", "preview", 0, "", mask=torch.ones(2, 8, 8)
        )
    with pytest.raises(ValueError, match="Picture to 4D"):
        video.make(torch.zeros(1, 8, 8, 3), 12.0, "x", "preview", 0, "")  # type: ignore[attr-defined]  # by contract


def test_an_asset_that_was_removed_is_named(comfy: Comfy, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="make it again"):
        comfy.classes["Dg4dSave"]().save(str(tmp_path), "GLB", "x")  # type: ignore[attr-defined]  # by contract


@pytest.mark.parametrize("name", sorted(path.name for path in (FOLDER / "workflows").glob("*_api.json")))
def test_example_workflows_are_valid(comfy: Comfy, name: str) -> None:
    workflow = json.loads((FOLDER / "workflows" / name).read_text())
    assert sum(node["class_type"].startswith("Dg4d") for node in workflow.values()) == 3
    assert [error for error in comfy.validate(workflow) if "does not exist" not in error] == []


@pytest.mark.parametrize("name", sorted(path.name for path in (FOLDER / "workflows").glob("*4d.json")))
def test_workflows_of_the_page_are_those_of_the_api(comfy: Comfy, name: str) -> None:
    """Links join sockets of one type, and widgets have the values of the API format in the order of INPUT_TYPES."""
    drawn = json.loads((FOLDER / "workflows" / name).read_text())
    api = json.loads((FOLDER / "workflows" / name.replace(".json", "_api.json")).read_text())
    nodes = {node["id"]: node for node in drawn["nodes"]}
    links = {link[0]: link for link in drawn["links"]}
    assert {str(key): node["type"] for key, node in nodes.items()} == {k: n["class_type"] for k, n in api.items()}
    for key, node in nodes.items():
        linked = {}
        for slot, socket in enumerate(node.get("inputs", [])):
            if socket.get("link") is not None:
                _, source, output, target, at, kind = links[socket["link"]]
                assert (target, at) == (key, slot)
                assert kind == socket["type"].split(",")[0] == nodes[source]["outputs"][output]["type"]
                assert socket["link"] in nodes[source]["outputs"][output]["links"]
                linked[socket["name"]] = [str(source), output]
        inputs = api[str(key)]["inputs"]
        assert linked == {name: value for name, value in inputs.items() if isinstance(value, list)}
        if node["type"].startswith("Dg4d"):
            kinds = comfy.classes[node["type"]].INPUT_TYPES()["required"]  # type: ignore[attr-defined]  # by contract
            values = []
            for widget, (kind, *more) in kinds.items():
                if isinstance(kind, list) or kind in WIDGETS:  # a linked widget keeps its default
                    value = more[0]["default"] if widget in linked else inputs[widget]
                    values += [value] + ["fixed"] * bool(more and more[0].get("control_after_generate"))
            assert node["widgets_values"] == values


def test_the_folder_works_where_it_is_copied_to(tmp_path: Path) -> None:
    shutil.copytree(FOLDER, tmp_path / "custom_nodes" / "dg4d")
    with running(tmp_path / "output") as other:
        other.load_custom_node(tmp_path / "custom_nodes" / "dg4d")
        assert len(other.classes) == 4
