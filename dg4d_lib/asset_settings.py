"""Settings of users' models, delivered files, quality gates and scores, in the form of settings.py."""

from typing import Annotated, Literal

from pydantic import Field, field_validator

from dg4d_lib.settings import NotNegative, Positive, Settings, Share

SMALLEST_HEIGHT_M = 1e-6  # meters; far below, scales leave the range of 32-bit floating-point numbers


class GltfSettings(Settings):
    """Options of GLB files (ours); readers need glTF 2.0 with KHR_mesh_quantization, or without it if not quantized."""

    image: Literal["png", "jpeg", "webp"] = Field(
        "jpeg",
        description="texture format; png: lossless, larger; webp: smallest (EXT_texture_webp), with a 512-pixel jpeg "
        "as a fallback",
    )
    quality: int = Field(85, ge=1, le=100, description="JPEG or WebP quality; from 85, JPEG does not subsample chroma")
    quantized: bool = Field(
        True,
        description="16 bits for positions (skinned files: 32) and 8 for normals instead of 32 (KHR_mesh_quantization)",
    )
    meshopt: bool = Field(
        False,
        description="EXT_meshopt_compression with 14 bits for positions; supported by web players, not by Blender",
    )
    components: int = Field(
        0,
        ge=0,
        le=128,
        description="number of principal components as morph targets instead of one target per frame; 0: one per frame",
    )
    interpolation: Literal["linear", "step"] = Field("linear", description="interpolation between frames")
    moving_normals: bool = Field(True, description="animate normals; they take half of an uncompressed file")
    textures: Literal["pointer", "core"] = Field(
        "pointer",
        description="animated textures; pointer: one atlas and KHR_animation_pointer (other readers show the first "
        "frame); core: one node and texture per frame",
    )
    atlas_size: int = Field(
        4096, ge=64, le=8192, description="largest side of a texture atlas (pack.gltf.textures=pointer), pixels"
    )
    roughness: Share = Field(1.0, description="roughness factor of the material")
    metallic: Share = Field(0.0, description="metallic factor of the material")


class CutoutGateSettings(Settings):
    """Acceptance criteria of an estimated cut-out; ours, not calibrated: wide bounds that shreds fail."""

    pieces_most: Share = Field(0.1, description="share of the cut-out outside of its largest piece")
    holes_most: Share = Field(0.12, description="share of the filled cut-out that is holes")
    border_most: Share = Field(0.5, description="share of the picture's border that the cut-out touches")
    agreement_least: Share = Field(0.5, description="overlap of the cut-outs of two methods, IoU")


class GateSettings(Settings):
    """Acceptance criteria of an asset; ours, calibrated by benchmarks/gates.py."""

    cutout: CutoutGateSettings = CutoutGateSettings()

    fidelity_least: float = Field(16.5, ge=0, le=60, description="PSNR on the subject from the input camera, dB")
    silhouette_least: Share = Field(
        0.85, description="overlap of the silhouette with the video's in the worst frame, IoU"
    )
    consistency_least: Share = Field(
        0.955, description="share of the points seen in one view that the next view does not contradict"
    )
    flicker_most: NotNegative = Field(
        0.8, le=100, description="error of the changes from frame to frame; 1: a frozen asset"
    )
    floaters_most: Share = Field(
        0.02, description="share of the alpha disconnected from the subject, minus the video's"
    )
    flaws_most: NotNegative = Field(0.002, le=10, description="defective edges and triangles of the mesh, per triangle")
    folds_most: Share = Field(
        0.002, description="share of the triangles that cross others, are flipped or folded, in the worst frame"
    )
    added_folds_most: Share = Field(
        0.1,
        description="with --asset: share of the triangles that the fitted motion makes cross, flip or fold, in the "
        "worst frame; animations by artists reach 0.073 (seven models), because parts slide into each other",
    )
    agreement_least: Share = Field(0.85, description="overlap of the silhouettes of mesh and splats, IoU")
    sharpness_least: NotNegative = Field(0.75, le=10, description="color gradients, relative to the input image")
    sharpness_most: Positive = Field(1.25, le=10, description="color gradients, relative to the input image")
    motion_least: NotNegative = Field(0.6, le=10, description="change over time, relative to the video")
    motion_most: Positive = Field(1.7, le=100, description="change over time, relative to the video")


class ScoreSettings(Settings):
    """Comparison of an asset with ground truth; scores whose weights are empty or missing are left out."""

    size: int = Field(512, ge=32, le=2048, description="pixels of the images for LPIPS and CLIP (Consistent4D: 512)")
    vgg_weights: str = Field("vgg16", description="LPIPS: network; a name from `dg4d weights list`, or a folder")
    lpips_weights: str = Field("lpips-vgg", description="LPIPS: linear heads; a name or a folder")
    clip_weights: str = Field("clip-vit-b-32", description="CLIP; a name, or a folder in the layout of transformers")
    i3d_weights: str = Field("i3d", description="FVD; a name or a folder")
    samples: int = Field(10_000, ge=100, le=1_000_000, description="points per surface, for the Chamfer distance")
    actionbench_points: int = Field(
        100_000, ge=100, le=1_000_000, description="ActionBench: points per surface (published: 100,000)"
    )
    icp_points: int = Field(
        1000, ge=100, le=100_000, description="ActionBench: points for the alignment of a frame (published: 10,000)"
    )


class PackSettings(Settings):
    """Contents of the package."""

    fps: float = Field(
        0.0,
        ge=0,
        le=240,
        description="frame rate of the files, from 1; the motion is resampled (public code: 4 times the video's); "
        "0: that of the driving video, which a mesh per frame always uses",
    )
    height_m: float = Field(
        0.0,
        ge=0,
        le=1000,
        description="height of the first frame, meters, from 0.000001; 0: one meter per unit of the fit, about 1.5 m",
    )
    ground: bool = Field(
        True,
        description="put the lowest point of the animation on y = 0 and its center above the origin; false: the origin "
        "is the point that the camera looks at",
    )
    gltf: GltfSettings = GltfSettings()
    delight: bool = Field(
        False,
        description="divide shading, estimated as spherical harmonics of degree 2, out of the mesh texture, for "
        "viewers with lights; bright albedo such as a white belly may be removed too; splats are unchanged",
    )
    lods: tuple[Annotated[float, Field(gt=0, lt=1)], ...] = Field(
        (),
        max_length=8,
        description="fractions of the triangles of the tracked mesh, one GLB each, for example [0.5, 0.25]",
    )
    rig: bool = Field(
        True, description="write a skinned GLB in addition to morph targets, if a rig can follow the motion"
    )
    rig_bones: int = Field(32, ge=1, le=255, description="largest number of bones")
    rig_error: Share = Field(
        0.35, description="largest RMS error of the rig, relative to the motion; else it is left out"
    )
    usd: bool = Field(
        True,
        description="write asset.usdz (on a skeleton if one follows the motion) and asset_splats.usdz (splats, exact "
        "mesh)",
    )
    splats: bool = Field(True, description="write one 3DGS PLY per frame")
    spz: bool = Field(True, description="write one SPZ per frame, a quarter of the size")
    spz_version: Literal[3, 4] = Field(3, description="version of SPZ; 4 is 5 % smaller, but fewer programs read it")
    splat_gltf: Literal["none", "ratified", "rc1"] = Field(
        "none", description="write one GLB of splats per frame, by this version of KHR_gaussian_splatting"
    )
    preview_size: int = Field(
        384, ge=64, le=2048, description="pixels of turntable.mp4 and of each half of preview.mp4", multiple_of=2
    )
    preview_turns: int = Field(3, ge=1, le=20, description="loops of the motion per orbit of the camera")
    sheet_size: int = Field(192, ge=32, le=1024, description="pixels of a tile of the contact sheet")
    sheet_frames: int = Field(6, ge=1, le=32, description="columns: frames")
    sheet_azimuths_deg: tuple[Annotated[float, Field(ge=-360, le=360)], ...] = Field(
        (0.0, -75.0, 15.0, 105.0, 195.0), min_length=1, description="rows: azimuths of the splats"
    )
    sheet_mesh_azimuths_deg: tuple[Annotated[float, Field(ge=-360, le=360)], ...] = Field(
        (30.0, 195.0), description="further rows: azimuths of the lit mesh"
    )

    @field_validator("fps")
    @classmethod
    def _check_fps(cls, fps: float) -> float:
        if 0 < fps < 1:
            raise ValueError("use 0 for the frame rate of the driving video, or 1 to 240")
        return fps

    @field_validator("height_m")
    @classmethod
    def _check_height(cls, height_m: float) -> float:
        if 0 < height_m < SMALLEST_HEIGHT_M:
            raise ValueError(f"use 0 for one meter per unit of the fit, or {SMALLEST_HEIGHT_M} to 1000")
        return height_m


class AssetSettings(Settings):
    """A model of the user's own (`--asset`): its placement, and the fit of its motion; ours."""

    find_azimuth: bool = Field(True, description="estimate the azimuth from the first frame; false: use azimuth_deg")
    azimuth_deg: float = Field(
        0.0,
        ge=-360,
        le=360,
        description="azimuth of the model that the video shows; 0: its +z axis; set by `--asset-azimuth`",
    )
    max_faces: int = Field(200000, ge=100, le=2000000, description="largest number of triangles of a model")
    max_splats: int = Field(
        100000,
        ge=100,
        le=1000000,
        description="largest number of splats of a model; larger scans are merged to this number",
    )
    min_agreement: Share = Field(
        0.5, description="smallest IoU of the outlines of model and first frame; below, the model is refused"
    )
    points: int = Field(12000, ge=100, le=200000, description="number of Gaussians on the surface of a mesh")
    fit_points: int = Field(6000, ge=100, le=200000, description="number of Gaussians that the fit renders")
    skeleton: bool = Field(
        True,
        description="pose a skinned model by its joints if the first frame shows it in another pose than at rest, and "
        "animate the joints; false: deform the surface instead",
    )
    nodes: int = Field(
        200,
        ge=4,
        le=1000,
        description="number of control nodes on the surface, at most one per vertex; with 1000, tracking solves for "
        "6000 unknowns a step",
    )
    size: int = Field(128, ge=32, le=512, multiple_of=16, description="pixels of the compared pictures")
    tracking: Literal["flow", "descent"] = Field(
        "flow",
        description="flow: optical flow from renders, plus a search for large motions; descent: gradient descent, "
        "smoother",
    )
    track_iterations: int = Field(
        3, ge=1, le=1000, description="rounds of optical flow, or steps of gradient descent, per frame while tracking"
    )
    joint_iterations: int = Field(200, ge=0, le=10000, description="iterations over all frames after tracking")
    joint_frames: int = Field(8, ge=1, le=512, description="frames per joint iteration")
    lr: Positive = Field(
        0.003, description="learning rate of the position of the model, world units; for `tracking=descent`, 0.006"
    )
    smoothing: float = Field(1.0, ge=0, le=1000, description="smoothing of the steps over the control graph")
    color_weight: NotNegative = Field(1.0, description="weight of the color loss: mean squared error over the subject")
    alpha_weight: NotNegative = Field(1.0, description="weight of the alpha loss: mean squared error over the subject")
    flow: NotNegative = Field(0.1, description="weight of the optical flow loss while tracking")
    integrate_rotations: bool = Field(
        False,
        description="compute node positions from their rotations (a Poisson equation), for wings and limbs that swing "
        "far; with tracking=flow, in the joint iterations only",
    )
    rigidity: NotNegative = Field(1.0, description="weight of the as-rigid-as-possible energy")
    bending: NotNegative = Field(
        0.1, description="weight of differences between neighboring rotations, relative to rigidity"
    )
    rigidity_loss: Literal["l1", "log", "best"] = Field(
        "best",
        description="loss of stretching and bending, quadratic near 0; l1: linear beyond; log: logarithmic, for few "
        "joints that bend far; best: both, in twice the time, and the motion that is closer to the video is kept",
    )
    rigid_parts: int = Field(
        4,
        ge=0,
        le=16,
        description="largest number of rigid parts (such as a chest and its lid) in a second, piecewise rigid fit; "
        "tried only if so few explain the motion, and kept if it is closer to the video; 0: no second fit",
    )
    inertia: NotNegative = Field(0.002, description="weight of the distance to the extrapolated motion while tracking")
    smoothness: NotNegative = Field(0.1, description="weight of accelerations in the joint fit")
    depth: NotNegative = Field(0.001, description="weight of displacements along the viewing direction")
    whole_depth: NotNegative = Field(
        0.001,
        description="weight of moving the whole model along the viewing direction; with tracking=descent use 0.15",
    )
    across: NotNegative = Field(
        0.15,
        description="weight of displacements perpendicular to the model's vertical mirror plane, in which legs and "
        "lids swing; unused without such a plane",
    )
