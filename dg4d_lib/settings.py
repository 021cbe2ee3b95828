"""Every knob: default, unit, allowed range and source.

The defaults are the paper's; profiles differ by name (steps/profiles.py). "Ours" marks a choice of this project.
"""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Precision = Literal["fp16", "bf16", "fp32"]
NoiseDraw = Literal["annealed", "uniform"]  # the timestep of an iteration: T_max itself, or drawn evenly below it


class Settings(BaseModel):
    """Frozen and closed: an unknown key is refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ResolutionStage(Settings):
    """Stage of a resolution schedule."""

    until: Share = Field(description="used while progress is below this")
    size: int = Field(ge=16, le=2048, description="pixels of a guidance render")


RESOLUTION_SCHEDULE = (
    ResolutionStage(until=0.3, size=128),
    ResolutionStage(until=0.6, size=256),
    ResolutionStage(until=1.0, size=512),
)


class TextSettings(Settings):
    """A picture drawn from words by any text-to-image pipeline of diffusers; only for orders that begin with words."""

    weights: str = Field("", description="an id of the Hugging Face hub, or a folder in diffusers' layout; empty: none")
    size: int = Field(512, ge=32, le=2048, multiple_of=8, description="pixels of the square picture")
    num_inference_steps: int = Field(30, ge=1, le=1000, description="of denoising")
    guidance_scale: float = Field(7.5, ge=0, le=100, description="classifier-free guidance")
    suffix: str = Field(
        ", the whole of it in the middle of the picture, plain white background",
        max_length=1000,
        description="added to the words, so that the subject can be cut out",
    )
    precision: Precision = Field("fp16", description="of the networks; without a GPU always fp32")
    low_memory: bool = Field(False, description="only the network that is at work is on the GPU; slower")


class SubjectSettings(Settings):
    """From any picture or video to cut-outs in one square frame."""

    size: int = Field(512, ge=32, le=2048, description="pixels of the square frame")
    framing: Literal["auto", "center", "keep"] = Field(
        "auto",
        description="center: crop to the subject and center it; keep: the frame as it is; "
        "auto: keep a square cut-out whose subject lies inside, else center",
    )
    border: float = Field(
        0.2, ge=0, lt=0.9, description="share of the frame left free around a centered subject (paper's code)"
    )
    turn_deg: float = Field(
        0.0, ge=-60, le=60, description="how far the subject's plane is turned away from the camera; a user's hint"
    )
    ground_turn: float = Field(
        0.6,
        ge=0,
        le=1,
        description="factor on the turn found from the ground line of footage, where `turn_deg` is 0; 0: none",
    )
    max_frames: int = Field(32, ge=2, le=512, description="frames taken from a video; longer ones are sampled evenly")
    max_decode_gb: float = Field(
        1.0, ge=0.125, le=256, description="GiB of memory for decoding the source, its decoded frames included; ours"
    )


class VideoModelSettings(Settings):
    """Stable Video Diffusion, wherever it is used (Blattmann et al. 2023)."""

    weights: str = Field(
        "svd", min_length=1, description="a name of `dg4d weights list`, or a folder in the diffusers layout"
    )
    precision: Precision = Field("fp16", description="of the networks; without a GPU always fp32")
    low_memory: bool = Field(False, description="only the network that is at work is on the GPU; slower")
    num_inference_steps: int = Field(25, ge=2, le=200, description="noise levels of the whole schedule")
    min_guidance_scale: float = Field(1.0, ge=0, le=20, description="classifier-free guidance of the first frame")
    max_guidance_scale: float = Field(3.0, ge=0, le=20, description="and of the last, linear between")
    fps_id: int = Field(6, ge=0, le=30, description="what the network is told; 6 is playback at 7 frames per second")
    motion_bucket_id: int = Field(127, ge=0, le=255, description="what the network is told: how much moves")
    noise_aug_strength: float = Field(
        0.02, ge=0, le=1, description="noise on the picture that is animated, pictures in [-1, 1]"
    )
    memory_gb: float = Field(
        24.0,
        ge=6,
        le=1024,
        description="GiB of memory to plan for, say 12, 24 or 80: what goes through at once, at most the next two",
    )
    videos_at_once: int = Field(
        2, ge=1, le=64, description="videos in the network at a time; each counts twice, with and without the picture"
    )
    decode_chunk_size: int = Field(14, ge=1, le=128, description="frames that are encoded or decoded at a time")


Candidates = Annotated[
    int, Field(ge=1, le=16, description="motions made, scored and shown; the best one is taken unless `pick` says")
]
Pick = Annotated[int, Field(ge=0, le=16, description="candidate that is made, and no other; 0 is the best of all")]


Motion = Literal["sway", "bend", "breathe", "bounce", "wave", "turn"]


class WarpSettings(Settings):
    """The picture itself, warped in a loop; no weights."""

    kind: Literal["warp"] = "warp"
    candidates: Candidates = 1
    pick: Pick = 0
    motion: Motion = Field(
        "sway", description="weights-free motion, ours; of the first candidate, the others take the others"
    )
    strength: float = Field(1.0, gt=0, le=3, description="times the motion's own amplitude")
    frames: int = Field(14, ge=2, le=128, description="frames of a generated video (paper: 14)")
    fps: float = Field(7.0, gt=0, le=120, description="frames per second of a generated video (paper: 7)")


class SvdSettings(Settings):
    """Stable Video Diffusion animates the picture; candidate k has the seed of the order plus k - 1."""

    kind: Literal["svd"] = "svd"
    candidates: Candidates = 1
    pick: Pick = 0
    model: VideoModelSettings = VideoModelSettings()
    frames: int = Field(14, ge=2, le=64, description="of the video; svd was trained on 14, svd-xt on 25")
    fps: float = Field(7.0, gt=0, le=120, description="frames per second of playback (paper: 7)")
    height: int = Field(512, ge=64, le=2048, multiple_of=64, description="pixels (public code: 512; trained on 576)")
    width: int = Field(512, ge=64, le=2048, multiple_of=64, description="pixels (public code: 512; trained on 1024)")


DrivingSettings = Annotated[WarpSettings | SvdSettings, Field(discriminator="kind")]


class GeometricPriorSettings(Settings):
    """Renders of a surface inflated from the picture stand in for a diffusion model; no weights."""

    kind: Literal["geometric"] = "geometric"
    size: int = Field(128, ge=32, le=512, description="pixels at which the surface is built")
    depth_sigma: float = Field(
        0.03,
        ge=0,
        le=0.5,
        description="standard deviation of the guessed depth, world units: a view from the side is the average over it,"
        " soft along the direction in which depth shows",
    )


class LearnedPriorSettings(Settings):
    """Shape prior of this package, trained on made-up shapes: expected views of the subject; no download."""

    kind: Literal["learned"] = "learned"
    weight: float = Field(
        0.5,
        ge=0,
        le=10,
        description="factor on the guidance loss: expected views are soft, and half of it leaves the input view sharp",
    )
    contrast: float = Field(
        1.2,
        ge=0.25,
        le=16,
        description="factor on the log-odds of matter: more gives sharper unseen sides, farther from the truth",
    )
    level: float = Field(
        0.35,
        ge=0.05,
        le=0.95,
        description="probability of matter at which the surface lies that the static fit starts on",
    )


class Zero123PriorSettings(Settings):
    """Zero-1-to-3, a diffusion model of how a picture looks from another camera (Liu et al. 2023)."""

    kind: Literal["zero123"] = "zero123"
    weights: str = Field(
        "zero123-xl",
        min_length=1,
        description="a name from `dg4d weights list`, an id of the Hugging Face hub, or a folder in diffusers' layout",
    )
    variant: Literal["xl", "stable"] = Field(
        "xl",
        description="the last number that the model is told of a camera: xl: its radius less the input's;"
        " stable (Stable-Zero123): the input's angle from the pole",
    )
    input_elevation_deg: float = Field(
        0.0, ge=-80, le=80, description="how far above the subject its picture was taken; variant stable is told"
    )
    guidance_scale: float = Field(5.0, ge=0, le=100, description="classifier-free guidance (paper's code: 5)")
    precision: Precision = Field("fp16", description="of the networks; without a GPU always fp32")
    memory_gb: float = Field(
        24.0,
        ge=6,
        le=1024,
        description="GiB of memory to plan for, say 12, 24 or 80: how many views are judged at once",
    )
    compiled: bool = Field(False, description="let torch compile the networks: minutes at the start, then faster")


class ImageDreamPriorSettings(Settings):
    """ImageDream, a diffusion model of how a picture looks from four sides at once (Wang and Shi 2023)."""

    kind: Literal["imagedream"] = "imagedream"
    weights: str = Field(
        "imagedream",
        min_length=1,
        description="a name from `dg4d weights list`, an id of the Hugging Face hub, or a folder in diffusers' layout",
    )
    guidance_scale: float = Field(5.0, ge=0, le=100, description="classifier-free guidance (public code: 5)")
    precision: Precision = Field("fp16", description="of the networks, on a GPU (public code: fp16)")
    memory_gb: float = Field(
        24.0,
        ge=8,
        le=1024,
        description="GiB of memory to plan for, say 12, 24 or 80: how many rings of four views are judged at once",
    )


class OraclePriorSettings(Settings):
    """Knows the true views; for tests and benchmarks."""

    kind: Literal["oracle"] = "oracle"
    blur: float = Field(0.0, ge=0, le=64, description="imperfection: standard deviation of a blur, pixels of the bank")
    color_gain: float = Field(
        0.0, ge=0, le=2, description="imperfection: standard deviation of the logarithm of a gain per view and frame"
    )
    pose_deg: float = Field(
        0.0, ge=0, le=45, description="imperfection: standard deviation of an error of every view's angles"
    )
    shift: float = Field(
        0.0,
        ge=0,
        le=64,
        description="imperfection: standard deviation of a shift per view and frame, bank pixels",
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
    points: int = Field(5000, ge=16, le=500000, description="Gaussians at the start")


class SurfaceStartSettings(Settings):
    """Points on the surface of the prior, predicted or inflated from the picture (ours)."""

    kind: Literal["surface"] = "surface"
    points: int = Field(5000, ge=16, le=500000, description="Gaussians at the start")


class LgmStartSettings(Settings):
    """Gaussians by LGM from four views that ImageDream makes; their means then move a tenth as fast (public code)."""

    kind: Literal["lgm"] = "lgm"
    weights: str = Field("lgm", min_length=1, description="a name from `dg4d weights list`, a folder, or the file")
    views_weights: str = Field(
        "imagedream", min_length=1, description="of ImageDream: a name from `dg4d weights list`, a hub id, or a folder"
    )
    precision: Precision = Field("fp16", description="of the networks, on a GPU (public code: fp16)")
    num_inference_steps: int = Field(30, ge=1, le=500, description="of ImageDream's sampler (public code: 30)")
    guidance_scale: float = Field(5.0, ge=0, le=100, description="classifier-free, of ImageDream (public code: 5)")


StartSettings = Annotated[
    BlobStartSettings | SurfaceStartSettings | LgmStartSettings,
    Field(discriminator="kind"),
]


class FitSettings(Settings):
    """Knobs that the static and the dynamic stage share."""

    iterations: int
    views: int
    resolution_schedule: tuple[ResolutionStage, ...] = Field(
        RESOLUTION_SCHEDULE, min_length=1, description="pixels of guidance renders by progress of the optimization"
    )
    reference_size: int = Field(256, ge=32, le=1024, description="pixels of the reference view")
    elevation_deg: float = Field(30.0, ge=0, le=80, description="random views lie within plus and minus this")
    color_weight: NotNegative = Field(10000.0, description="reference view, times progress, mean squared error")
    alpha_weight: NotNegative = Field(1000.0, description="reference view, times progress, mean squared error")
    ssim_weight: NotNegative = Field(0.0, description="reference view, times progress, 1 - SSIM; not in the paper")
    guidance_weight: NotNegative = Field(1.0, description="weight of the prior's loss")
    t_max_start: float = Field(gt=0.02, le=1, description="T_max at the start of the annealing")
    t_max_end: Share = Field(0.02, description="and at its end (paper; the public code goes from 1 to 0, cut at 0.02)")
    noise_draw: NoiseDraw = Field(
        "annealed", description="timestep of an iteration; annealed: T_max itself; uniform: drawn below it"
    )
    means_lr: Positive
    means_lr_end: Positive
    color_lr: Positive = Field(0.01, description="learning rate of the colors")
    opacity_lr: Positive = Field(0.05, description="learning rate of the opacity logits")
    scale_lr: Positive = Field(0.005, description="learning rate of the log scales")
    rotation_lr: Positive = Field(0.005, description="learning rate of the quaternions")


class StaticSettings(FitSettings):
    """The DreamGaussianHD loop."""

    iterations: int = Field(500, ge=0, le=20000, description="0 leaves the start as it is (public code, after LGM)")
    views: int = Field(16, ge=0, le=64, description="random views per iteration (paper: 16)")
    background: Literal["white", "random"] = Field(
        "white", description="behind random views; random: black in half of the iterations (DreamGaussian)"
    )
    start: StartSettings = BlobStartSettings()
    t_max_start: float = Field(0.98, gt=0.02, le=1, description="T_max at the start of the annealing (paper: 0.98)")
    means_lr: Positive = Field(0.01, description="learning rate of the means at the start")
    means_lr_end: Positive = Field(0.0002, description="and at the end, log-linear")
    densify_every: int = Field(100, ge=1, description="iterations between density controls (DreamGaussianHD: 100)")
    densify_gradient: Positive = Field(0.05, description="mean NDC gradient above which a Gaussian grows")
    prune_opacity: float = Field(0.01, gt=0, lt=1, description="Gaussians with a lower opacity are removed")
    prune_scale: Positive = Field(0.05, description="world units; larger ones are removed after a split")
    max_points: int = Field(100000, ge=16, description="growth stops here")


Endpoint = Annotated[
    bool,
    Field(description="frame k of T lies at k/(T-1) of the time axis, its end included; else at k/T (public code)"),
]


class HexPlaneSettings(Settings):
    """Six planes and a small network (Cao and Johnson 2023; paper section 3.2)."""

    kind: Literal["hexplane"] = "hexplane"
    spatial: int = Field(32, ge=2, le=512, description="cells of a spatial axis")
    temporal: int = Field(32, ge=2, le=512, description="cells of the time axis")
    features: int = Field(32, ge=1, le=128, description="channels of a plane")
    hidden: int = Field(64, ge=1, le=512, description="hidden units of the network")
    half_side: NotNegative = Field(
        0.0,
        description="of the box that the planes cover around the origin, world units (public code: 1.6); "
        "0: the box of the Gaussians and a tenth more",
    )
    endpoint: Endpoint = True
    zero_start: bool = Field(
        True, description="the heads are zero at the start and so is the motion (paper); else Xavier-uniform (ablation)"
    )
    scales: tuple[Annotated[int, Field(ge=1, le=16)], ...] = Field(
        (1,), min_length=1, description="multi-resolution: factors on `spatial`, concatenated"
    )
    variation_weight: NotNegative = Field(0.0, description="total variation of the spatial planes (1e-4 when used)")
    smoothness_weight: NotNegative = Field(0.0, description="second difference over time (0.01 when used)")
    sparsity_weight: NotNegative = Field(0.0, description="L1 distance of time planes from one (1e-4 when used)")


class MlpSettings(Settings):
    """Ablation: positional encoding of place and time, one network."""

    kind: Literal["mlp"] = "mlp"
    frequencies: int = Field(6, ge=1, le=16, description="of the positional encoding")
    hidden: int = Field(64, ge=1, le=512, description="hidden units of the network")
    endpoint: Endpoint = True


class FramewiseSettings(Settings):
    """Ablation: a free displacement per frame."""

    kind: Literal["framewise"] = "framewise"
    start: Literal["static", "scattered"] = Field(
        "static",
        description="of every frame; scattered: each Gaussian up to the object's radius away, so that the static stage "
        "says nothing of places",
    )


DeformationSettings = Annotated[HexPlaneSettings | MlpSettings | FramewiseSettings, Field(discriminator="kind")]


class MotionSettings(FitSettings):
    """The dynamic stage."""

    iterations: int = Field(200, ge=1, le=20000, description="of the motion fit (paper: 200)")
    views: int = Field(4, ge=0, le=64, description="random views per frame and iteration (paper: 4, fast: 1)")
    frames_per_iteration: int = Field(
        0, ge=0, le=512, description="frames drawn at random per iteration; 0 is all of them"
    )
    t_max_start: float = Field(0.5, gt=0.02, le=1, description="T_max at the start of the annealing (paper: 0.5)")
    network_lr: Positive = Field(6.4e-4, description="learning rate of networks")
    plane_lr: Positive = Field(6.4e-3, description="learning rate of planes and frame-wise displacements")
    rigidity_weight: NotNegative = Field(0.0, description="local rigidity over time (Luiten et al. 2024)")
    fine_tune: bool = Field(
        False,
        description="the Gaussians at rest are optimized too, at the rates below (paper: frozen; public code: so)",
    )
    means_lr: Positive = Field(0.001, description="learning rate of the means at rest, at the start (public code)")
    means_lr_end: Positive = Field(2e-5, description="and at the end, log-linear (public code)")


class MeshSettings(Settings):
    """From Gaussians to triangles with a texture."""

    mode: Literal["tracked", "per_frame", "auto"] = Field(
        "tracked",
        description="one mesh that moves (ours), a mesh per frame (paper), or one where it can follow the motion",
    )
    grid: int = Field(128, ge=16, le=512, description="cells of the density field on each axis of [-1, 1]")
    min_opacity: float = Field(0.005, ge=0, lt=1, description="fainter Gaussians do not count")
    density_threshold: Positive = Field(0.5, description="level of the surface (1.0 for plain statics)")
    edge_length: Positive = Field(0.015, description="of the isotropic remeshing, in units of the normalized box")
    max_faces: int = Field(100000, ge=100, description="triangles of a mesh, never more")
    min_component: Share = Field(0.02, description="components with a smaller share of the faces are dropped")
    texture_size: int = Field(1024, ge=64, le=8192, description="texels of a side")
    render_size: int = Field(512, ge=64, le=2048, description="pixels of the renders that are projected back")


class IdentitySettings(Settings):
    """The texture stays as it is."""

    kind: Literal["identity"] = "identity"


class TextureSettings(Settings):
    """A texture follows better pictures (paper section 3.4)."""

    iterations: int = Field(50, ge=1, le=2000, description="of texture refinement (paper: 50)")
    lr: Positive = Field(0.2, description="Adam's learning rate of the logits of the colors")
    size: int = Field(512, ge=64, le=1024, multiple_of=64, description="pixels of the pictures")
    min_cosine: Share = Field(0.5, description="the reference view says nothing where the surface is flatter")
    azimuth_step_deg: float = Field(
        10.0, ge=-180, le=180, description="by which the camera goes on from frame to frame, from a random start"
    )
    refresh_every: int = Field(
        1, ge=1, le=2000, description="iterations between new trajectories and new targets (paper: 1)"
    )
    frame_size: int = Field(
        0,
        ge=0,
        le=1024,
        description="of a tracked mesh: texels of a side of what every frame adds to the shared texture, and of the "
        "textures per frame that come out; 0: one texture for all frames (ours)",
    )
    frame_weight: NotNegative = Field(
        0.01, description="of the squares of what frames add, and of its changes from frame to frame"
    )


class VideoToVideoSettings(Settings):
    """A video of the moving mesh, noised and denoised by Stable Video Diffusion (paper section 3.4)."""

    kind: Literal["video_to_video"] = "video_to_video"
    texture: TextureSettings = TextureSettings()
    model: VideoModelSettings = VideoModelSettings()
    strength: float = Field(
        0.3, gt=0, le=1, description="share of the noise levels that is used: 0.3 of 25 starts at sigma 1.273"
    )


class ImageToImageSettings(Settings):
    """Every picture on its own, noised and denoised by Zero-1-to-3 (Tang et al. 2024, section 3.3); the ablation."""

    kind: Literal["image_to_image"] = "image_to_image"
    texture: TextureSettings = TextureSettings()
    prior: Zero123PriorSettings = Zero123PriorSettings()
    num_inference_steps: int = Field(50, ge=2, le=500, description="noise levels of the whole schedule, DDIM")
    strength_start: float = Field(0.5, gt=0, le=1, description="share of them that is used in the first iteration")
    strength_end: float = Field(0.05, gt=0, le=1, description="and in the last, linear between")


RefinerSettings = Annotated[IdentitySettings | VideoToVideoSettings | ImageToImageSettings, Field(discriminator="kind")]
