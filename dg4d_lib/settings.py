"""Settings of all stages: default, unit, allowed range and source.

The defaults are the paper's; profiles change them (steps/profiles.py). "Ours" marks a choice of this project.
"""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Precision = Literal["fp16", "bf16", "fp32"]
PRECISION = "floating-point precision of the networks; always fp32 on CPUs"  # description of such settings
UnwrapMethod = Literal["charts", "xatlas"]
NoiseDraw = Literal["annealed", "uniform"]  # timestep of an iteration: T_max, or uniform below it
PipelineBudget = Annotated[
    float,
    Field(
        ge=6,
        le=1024,
        description="GiB of GPU memory to plan for, for example 12, 24 or 80; networks that do not fit together are "
        "moved to the GPU one at a time, and one that does not fit alone layer by layer",
    ),
]


class Settings(BaseModel):
    """Immutable settings; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ResolutionStage(Settings):
    """Stage of a resolution schedule."""

    until: Share = Field(description="applies while progress is below this")
    size: int = Field(ge=16, le=2048, description="pixels of a guidance render")


RESOLUTION_SCHEDULE = (
    ResolutionStage(until=0.3, size=128),
    ResolutionStage(until=0.6, size=256),
    ResolutionStage(until=1.0, size=512),
)


class VideoModelSettings(Settings):
    """Stable Video Diffusion (Blattmann et al. 2023)."""

    weights: str = Field(
        "svd", min_length=1, description="a name from `dg4d weights list`, or a folder in diffusers' layout"
    )
    precision: Precision = Field("fp16", description=PRECISION)
    low_memory: bool = Field(False, description="keep only the network in use on the GPU; slower")
    num_inference_steps: int = Field(25, ge=2, le=200, description="noise levels of the full schedule")
    min_guidance_scale: float = Field(1.0, ge=0, le=20, description="classifier-free guidance in the first frame")
    max_guidance_scale: float = Field(
        3.0, ge=0, le=20, description="classifier-free guidance in the last frame; linear in between"
    )
    fps_id: int = Field(6, ge=0, le=30, description="frame rate conditioning; 6 is playback at 7 frames per second")
    motion_bucket_id: int = Field(127, ge=0, le=255, description="conditioning on the amount of motion")
    noise_aug_strength: float = Field(
        0.02, ge=0, le=1, description="noise augmentation of the conditioning image, values in [-1, 1]"
    )
    memory_gb: float = Field(
        24.0,
        ge=6,
        le=1024,
        description="GiB of memory to plan for, for example 12, 24 or 80; limits the batch sizes below",
    )
    videos_at_once: int = Field(
        2, ge=1, le=64, description="batch size of the UNet; each video counts twice, with and without conditioning"
    )
    decode_chunk_size: int = Field(14, ge=1, le=128, description="frames that are encoded or decoded at once")


class GeometricPriorSettings(Settings):
    """Renders of a surface inflated from the picture stand in for a diffusion model; no weights."""

    kind: Literal["geometric"] = "geometric"
    size: int = Field(128, ge=32, le=512, description="pixels at which the surface is built")
    depth_sigma: float = Field(
        0.03,
        ge=0,
        le=0.5,
        description="standard deviation of the guessed depth, world units; side views are averaged over it, so they "
        "are blurred along depth",
    )
    depth_weights: str = Field(
        "",
        description="monocular depth network (`depth-anything-v2-small`, or a folder in the layout of transformers), a "
        "hint at the relief of the side that the picture shows; empty: none",
    )
    depth_weight: Share = Field(0.5, description="share of the estimated relief that the surface takes on; ours")


class LearnedPriorSettings(Settings):
    """Shape network of this package, trained on synthetic shapes; no download."""

    kind: Literal["learned"] = "learned"
    weight: float = Field(
        0.5, ge=0, le=10, description="factor on the guidance loss; a smaller one leaves the input view sharper"
    )
    depth_sigma: float = Field(
        0.0,
        ge=0,
        le=0.5,
        description="0: render a sharp surface; otherwise average side views over this standard deviation of its "
        "depth, world units: closer to the ground truth on average, but blurred (typical: 0.03)",
    )
    contrast: float = Field(
        0.0,
        ge=0,
        le=16,
        description="0: render the surface of the most probable cells; otherwise render the average over all possible "
        "shapes, with this factor on the occupancy log-odds: closer to the ground truth on average, but foggy "
        "(typical: 2)",
    )


class Zero123PriorSettings(Settings):
    """Zero-1-to-3: novel-view diffusion, conditioned on an image and a relative camera pose (Liu et al. 2023)."""

    kind: Literal["zero123"] = "zero123"
    weights: str = Field(
        "zero123-xl",
        min_length=1,
        description="a name from `dg4d weights list`, a Hugging Face hub id, or a folder in diffusers' layout",
    )
    variant: Literal["xl", "stable"] = Field(
        "xl",
        description="last entry of the pose conditioning; xl: difference of the radii; stable (Stable-Zero123):"
        " polar angle of the input camera",
    )
    guidance_scale: float = Field(5.0, ge=0, le=100, description="classifier-free guidance (public code: 5)")
    precision: Precision = Field("fp16", description=PRECISION)
    memory_gb: float = Field(
        24.0,
        ge=6,
        le=1024,
        description="GiB of memory to plan for, for example 12, 24 or 80; sets the batch size of views",
    )
    compiled: bool = Field(
        False, description="compile the networks with torch.compile: minutes at the start, then faster"
    )


class ImageDreamPriorSettings(Settings):
    """ImageDream: multi-view diffusion of four views, conditioned on an image (Wang and Shi 2023)."""

    kind: Literal["imagedream"] = "imagedream"
    weights: str = Field(
        "imagedream",
        min_length=1,
        description="a name from `dg4d weights list`, a Hugging Face hub id, or a folder in diffusers' layout",
    )
    guidance_scale: float = Field(5.0, ge=0, le=100, description="classifier-free guidance (public code: 5)")
    precision: Precision = Field(
        "fp16", description="floating-point precision of the networks on a GPU (public code: fp16)"
    )
    memory_gb: float = Field(
        24.0,
        ge=8,
        le=1024,
        description="GiB of memory to plan for, for example 12, 24 or 80; sets the batch size of rings of four views",
    )


class OraclePriorSettings(Settings):
    """Prior of ground-truth views, for tests and benchmarks."""

    kind: Literal["oracle"] = "oracle"
    blur: float = Field(0.0, ge=0, le=64, description="perturbation: standard deviation of a blur, pixels of the bank")
    color_gain: float = Field(
        0.0, ge=0, le=2, description="perturbation: standard deviation of the logarithm of a gain per view and frame"
    )
    pose_deg: float = Field(
        0.0, ge=0, le=45, description="perturbation: standard deviation of an error of every view's angles"
    )
    shift: float = Field(
        0.0,
        ge=0,
        le=64,
        description="perturbation: standard deviation of a shift per view and frame, bank pixels",
    )


PriorSettings = Annotated[
    GeometricPriorSettings
    | LearnedPriorSettings
    | Zero123PriorSettings
    | ImageDreamPriorSettings
    | OraclePriorSettings,
    Field(discriminator="kind"),
]


class BlobStartSettings(Settings):
    """Random ball of Gaussians (DreamGaussian)."""

    kind: Literal["blob"] = "blob"
    points: int = Field(5000, ge=16, le=500000, description="initial number of Gaussians")


class SurfaceStartSettings(Settings):
    """Points on the surface of the prior, predicted or inflated from the picture (ours)."""

    kind: Literal["surface"] = "surface"
    points: int = Field(
        0,
        ge=0,
        le=500000,
        description="initial number of Gaussians; 0: 8,000 on a surface that the shape network predicts, which is "
        "larger; otherwise 5,000",
    )


class LgmStartSettings(Settings):
    """LGM: Gaussians from four views by ImageDream; the learning rate of their means is a tenth (public code)."""

    kind: Literal["lgm"] = "lgm"
    weights: str = Field("lgm", min_length=1, description="a name from `dg4d weights list`, a folder, or the file")
    views_weights: str = Field(
        "imagedream", min_length=1, description="ImageDream: a name from `dg4d weights list`, a hub id, or a folder"
    )
    precision: Precision = Field(
        "fp16", description="floating-point precision of the networks on a GPU (public code: fp16)"
    )
    num_inference_steps: int = Field(30, ge=1, le=500, description="steps of ImageDream's sampler (public code: 30)")
    guidance_scale: float = Field(
        5.0, ge=0, le=100, description="classifier-free guidance of ImageDream (public code: 5)"
    )


StartSettings = Annotated[
    BlobStartSettings | SurfaceStartSettings | LgmStartSettings,
    Field(discriminator="kind"),
]


class FitSettings(Settings):
    """Settings of both fits."""

    iterations: int
    views: int
    resolution_schedule: tuple[ResolutionStage, ...] = Field(
        RESOLUTION_SCHEDULE, min_length=1, description="pixels of guidance renders by progress of the optimization"
    )
    reference_size: int = Field(256, ge=32, le=1024, description="pixels of the reference view")
    reference_schedule: tuple[ResolutionStage, ...] = Field(
        (),
        description="pixels of the reference view by progress, each at most reference_size; after the last stage "
        "reference_size is used (ours)",
    )
    viewpoints: int = Field(
        0,
        ge=0,
        le=1024,
        description="cameras of random views; priors with a surface (geometric, learned) render each once per "
        "frame and reuse the picture; 0: new ones in every iteration (paper), as always for diffusion models",
    )
    elevation_deg: float = Field(
        30.0, ge=0, le=80, description="random views have elevations within plus and minus this"
    )
    color_weight: NotNegative = Field(
        10000.0, description="weight of the color MSE of the reference view, multiplied by the progress (0 to 1)"
    )
    alpha_weight: NotNegative = Field(
        1000.0, description="weight of the alpha MSE of the reference view, multiplied by the progress (0 to 1)"
    )
    ssim_weight: NotNegative = Field(
        0.0,
        description="weight of 1 - SSIM of the reference view, multiplied by the progress (0 to 1); not in the paper",
    )
    guidance_weight: NotNegative = Field(1.0, description="weight of the prior's loss")
    t_max_start: float = Field(gt=0.02, le=1, description="T_max at the start of the annealing")
    t_max_end: Share = Field(
        0.02, description="T_max at the end (paper; the public code anneals from 1 to 0, clamped at 0.02)"
    )
    t_max_limit: float = Field(
        0.98, gt=0.02, le=0.98, description="T_max is clipped to this (first release, dynamic stage: 0.5)"
    )
    noise_draw: NoiseDraw = Field(
        "annealed", description="timestep of an iteration; annealed: T_max; uniform: random below T_max"
    )
    means_lr: Positive
    means_lr_end: Positive
    color_lr: Positive = Field(0.01, description="learning rate of the colors")
    opacity_lr: Positive = Field(0.05, description="learning rate of the opacity logits")
    scale_lr: Positive = Field(0.005, description="learning rate of the log scales")
    rotation_lr: Positive = Field(0.005, description="learning rate of the quaternions")
    lr_end: float = Field(
        1.0,
        gt=0,
        le=1,
        description="factor on the learning rates at the end, log-linear over the last half; not on those of canonical "
        "means, which have their own (ours; paper: 1)",
    )


class StaticSettings(FitSettings):
    """Static stage (DreamGaussianHD)."""

    iterations: int = Field(500, ge=0, le=20000, description="0: keep the initial cloud (public code, after LGM)")
    views: int = Field(16, ge=0, le=64, description="random views per iteration (paper: 16)")
    background: Literal["white", "random"] = Field(
        "white",
        description="background of random views; random: black in half of the iterations, else white (DreamGaussian)",
    )
    start: StartSettings = BlobStartSettings()
    t_max_start: float = Field(0.98, gt=0.02, le=1, description="T_max at the start of the annealing (paper: 0.98)")
    means_lr: Positive = Field(0.01, description="learning rate of the means at the start")
    means_lr_end: Positive = Field(0.0002, description="learning rate of the means at the end, log-linear")
    densify_every: int = Field(100, ge=1, description="iterations between densifications (DreamGaussianHD: 100)")
    densify_gradient: Positive = Field(
        0.05, description="grad2d threshold: mean NDC gradient above which a Gaussian is densified"
    )
    prune_opacity: float = Field(0.01, gt=0, lt=1, description="Gaussians with a lower opacity are removed")
    prune_scale: Positive = Field(0.05, description="world units; larger Gaussians are removed after densification")
    max_points: int = Field(100000, ge=16, description="largest number of Gaussians")


Endpoint = Annotated[
    bool,
    Field(description="frame k of T is at time k/(T-1); else at k/T (public code)"),
]


class HexPlaneSettings(Settings):
    """HexPlane: six feature planes and an MLP (Cao and Johnson 2023; paper section 3.2)."""

    kind: Literal["hexplane"] = "hexplane"
    spatial: int = Field(32, ge=2, le=512, description="resolution of the spatial axes")
    temporal: int = Field(32, ge=2, le=512, description="resolution of the time axis")
    features: int = Field(32, ge=1, le=128, description="channels of a plane")
    hidden: int = Field(64, ge=1, le=512, description="hidden units of the MLP")
    half_side: NotNegative = Field(
        0.0,
        description="half side of the planes' box around the origin, world units (public code: 1.6); "
        "0: the bounding box of the Gaussians, widened by a tenth",
    )
    endpoint: Endpoint = True
    zero_start: bool = Field(
        True,
        description="initialize the heads with zeros, so that the motion starts at zero (paper); else Xavier-uniform",
    )
    scales: tuple[Annotated[int, Field(ge=1, le=16)], ...] = Field(
        (1,), min_length=1, description="multi-resolution: factors on `spatial`; features are concatenated"
    )
    variation_weight: NotNegative = Field(
        0.0, description="weight of second differences over space, per plane (typical: 1e-4)"
    )
    smoothness_weight: NotNegative = Field(
        0.0, description="weight of second differences over time, per plane (typical: 0.01)"
    )
    sparsity_weight: NotNegative = Field(
        0.0, description="weight of the L1 distance of each time plane from one (typical: 1e-4)"
    )


class MlpSettings(Settings):
    """Ablation: MLP on the positional encoding of position and time."""

    kind: Literal["mlp"] = "mlp"
    frequencies: int = Field(6, ge=1, le=16, description="number of frequencies of the positional encoding")
    hidden: int = Field(64, ge=1, le=512, description="hidden units of the MLP")
    endpoint: Endpoint = True


class FramewiseSettings(Settings):
    """Ablation: independent displacements per frame."""

    kind: Literal["framewise"] = "framewise"
    start: Literal["static", "scattered"] = Field(
        "static",
        description="initial displacement in every frame; scattered: random, up to the object's radius, which removes "
        "the positions of the static stage",
    )


DeformationSettings = Annotated[HexPlaneSettings | MlpSettings | FramewiseSettings, Field(discriminator="kind")]


class MotionSettings(FitSettings):
    """Dynamic stage."""

    iterations: int = Field(200, ge=1, le=20000, description="iterations (paper: 200)")
    views: int = Field(4, ge=0, le=64, description="random views per frame and iteration (paper: 4, fast: 1)")
    frames_per_iteration: int = Field(0, ge=0, le=512, description="random frames per iteration; 0: all")
    guided_frames: int = Field(
        0,
        ge=0,
        le=512,
        description="number of an iteration's frames that also get random views, redrawn every iteration; 0: all "
        "(paper)",
    )
    t_max_start: float = Field(0.5, gt=0.02, le=1, description="T_max at the start of the annealing (paper: 0.5)")
    network_lr: Positive = Field(6.4e-4, description="learning rate of MLPs")
    plane_lr: Positive = Field(6.4e-3, description="learning rate of planes and frame-wise displacements")
    rigidity_weight: NotNegative = Field(0.0, description="weight of local rigidity over time (Luiten et al. 2024)")
    track_surface: bool = Field(
        True,
        description="with pictures of other sides at the first frame, and prior.kind=geometric or learned: track their "
        "surface through the video; its renders guide later frames, together with those of the shapes that optical "
        "flow carries if no picture shows the sides (ours)",
    )
    trackings: Literal[1, 3] = Field(
        3,
        description="number of different trackings of that surface, whose median counts, 4 of one with 12 views or "
        "more; 1: faster by a minute or two (ours)",
    )
    fine_tune: bool = Field(False, description="optimize the canonical Gaussians too (paper: no; public code: yes)")
    means_lr: Positive = Field(0.001, description="learning rate of the canonical means at the start (public code)")
    means_lr_end: Positive = Field(
        2e-5, description="learning rate of the canonical means at the end, log-linear (public code)"
    )
    length_scale: Positive = Field(
        1.0,
        description="factor on learning rates of lengths: of the canonical means and of the layer that predicts their "
        "displacement; 4/3 for Gaussians by LGM, whose rates belong to cameras at radius 1.5",
    )


class MeshSettings(Settings):
    """Extraction of textured meshes from Gaussians."""

    mode: Literal["tracked", "per_frame", "auto"] = Field(
        "tracked",
        description="tracked: one deforming mesh (ours); per_frame: one mesh per frame (paper); auto: tracked if one "
        "mesh can follow the motion",
    )
    min_followed: Share = Field(
        0.87,
        description="smallest silhouette IoU of the best trial mesh that moves with the Gaussians; below, the mesh "
        "follows the driving video, or without one, mode auto uses a mesh per frame",
    )
    max_stretch: NotNegative = Field(
        0.25,
        description="largest stretch of that trial mesh (root mean square logarithm of its edges over those at rest); "
        "above, the mesh follows the driving video if there is one",
    )
    min_guided: Share = Field(
        0.85,
        description="mode auto: smallest silhouette IoU of the best trial mesh that follows the driving video; below, "
        "a mesh per frame is used",
    )
    source: Literal["gaussians", "prior"] = Field(
        "gaussians",
        description="source of a tracked mesh: density of the Gaussians, or the shape that the learned prior predicts, "
        "if no other views are known",
    )
    grid: int = Field(128, ge=16, le=512, description="resolution of the density field on each axis of [-1, 1]")
    min_opacity: float = Field(0.005, ge=0, lt=1, description="Gaussians below this opacity are ignored")
    density_threshold: Positive = Field(0.5, description="first isosurface level that is tried; unused by source=prior")
    edge_length: float = Field(
        0.015, gt=0, le=0.3, description="edge length of isotropic remeshing; the sides of the normalized box are 2"
    )
    fairing: float = Field(
        0.0, ge=0, le=1, description="world units; bumps of this wavelength lose half of their height"
    )
    max_faces: int = Field(
        100000,
        ge=100,
        description="largest number of triangles; thin parts that are added later (antennae, whiskers) do not count",
    )
    min_component: Share = Field(0.02, description="components with a smaller fraction of the faces are removed")
    unwrap: UnwrapMethod = Field(
        "charts",
        description="charts: even texel density, no mirrored charts (ours); xatlas: half the time, more charts",
    )
    texture_size: int = Field(1024, ge=64, le=8192, description="texels per side")
    render_size: int = Field(512, ge=64, le=2048, description="pixels of the renders that are baked into the texture")
    mirror_texture: bool = Field(
        True,
        description="if source=prior: texture the far side with the mirror image of the near side, instead of a "
        "blurred guess",
    )
