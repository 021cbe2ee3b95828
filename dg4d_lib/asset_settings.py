"""Every knob of the files that leave the house, and of how assets are judged; in the form of settings.py."""

from typing import Annotated, Literal

from pydantic import Field, field_validator

from dg4d_lib.settings import NotNegative, Positive, Settings, Share


class GltfSettings(Settings):
    """How GLB files are written (ours); with the defaults a reader needs to know core glTF 2.0 and nothing else."""

    image: Literal["png", "jpeg", "webp"] = Field(
        "jpeg",
        description="format of textures; png: exact, larger; webp: smallest, EXT_texture_webp, with a jpeg of 512 "
        "pixels for other readers",
    )
    quality: int = Field(
        85, ge=1, le=100, description="of jpeg and webp; from 95 on, jpeg keeps colors as fine as brightness"
    )
    quantized: bool = Field(
        False,
        description="16 bits instead of 32, 8 for normals at rest: KHR_mesh_quantization; in USDZ, splats in half "
        "floats",
    )
    meshopt: bool = Field(
        False, description="packed: EXT_meshopt_compression, which web players know and Blender does not"
    )
    interpolation: Literal["linear", "step"] = Field("linear", description="between frames: smooth, or held")
    moving_normals: bool = Field(True, description="normals turn with the surface; half of a plain file")
    textures: Literal["pointer", "core"] = Field(
        "pointer",
        description="textures that change; pointer: one atlas and KHR_animation_pointer (other readers show the first "
        "frame's); core: a node and a picture per frame",
    )
    atlas_size: int = Field(4096, ge=64, le=8192, description="pixels of such an atlas, at most")
    roughness: Share = Field(1.0, description="of the surface")
    metallic: Share = Field(0.0, description="of the surface")


class GateSettings(Settings):
    """What an asset must be like to be accepted; ours, calibrated by benchmarks/gates.py."""

    fidelity_least: float = Field(16.5, ge=0, le=60, description="PSNR on the subject at the input view, dB")
    silhouette_least: Share = Field(0.85, description="overlap of its outline with the video's in the worst frame, IoU")
    consistency_least: Share = Field(
        0.955, description="share of the points seen from one side that the next side does not contradict"
    )
    flicker_most: NotNegative = Field(
        0.8, le=100, description="change over time that is not the video's; 1: a frozen asset"
    )
    floaters_most: Share = Field(0.02, description="share of what is seen that hangs apart, less the video's own")
    flaws_most: NotNegative = Field(0.002, le=10, description="broken edges and triangles of the mesh, per triangle")
    agreement_least: Share = Field(0.85, description="overlap of the outlines of mesh and splats, IoU")
    sharpness_least: NotNegative = Field(0.75, le=10, description="color gradients, in those of the input picture")
    sharpness_most: Positive = Field(1.25, le=10, description="color gradients, in those of the input picture")
    motion_least: NotNegative = Field(0.6, le=10, description="change over time, in that of the video")
    motion_most: Positive = Field(1.7, le=100, description="change over time, in that of the video")


class ScoreSettings(Settings):
    """How an asset is compared with the truth; weights that are empty or not here leave their number out."""

    size: int = Field(
        512, ge=32, le=2048, description="pixels of the pictures that LPIPS and CLIP see (Consistent4D: 512)"
    )
    vgg_weights: str = Field("vgg16", description="LPIPS: the network; a name of `dg4d weights list`, or a folder")
    lpips_weights: str = Field("lpips-vgg", description="LPIPS: how much its channels count; a name or a folder")
    clip_weights: str = Field("clip-vit-b-32", description="CLIP; a name, or a folder in the layout of transformers")
    i3d_weights: str = Field("i3d", description="FVD; a name or a folder")
    samples: int = Field(
        10_000, ge=100, le=1_000_000, description="points on either surface, for the distance of meshes"
    )


class PackSettings(Settings):
    """What the package holds."""

    fps: float = Field(
        0.0,
        ge=0,
        le=240,
        description="frames per second of what is written, 8, 12, 24, 30 or any: the motion is asked again at those "
        "moments, from 1 on (paper's code: 4 times as many); 0: the driving video's; a mesh per frame keeps to that",
    )
    gltf: GltfSettings = GltfSettings()
    lods: tuple[Annotated[float, Field(gt=0, lt=1)], ...] = Field(
        (), max_length=8, description="shares of the triangles of the tracked mesh; a GLB each, say [0.5, 0.25]"
    )
    rig: bool = Field(True, description="a skinned GLB beside the morphed one, where a rig follows the motion")
    rig_bones: int = Field(32, ge=1, le=255, description="of the rig, at most")
    rig_error: Share = Field(0.35, description="part of the motion (rms) that the rig may miss; else it is left out")
    usd: bool = Field(True, description="mesh and splats as USDZ")
    splats: bool = Field(True, description="one standard PLY per frame")
    spz: bool = Field(True, description="one SPZ per frame, a quarter of the size")
    splat_gltf: Literal["none", "ratified", "rc1"] = Field(
        "none", description="one GLB of splats per frame, by which text of KHR_gaussian_splatting"
    )
    preview_size: int = Field(384, ge=64, le=2048, description="pixels of preview.mp4 (even)", multiple_of=2)
    preview_turns: int = Field(3, ge=1, le=20, description="times the motion loops while the camera goes round once")
    sheet_size: int = Field(192, ge=32, le=1024, description="pixels of a tile of the contact sheet")
    sheet_frames: int = Field(6, ge=1, le=32, description="columns: moments")
    sheet_azimuths_deg: tuple[Annotated[float, Field(ge=-360, le=360)], ...] = Field(
        (0.0, -75.0, 15.0, 105.0, 195.0), min_length=1, description="rows: angles"
    )

    @field_validator("fps")
    @classmethod
    def _fps_is_a_rate(cls, fps: float) -> float:
        if 0 < fps < 1:
            raise ValueError("use 0 for the driving video's, or 1 to 240")
        return fps
