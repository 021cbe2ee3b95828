"""Every knob: default, unit, allowed range and source.

The defaults are the paper's; profiles differ by name (steps/profiles.py). "Ours" marks a choice of this project.
"""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]


class Settings(BaseModel):
    """Frozen and closed: an unknown key is refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Rung(Settings):
    """One rung of a resolution ladder."""

    until: Share = Field(description="used while progress is below this")
    size: int = Field(ge=16, le=2048, description="pixels of a guidance render")


LADDER = (Rung(until=0.3, size=128), Rung(until=0.6, size=256), Rung(until=1.0, size=512))


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
    max_frames: int = Field(32, ge=2, le=512, description="frames taken from a video; longer ones are sampled evenly")


class DrivingSettings(Settings):
    """Where the driving video comes from when the user has none."""

    motion: Literal["sway", "bend", "breathe", "bounce", "wave", "turn"] = Field(
        "sway", description="weights-free motion, ours"
    )
    strength: float = Field(1.0, gt=0, le=3, description="times the motion's own amplitude")
    frames: int = Field(14, ge=2, le=128, description="frames of a generated video (paper: 14)")
    fps: float = Field(7.0, gt=0, le=120, description="frames per second of a generated video (paper: 7)")


class GeometricPriorSettings(Settings):
    """Renders of a surface inflated from the picture stand in for a diffusion model; no weights."""

    kind: Literal["geometric"] = "geometric"
    size: int = Field(128, ge=32, le=512, description="pixels at which the surface is built")
    turn_deg: float = Field(
        0.0, ge=-60, le=60, description="how far the subject's plane is turned away from the camera; a user's hint"
    )
    depth_sigma: float = Field(
        0.03,
        ge=0,
        le=0.5,
        description="standard deviation of the guessed depth, world units: a view from the side is the average over it,"
        " soft along the direction in which depth shows",
    )
    coverage_weight: NotNegative = Field(1.0, description="weight of alpha against color in the clean picture, ours")


class OraclePriorSettings(Settings):
    """Knows the true views; for tests and benchmarks."""

    kind: Literal["oracle"] = "oracle"
    coverage_weight: NotNegative = Field(1.0, description="weight of alpha against color in the clean picture, ours")


PriorSettings = Annotated[GeometricPriorSettings | OraclePriorSettings, Field(discriminator="kind")]


class StaticSettings(Settings):
    """The DreamGaussianHD loop."""

    iterations: int = Field(500, ge=1, le=20000)
    views: int = Field(16, ge=0, le=64, description="random views per iteration (paper: 16)")
    ladder: tuple[Rung, ...] = Field(LADDER, min_length=1)
    reference_size: int = Field(256, ge=32, le=1024, description="pixels of the reference view")
    start: Literal["blob", "surface"] = Field(
        "blob", description="blob: a random ball; surface: points on the prior's surface (ours)"
    )
    points: int = Field(5000, ge=16, le=500000, description="Gaussians at the start")
    blob_radius: Positive = Field(0.5, description="world units")
    elevation_deg: float = Field(30.0, ge=0, le=80, description="random views lie within plus and minus this")
    radius_jitter: float = Field(0.5, ge=0, lt=1.5, description="random radius 2 +- this, world units")
    color_weight: NotNegative = Field(10000.0, description="reference view, times progress, mean squared error")
    alpha_weight: NotNegative = Field(1000.0, description="reference view, times progress, mean squared error")
    guidance_weight: NotNegative = 1.0
    noise_start: float = Field(0.98, gt=0.02, le=1, description="T_max at the start of the annealing")
    mean_rate: Positive = Field(0.01, description="learning rate of the means at the start")
    mean_rate_end: Positive = Field(0.0002, description="and at the end, log-linear")
    color_rate: Positive = 0.01
    opacity_rate: Positive = 0.05
    scale_rate: Positive = 0.005
    rotation_rate: Positive = 0.005
    densify_every: int = Field(100, ge=1, description="iterations between density controls (DreamGaussianHD: 100)")
    densify_gradient: Positive = Field(0.05, description="mean NDC gradient above which a Gaussian grows")
    densify_scale: Positive = Field(0.05, description="world units: larger ones split, smaller ones are cloned")
    prune_opacity: float = Field(0.01, gt=0, lt=1)
    prune_scale: Positive = Field(0.05, description="world units; larger ones are removed after a split")
    max_points: int = Field(100000, ge=16, description="growth stops here")
    reset_opacity_every: int = Field(700, ge=1, description="iterations (never reached within 500)")


class HexPlaneSettings(Settings):
    """Six planes and a small network (Cao and Johnson 2023; paper section 3.2)."""

    kind: Literal["hexplane"] = "hexplane"
    spatial: int = Field(32, ge=2, le=512, description="cells of a spatial axis")
    temporal: int = Field(32, ge=2, le=512, description="cells of the time axis")
    features: int = Field(32, ge=1, le=128)
    hidden: int = Field(64, ge=1, le=512)
    scales: tuple[Annotated[int, Field(ge=1, le=16)], ...] = Field(
        (1,), min_length=1, description="multi-resolution: factors on `spatial`, concatenated"
    )
    variation_weight: NotNegative = Field(0.0, description="total variation of the spatial planes (1e-4 when used)")
    smoothness_weight: NotNegative = Field(0.0, description="second difference over time (0.01 when used)")
    sparsity_weight: NotNegative = Field(0.0, description="L1 distance of time planes from one (1e-4 when used)")


class MlpSettings(Settings):
    """Ablation: positional encoding of place and time, one network."""

    kind: Literal["mlp"] = "mlp"
    frequencies: int = Field(6, ge=1, le=16)
    hidden: int = Field(64, ge=1, le=512)


class FramewiseSettings(Settings):
    """Ablation: a free displacement per frame."""

    kind: Literal["framewise"] = "framewise"


DeformationSettings = Annotated[HexPlaneSettings | MlpSettings | FramewiseSettings, Field(discriminator="kind")]


class MotionSettings(Settings):
    """The dynamic stage."""

    iterations: int = Field(200, ge=1, le=20000)
    views: int = Field(4, ge=0, le=64, description="random views per frame and iteration (paper: 4, fast: 1)")
    frames_per_iteration: int = Field(
        0, ge=0, le=512, description="frames drawn at random per iteration; 0 is all of them"
    )
    ladder: tuple[Rung, ...] = Field(LADDER, min_length=1)
    reference_size: int = Field(256, ge=32, le=1024, description="pixels of the reference view")
    elevation_deg: float = Field(30.0, ge=0, le=80, description="random views lie within plus and minus this")
    color_weight: NotNegative = Field(10000.0, description="reference views, times progress, mean squared error")
    alpha_weight: NotNegative = Field(1000.0, description="reference views, times progress, mean squared error")
    guidance_weight: NotNegative = 1.0
    noise_start: float = Field(0.5, gt=0.02, le=1, description="T_max at the start of the annealing (paper: 0.5)")
    network_rate: Positive = Field(6.4e-4, description="learning rate of networks")
    plane_rate: Positive = Field(6.4e-3, description="learning rate of planes and frame-wise displacements")
    rigidity_weight: NotNegative = Field(0.0, description="local rigidity over time (Luiten et al. 2024)")


class MeshSettings(Settings):
    """From Gaussians to triangles with a texture."""

    mode: Literal["tracked", "per_frame"] = Field(
        "tracked", description="one mesh that moves (ours), or a mesh per frame (paper)"
    )
    grid: int = Field(128, ge=16, le=512, description="cells of the density field on each axis of [-1, 1]")
    min_opacity: float = Field(0.005, ge=0, lt=1, description="fainter Gaussians do not count")
    density_threshold: Positive = Field(0.5, description="level of the surface (1.0 for plain statics)")
    edge_length: Positive = Field(0.015, description="of the isotropic remeshing, in units of the normalized box")
    max_faces: int = Field(100000, ge=100)
    min_component: Share = Field(0.02, description="components with a smaller share of the faces are dropped")
    texture_size: int = Field(1024, ge=64, le=8192, description="texels of a side")
    render_size: int = Field(512, ge=64, le=2048, description="pixels of the renders that are projected back")
    min_cosine: float = Field(0.5, gt=0, lt=1, description="texels seen at a flatter angle are not colored")
    frames_per_task: int = Field(4, ge=1, le=128, description="mode per_frame: frames that one task extracts")


class RefinerSettings(Settings):
    """Texture refinement; `identity` hands the texture through."""

    kind: Literal["identity"] = "identity"


class PackSettings(Settings):
    """What the package holds."""

    splats: bool = Field(True, description="one standard PLY per frame")
    preview_size: int = Field(384, ge=64, le=2048, description="pixels of preview.mp4 (even)", multiple_of=2)
    preview_turns: int = Field(3, ge=1, le=20, description="times the motion loops while the camera goes round once")
    sheet_size: int = Field(192, ge=32, le=1024, description="pixels of a tile of the contact sheet")
    sheet_frames: int = Field(6, ge=1, le=32, description="columns: moments")
    sheet_azimuths_deg: tuple[Annotated[float, Field(ge=-360, le=360)], ...] = Field(
        (0.0, -75.0, 15.0, 105.0, 195.0), min_length=1, description="rows: angles"
    )
