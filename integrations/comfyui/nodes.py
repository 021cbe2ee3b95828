"""Nodes for ComfyUI: pictures and videos to 4D, views of the result, and files of it."""

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import comfy.model_management
import comfy.utils
import folder_paths
import numpy as np
import torch

from . import client, media

ASSET = "ASSET_4D"  # type of the sockets: folder of a package
CATEGORY = "3d/dg4d"
PROFILES = ["preview", "paper", "paper-lgm", "video", "video-fast", "release", "reference", "quality", "open"]
AS_PROFILE = "as the profile"
MOTIONS = [AS_PROFILE, "sway", "bend", "breathe", "bounce", "wave", "turn"]
BACKGROUNDS = {"white": 1.0, "gray": 0.5, "black": 0.0}
STEPS = 1000  # of the progress bar
MOST_SEED = 2**53 - 1  # integers that JavaScript keeps
FORMATS = {  # files of the package, and the suffix of one file or of those in a folder
    "GLB": ("asset.glb", ".glb"),
    "GLB with skeleton": ("asset_rigged.glb", ".glb"),
    "GLB with skeleton, for playback": ("asset_playback.glb", ".glb"),
    "USDZ": ("asset.usdz", ".usdz"),
    "splats (PLY)": ("splats/*.ply", ".ply"),
    "splats (SPZ)": ("splats/*.spz", ".spz"),
}
INPUT_FRAMES = 256  # pixels of the renders that the makers return

Inputs = dict[str, dict[str, Any]]


class _Maker:
    """Conversion, shared by pictures and videos."""

    RETURN_TYPES = (ASSET, "IMAGE", "STRING")
    RETURN_NAMES = ("asset", "renders", "model_file")
    OUTPUT_TOOLTIPS = (
        "animated asset, for 4D Views and Save GLB/USDZ/splats",
        "renders of the splats from the front, one per frame",
        "path of the GLB in the output folder, for Preview 3D",
    )
    FUNCTION = "make"
    CATEGORY = CATEGORY

    @classmethod
    def IS_CHANGED(cls, **_: Any) -> str:
        """Return the interpreter of dg4d: another one makes the asset again."""
        return str(client.interpreter())

    @classmethod
    def VALIDATE_INPUTS(cls, settings: str | None = None) -> bool | str:
        """Return True, or why the settings cannot be used; None where they come by a link.

        ComfyUI shows the answer at every argument of this method, so there is one.
        """
        try:
            client.interpreter()
            setting_lines(settings or "")
        except (client.Dg4dError, ValueError) as error:
            return str(error)
        return True

    def _make(self, place: Path, name: str, arguments: dict[str, Any]) -> tuple[str, torch.Tensor, str]:
        """Convert, and render the frames from the front."""
        safe = media.clean_name(name)
        if not safe:
            raise ValueError(f"name {name!r} has no letter or digit")
        folder = Path(folder_paths.get_output_directory()) / "dg4d" / f"{safe}-{media.digest(arguments, place)}"
        paths = {key: _under(place, arguments[key]) for key in ("picture", "frames", "mask") if arguments.get(key)}
        views = {azimuth: _under(place, path) for azimuth, path in arguments.get("views", {}).items()}
        made = _call("make", {**arguments, **paths, "views": views, "out": str(folder), "name": safe})
        front = [{"azimuth": 0.0, "elevation": 0.0, "phase": k / made["frames"]} for k in range(made["frames"])]
        pictures = _render(place, str(folder), front, INPUT_FRAMES, mesh=False)
        model_file = (folder / "asset.glb").relative_to(folder_paths.get_output_directory()).as_posix()
        return str(folder), media.over(pictures, 1.0), model_file


class PictureTo4D(_Maker):
    """Convert one picture, or a picture and other sides of it."""

    DESCRIPTION = "Convert a picture to an animated textured mesh and moving Gaussian splats."

    @classmethod
    def INPUT_TYPES(cls) -> Inputs:
        """Return the inputs."""
        mask = (
            "MASK",
            {"tooltip": "as Load Image returns it: 1 where the picture is transparent; empty: cut out by dg4d"},
        )
        side = ("IMAGE", {"tooltip": "the same subject in the first frame, seen from this azimuth, counter-clockwise"})
        motion = (MOTIONS, {"tooltip": "motion that needs no model"})
        return {
            "required": {"image": ("IMAGE",), "motion": motion, **_common()},
            "optional": {"mask": mask, **{f"azimuth_{azimuth}": side for azimuth in (90, 180, 270)}},
        }

    def make(
        self,
        image: torch.Tensor,
        motion: str,
        name: str,
        profile: str,
        seed: int,
        settings: str,
        mask: torch.Tensor | None = None,
        **sides: torch.Tensor,
    ) -> tuple[str, torch.Tensor, str]:
        """Convert the first picture of the batch."""
        lines = setting_lines(settings) + [f"driving.motion={motion}"] * (motion != AS_PROFILE)
        with tempfile.TemporaryDirectory(prefix="dg4d-comfyui-") as scratch:
            place = Path(scratch)
            media.write_picture(image[:1], mask, place / "picture.png")
            arguments: dict[str, Any] = {"picture": "picture.png", "profile": profile, "seed": seed, "settings": lines}
            for side, picture in sides.items():
                media.write_picture(picture[:1], None, place / f"{side}.png")
                arguments.setdefault("views", {})[side.removeprefix("azimuth_")] = f"{side}.png"
            return self._make(place, name, arguments)


class VideoTo4D(_Maker):
    """Convert the frames of a video."""

    DESCRIPTION = "Convert a video to an animated textured mesh and moving Gaussian splats that follow it."

    @classmethod
    def INPUT_TYPES(cls) -> Inputs:
        """Return the inputs."""
        fps = ("FLOAT", {"default": 12.0, "min": 0.1, "max": 120.0, "step": 0.1, "tooltip": "frames per second"})
        mask = ("MASK", {"tooltip": "1 where a frame does not show the subject; one mask per frame"})
        return {"required": {"frames": ("IMAGE",), "fps": fps, **_common()}, "optional": {"mask": mask}}

    def make(
        self,
        frames: torch.Tensor,
        fps: float,
        name: str,
        profile: str,
        seed: int,
        settings: str,
        mask: torch.Tensor | None = None,
    ) -> tuple[str, torch.Tensor, str]:
        """Convert all frames of the batch."""
        if len(frames) < 2:
            raise ValueError(f"a video has two frames or more; given {len(frames)}; use Picture to 4D for one picture")
        with tempfile.TemporaryDirectory(prefix="dg4d-comfyui-") as scratch:
            place = Path(scratch)
            media.write_frames(frames, place / "frames")
            arguments: dict[str, Any] = {"frames": "frames", "fps": fps, "profile": profile, "seed": seed}
            if mask is not None and bool(mask.any()):
                media.write_masks(mask, len(frames), place / "masks")
                arguments["mask"] = "masks"
            return self._make(place, name, {**arguments, "settings": setting_lines(settings)})


class Views4D:
    """Render an asset along a camera path."""

    DESCRIPTION = "Render an animated asset while the camera turns around it."
    RETURN_TYPES = ("IMAGE", "MASK")
    RETURN_NAMES = ("image", "mask")
    OUTPUT_TOOLTIPS = ("renders", "1 where a render shows nothing, as Load Image returns it")
    FUNCTION = "render"
    CATEGORY = CATEGORY

    @classmethod
    def INPUT_TYPES(cls) -> Inputs:
        """Return the inputs."""
        angle = {"default": 0.0, "step": 1.0}
        return {
            "required": {
                "asset": (ASSET,),
                "show": (["splats", "mesh"], {}),
                "azimuth": ("FLOAT", {**angle, "min": -360.0, "max": 360.0, "tooltip": "degrees; 0 is the front"}),
                "elevation": ("FLOAT", {**angle, "min": -85.0, "max": 85.0, "tooltip": "degrees above the horizon"}),
                "turn": (
                    "FLOAT",
                    {**angle, "default": 360.0, "min": -3600.0, "max": 3600.0, "tooltip": "degrees in all"},
                ),
                "loops": (
                    "INT",
                    {"default": 1, "min": 0, "max": 16, "tooltip": "of the animation; 0: the first frame"},
                ),
                "count": ("INT", {"default": 24, "min": 1, "max": 512, "tooltip": "number of renders"}),
                "size": ("INT", {"default": 512, "min": 16, "max": 2048, "step": 16, "tooltip": "pixels of a side"}),
                "background": (list(BACKGROUNDS), {}),
            }
        }

    def render(
        self,
        asset: str,
        show: str,
        azimuth: float,
        elevation: float,
        turn: float,
        loops: int,
        count: int,
        size: int,
        background: str,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return renders "b h w 3" in [0, 1] and masks "b h w"."""
        shares = [k / count for k in range(count)]
        views = [{"azimuth": azimuth + turn * s, "elevation": elevation, "phase": loops * s % 1} for s in shares]
        with tempfile.TemporaryDirectory(prefix="dg4d-comfyui-") as scratch:
            pictures = _render(Path(scratch), asset, views, size, mesh=show == "mesh")
        return media.over(pictures, BACKGROUNDS[background]), 1 - pictures[..., 3]


class Save4D:
    """Copy files of an asset into the output folder."""

    DESCRIPTION = "Save an animated asset as GLB, USDZ or Gaussian splats, one file per frame."
    RETURN_TYPES = ("STRING",)
    RETURN_NAMES = ("model_file",)
    OUTPUT_TOOLTIPS = ("path in the output folder, of the first file; Preview 3D shows GLB",)
    FUNCTION = "save"
    CATEGORY = CATEGORY
    OUTPUT_NODE = True

    @classmethod
    def INPUT_TYPES(cls) -> Inputs:
        """Return the inputs."""
        prefix = ("STRING", {"default": "3d/dg4d", "tooltip": "path in the output folder; a number is appended"})
        return {"required": {"asset": (ASSET,), "format": (list(FORMATS), {}), "filename_prefix": prefix}}

    def save(self, asset: str, format: str, filename_prefix: str) -> dict[str, Any]:
        """Copy the files under the next free number."""
        pattern, suffix = FORMATS[format]
        sources = sorted(Path(asset).glob(pattern))
        if not sources:
            raise ValueError(
                f"{asset} has no {pattern}: it was removed, or its profile does not write it; make it again"
            )
        output = folder_paths.get_output_directory()
        folder, stem, counter, *_ = folder_paths.get_save_image_path(filename_prefix, output)
        copies = media.copy_numbered(sources, Path(folder), f"{stem}_{counter:05}_", suffix, "*" in pattern)
        saved = [
            {"filename": path.name, "subfolder": _relative(path.parent, output), "type": "output"} for path in copies
        ]
        return {"ui": {"3d": saved}, "result": (_relative(copies[0], output),)}


def setting_lines(text: str) -> list[str]:
    """Return the settings of a text, one NAME=VALUE per line; empty lines and those after # are left out.

    Raises:
        ValueError: a line is not a setting.
    """
    lines = [line.partition("#")[0].strip() for line in text.splitlines()]
    wrong = [line for line in lines if line and "=" not in line]
    if wrong:
        raise ValueError(f"a setting is NAME=VALUE, for example motion.iterations=200; given {wrong[0]!r}")
    return [line for line in lines if line]


def _common() -> dict[str, Any]:
    seed = {"default": 0, "min": 0, "max": MOST_SEED, "control_after_generate": True}
    settings = {"default": "", "multiline": True, "tooltip": "NAME=VALUE, one per line, as of `dg4d make --set`"}
    return {
        "name": ("STRING", {"default": "asset", "tooltip": "of the asset and of its folder"}),
        "profile": (PROFILES, {"tooltip": "preview needs neither a GPU nor weights"}),
        "seed": ("INT", seed),
        "settings": ("STRING", settings),
    }


def _call(name: str, arguments: Mapping[str, Any]) -> Any:
    """Call the worker with ComfyUI's progress bar and interrupt."""
    bar = comfy.utils.ProgressBar(STEPS)

    def show(event: client.Event) -> None:
        if event.get("fraction") is not None:  # steps that run at one time report in any order
            bar.update_absolute(max(bar.current, round(STEPS * event["fraction"])))

    check: Callable[[], None] = comfy.model_management.throw_exception_if_processing_interrupted
    result = client.call({"call": name, "arguments": arguments}, show, check)
    bar.update_absolute(STEPS)
    return result


def _render(place: Path, folder: str, views: list[dict[str, float]], size: int, mesh: bool) -> torch.Tensor:
    """Return RGBA renders "b h w 4" with straight alpha."""
    target = place / "renders.npy"
    _call("render", {"folder": folder, "target": str(target), "views": views, "size": size, "mesh": mesh})
    return torch.from_numpy(np.load(target, allow_pickle=False)).clamp(0, 1)


def _under(place: Path, name: str) -> str:
    return str(place / name)


def _relative(path: Path, folder: str) -> str:
    relative = path.resolve().relative_to(Path(folder).resolve()).as_posix()
    return "" if relative == "." else relative


NODE_CLASS_MAPPINGS: dict[str, type] = {
    "Dg4dPictureTo4D": PictureTo4D,
    "Dg4dVideoTo4D": VideoTo4D,
    "Dg4dViews": Views4D,
    "Dg4dSave": Save4D,
}
NODE_DISPLAY_NAME_MAPPINGS: dict[str, str] = {
    "Dg4dPictureTo4D": "Picture to 4D",
    "Dg4dVideoTo4D": "Video to 4D",
    "Dg4dViews": "4D Views",
    "Dg4dSave": "Save GLB/USDZ/splats",
}
