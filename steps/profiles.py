"""The settings of a whole pipeline, the named profiles, and the one way to change a knob."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError

from dg4d_lib.asset_settings import GateSettings, PackSettings, ScoreSettings
from dg4d_lib.errors import BadInput
from dg4d_lib.rasterizer.choice import backend_name
from dg4d_lib.settings import (
    DeformationSettings,
    DrivingSettings,
    GeometricPriorSettings,
    HexPlaneSettings,
    IdentitySettings,
    MeshSettings,
    MotionSettings,
    PriorSettings,
    RefinerSettings,
    Rung,
    Settings,
    StaticSettings,
    SubjectSettings,
    TextSettings,
    WarpSettings,
)

LARGEST_WHOLE = 2**53  # of a knob; readers of JSON disagree about larger numbers
SHOWN = 80  # letters of a value in a message

RasterizerName = Literal["auto", "reference", "cpu", "cuda_gsplat"]
Backend = Annotated[RasterizerName, AfterValidator(backend_name)]  # never `auto`: a request says what will draw


class PipelineSettings(Settings):
    """Every knob of every stage; the command line's `--set stage.knob=value`."""

    rasterizer: RasterizerName = Field("auto", description="auto: cuda_gsplat where that can run, else cpu")
    text: TextSettings = TextSettings()
    subject: SubjectSettings = SubjectSettings()
    driving: DrivingSettings = WarpSettings()
    prior: PriorSettings = GeometricPriorSettings()
    static: StaticSettings = StaticSettings()
    deformation: DeformationSettings = HexPlaneSettings()
    motion: MotionSettings = MotionSettings()
    mesh: MeshSettings = MeshSettings()
    refiner: RefinerSettings = IdentitySettings()
    pack: PackSettings = PackSettings()
    gates: GateSettings = GateSettings()


class DriveVideoSettings(Settings):
    """What `drive_video` reads."""

    driving: DrivingSettings
    turn_deg: float = Field(0.0, ge=-60, le=60, description="how far the subject is turned; the geometric prior's hint")


class FitGaussiansSettings(Settings):
    """What `fit_gaussians` reads."""

    rasterizer: Backend
    prior: PriorSettings
    static: StaticSettings


class FitMotionSettings(Settings):
    """What `fit_motion` reads."""

    rasterizer: Backend
    prior: PriorSettings
    deformation: DeformationSettings
    motion: MotionSettings


class ExtractMeshSettings(Settings):
    """What `extract_mesh` reads."""

    rasterizer: Backend
    mesh: MeshSettings
    first_frame: int = Field(0, ge=0, description="mode per_frame: first frame of this task")
    end_frame: int = Field(0, ge=0, description="mode per_frame: one past the last; 0 is all frames")


class JoinMeshesSettings(Settings):
    """Settings of `join_meshes`, which has none."""


class RefineTextureSettings(Settings):
    """What `refine_texture` reads."""

    refiner: RefinerSettings


class PackAssetSettings(Settings):
    """What `pack_asset` reads."""

    rasterizer: Backend
    pack: PackSettings
    notes: tuple[str, ...] = Field((), description="sentences that travel in the files, say that no model was used")


class CheckAssetSettings(Settings):
    """What `check_asset` reads."""

    rasterizer: Backend
    gates: GateSettings


class ScoreAssetSettings(Settings):
    """What `score_asset` reads."""

    rasterizer: Backend
    mesh: bool = Field(False, description="the textured mesh is judged instead of the splats")
    score: ScoreSettings = ScoreSettings()


def step_settings(step: str, settings: PipelineSettings, **values: Any) -> Settings:
    """Return the settings of a step: the sections of the pipeline's settings that it reads, and values of this run."""
    match step:
        case "draw_picture":
            return settings.text
        case "prepare_subject":
            return settings.subject
        case "drive_video":
            turn_deg = settings.prior.turn_deg if isinstance(settings.prior, GeometricPriorSettings) else 0.0
            return DriveVideoSettings(driving=settings.driving, turn_deg=turn_deg)
        case "join_meshes":
            return JoinMeshesSettings()
        case "refine_texture":
            return RefineTextureSettings(refiner=settings.refiner)
    models: dict[str, type[Settings]] = {
        "fit_gaussians": FitGaussiansSettings,
        "fit_motion": FitMotionSettings,
        "extract_mesh": ExtractMeshSettings,
        "pack_asset": PackAssetSettings,
        "check_asset": CheckAssetSettings,
    }
    model = models[step]
    sections = {name: getattr(settings, name) for name in model.model_fields if hasattr(settings, name)}
    return model.model_validate(sections | values)


def revise(settings: PipelineSettings, changes: dict[str, Any]) -> PipelineSettings:
    """The same settings with some dotted keys changed, validated again.

    Another `kind` starts from its own defaults, and is chosen before anything else is set.

    Raises:
        BadInput: a key that does not exist, or a value out of range; says which and what is allowed.
    """
    tree = settings.model_dump(mode="json")
    for key, value in changes.items():
        if isinstance(value, int) and abs(value) > LARGEST_WHOLE:
            raise BadInput(f"{key} = {_shown(value)} is out of range; use at most {LARGEST_WHOLE}")
    for key, value in sorted(changes.items(), key=lambda change: not change[0].endswith(".kind")):
        *path, last = key.split(".")
        branch: Any = tree
        for i, name in enumerate([*path, last]):
            if not isinstance(branch, dict) or name not in branch:
                known = ", ".join(sorted(branch)) if isinstance(branch, dict) else "nothing: it is a value"
                raise BadInput(f"unknown setting {key!r}: {'.'.join(key.split('.')[:i]) or 'the pipeline'} has {known}")
            if i < len(path):
                branch = branch[name]
        if last == "kind" and branch[last] != value:
            branch.clear()
        branch[last] = value
        tree = _with_defaults(tree)
    try:
        return PipelineSettings.model_validate(tree)
    except ValidationError as error:
        lines = [f"{'.'.join(map(str, e['loc']))} = {_shown(e['input'])}: {e['msg']}" for e in error.errors()]
        raise BadInput("settings refused: " + "; ".join(lines)) from error


def _shown(value: Any) -> str:
    """A value in a message, shortened."""
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def _with_defaults(tree: dict[str, Any]) -> dict[str, Any]:
    """The tree with what a changed choice brings; where it is not valid (yet), the tree as it is."""
    try:
        return PipelineSettings.model_validate(tree).model_dump(mode="json")
    except ValidationError:
        return tree


PREVIEW_LADDER = [Rung(until=1.0, size=128).model_dump()]

PREVIEW = revise(
    PipelineSettings(),
    {
        "subject.size": 256,
        "static.iterations": 250,
        "static.views": 4,
        "static.ladder": PREVIEW_LADDER,
        "static.start": "surface",
        "deformation.features": 16,
        "deformation.hidden": 32,
        "deformation.spatial": 64,
        "deformation.smoothness_weight": 0.01,
        "motion.iterations": 250,
        "motion.views": 1,
        "motion.frames_per_iteration": 12,
        "motion.plane_rate": 0.0256,
        "motion.network_rate": 0.00256,
        "motion.rigidity_weight": 1000.0,
        "motion.ladder": PREVIEW_LADDER,
        "motion.reference_size": 256,
        "mesh.mode": "auto",
        "mesh.max_faces": 20000,
    },
)

PAPER = revise(
    PipelineSettings(),
    {
        "driving.kind": "svd",
        "prior.kind": "zero123",
        "mesh.mode": "per_frame",
        "refiner.kind": "video_to_video",
    },
)
VIDEO = revise(PAPER, {"subject.max_frames": 32, "motion.iterations": 500})
VIDEO_FAST = revise(VIDEO, {"subject.max_frames": 16, "motion.views": 1})

REFERENCE = revise(
    PAPER,
    {
        "prior.weights": "stable-zero123",
        "prior.variant": "stable",
        "static.start": "lgm",
        "static.iterations": 0,
        "static.noise_start": 1.0,
        "static.noise_end": 0.0,
        "deformation.temporal": 12,
        "deformation.half_side": 1.6,
        "deformation.endpoint": False,
        "motion.iterations": 500,
        "motion.noise_start": 1.0,
        "motion.noise_end": 0.0,
        "motion.fine_tune": True,
    },
)

QUALITY = revise(
    PAPER,
    {
        "driving.candidates": 4,
        "deformation.scales": [1, 4],
        "deformation.smoothness_weight": 0.01,
        "motion.iterations": 500,
        "motion.fine_tune": True,
        "mesh.mode": "tracked",
        "mesh.texture_size": 2048,
    },
)

PROFILES: dict[str, PipelineSettings] = {
    "preview": PREVIEW,
    "paper": PAPER,
    "video": VIDEO,
    "video-fast": VIDEO_FAST,
    "reference": REFERENCE,
    "quality": QUALITY,
}


def profile(name: str) -> PipelineSettings:
    """The named profile.

    Raises:
        BadInput: no such profile.
    """
    if name not in PROFILES:
        raise BadInput(f"unknown profile {name!r}; choose one of: {', '.join(PROFILES)}")
    return PROFILES[name]
