"""Options that several commands share."""

import math
from pathlib import Path
from typing import Annotated, Any

import typer


def finite(value: float | None) -> float | None:
    """Refuse NaN, which passes range checks because all comparisons with it are false, and infinity."""
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number")
    return value


PROFILES = (
    "preview",
    "paper",
    "paper-lgm",
    "video",
    "video-fast",
    "release",
    "reference",
    "quality",
    "open",
)  # as in steps/profiles.py
MOTIONS = ("sway", "bend", "breathe", "bounce", "wave", "turn")  # as in dg4d_lib/input_settings.py


def complete_profile(incomplete: str) -> list[str]:
    """Return the profiles with a prefix, for shell completion."""
    return [name for name in PROFILES if name.startswith(incomplete)]


def complete_setting(incomplete: str) -> list[str]:
    """Return the settings with a prefix, for shell completion."""
    from flows.inputs.setting_reference import all_settings

    return sorted({f"{one.name}=" for one in all_settings() if one.name.startswith(incomplete)})


Package = Annotated[Path, typer.Argument(metavar="PACKAGE", help="folder of an asset")]
AsJson = Annotated[bool, typer.Option("--json", help="print JSON")]
Profile = Annotated[
    str,
    typer.Option(metavar="NAME", help=f"preset: {', '.join(PROFILES)}", autocompletion=complete_profile),
]
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="change a setting; may be repeated. `dg4d settings` lists them",
        autocompletion=complete_setting,
    ),
]
Commercial = Annotated[
    bool, typer.Option("--commercial-only", help="refuse weights whose license forbids commercial use")
]
SEED_MAX = 2**63 - 1  # as in steps/contract.py, whose import would slow down --help
Seed = Annotated[
    int,
    typer.Option(min=0, max=SEED_MAX, metavar="N", help="seed of all random numbers; equal seeds give equal bytes"),
]
Views = Annotated[
    list[str] | None,
    typer.Option(
        "--view",
        metavar="AZIMUTH[,ELEVATION]=FILE",
        help="picture of another side in the first frame; azimuth in degrees: 90 is the side that PICTURE shows on the "
        "right, 180 the back; may be repeated",
    ),
]
Turntable = Annotated[
    Path | None,
    typer.Option(
        "--turntable",
        metavar="PATH",
        help="video, or folder of frames, of the still subject turned once; starts with the side of PICTURE",
    ),
]
Cameras = Annotated[
    Path | None,
    typer.Option(
        "--cameras",
        metavar="FILE",
        help="transforms.json of nerfstudio: pictures of the first frame, or synchronized videos. The input camera is "
        "the one whose file is PICTURE (same path, or same unique name), else the first",
    ),
]
Triangles = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        help="maximum number of triangles; short for --set mesh.max_faces=N; a mesh given by --asset keeps its own",
    ),
]
Texture = Annotated[
    int | None,
    typer.Option("--texture", metavar="N", help="texels per side of the texture; short for --set mesh.texture_size=N"),
]
Rate = Annotated[
    float | None,
    typer.Option(
        "--fps",
        min=1,
        max=240,
        metavar="N",
        callback=finite,
        help="frames per second of the output; short for --set pack.fps=N",
    ),
]


Mask = Annotated[
    Path | None,
    typer.Option(
        metavar="PATH", help="picture, or folder of frames for a video, of the same size: white where the subject is"
    ),
]
Depth = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="depth picture of the first frame, same size: inverse depth (bright is near), or distances as EXR or "
        "TIFF with floating-point numbers",
    ),
]
Layers = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="gray picture of the first frame, same size: lighter than mid-gray is nearer, darker is farther",
    ),
]
Box = Annotated[
    str,
    typer.Option(
        metavar="X,Y,W,H",
        help="part of the picture that shows the subject, in pixels; short for --set subject.box=[X,Y,W,H]",
    ),
]


Height = Annotated[
    float | None,
    typer.Option(
        "--height-m",
        min=0.001,
        max=1000,
        metavar="N",
        callback=finite,
        help="height in meters; short for --set pack.height_m=N",
    ),
]
Ground = Annotated[
    bool | None,
    typer.Option(
        "--ground/--no-ground",
        help="put the lowest point on y = 0; short for --set pack.ground=true or false  [default: ground]",
        show_default=False,
    ),
]
Compress = Annotated[
    bool,
    typer.Option("--compress", help="compress GLB files for web players; short for --set pack.gltf.meshopt=true"),
]


def shortcut_settings(
    triangles: int | None,
    texture: int | None,
    fps: float | None,
    *,
    box: str = "",
    height_m: float | None = None,
    ground: bool | None = None,
    compress: bool = False,
) -> dict[str, Any]:
    """Return the settings that these options stand for."""
    from flows.inputs.manifest import box_settings

    given = {
        "mesh.max_faces": triangles,
        "mesh.texture_size": texture,
        "pack.fps": fps,
        "pack.height_m": height_m,
        "pack.ground": ground,
        "pack.gltf.meshopt": compress or None,
    }
    return {name: value for name, value in given.items() if value is not None} | box_settings(box)
