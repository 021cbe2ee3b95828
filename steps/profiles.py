"""The settings of a whole pipeline, the named profiles, and the one way to change a knob."""

from typing import Any

from pydantic import Field, ValidationError

from dg4d_lib.errors import BadInput
from dg4d_lib.settings import (
    DeformationSettings,
    DrivingSettings,
    GeometricPriorSettings,
    HexPlaneSettings,
    MeshSettings,
    MotionSettings,
    PackSettings,
    PriorSettings,
    RefinerSettings,
    Rung,
    Settings,
    StaticSettings,
    SubjectSettings,
)


class PipelineSettings(Settings):
    """Every knob of every stage; the command line's `--set stage.knob=value`."""

    rasterizer: str = Field("auto", description="auto, reference or cpu")
    subject: SubjectSettings = SubjectSettings()
    driving: DrivingSettings = DrivingSettings()
    prior: PriorSettings = GeometricPriorSettings()
    static: StaticSettings = StaticSettings()
    deformation: DeformationSettings = HexPlaneSettings()
    motion: MotionSettings = MotionSettings()
    mesh: MeshSettings = MeshSettings()
    refiner: RefinerSettings = RefinerSettings()
    pack: PackSettings = PackSettings()


class DriveVideoSettings(Settings):
    """What `drive_video` reads."""

    driving: DrivingSettings
    turn_deg: float = Field(0.0, ge=-60, le=60, description="how far the subject is turned; the geometric prior's hint")


class FitGaussiansSettings(Settings):
    """What `fit_gaussians` reads."""

    rasterizer: str
    prior: PriorSettings
    static: StaticSettings


class FitMotionSettings(Settings):
    """What `fit_motion` reads."""

    rasterizer: str
    prior: PriorSettings
    deformation: DeformationSettings
    motion: MotionSettings


class ExtractMeshSettings(Settings):
    """What `extract_mesh` reads."""

    rasterizer: str
    mesh: MeshSettings
    first_frame: int = Field(0, ge=0, description="mode per_frame: first frame of this task")
    end_frame: int = Field(0, ge=0, description="mode per_frame: one past the last; 0 is all frames")


class PackAssetSettings(Settings):
    """What `pack_asset` reads."""

    rasterizer: str
    pack: PackSettings
    notes: tuple[str, ...] = Field((), description="sentences that travel in the files, say that no model was used")


def revise(settings: PipelineSettings, changes: dict[str, Any]) -> PipelineSettings:
    """The same settings with some dotted keys changed, validated again.

    Raises:
        BadInput: a key that does not exist, or a value out of range; says which and what is allowed.
    """
    tree = settings.model_dump(mode="json")
    for key, value in changes.items():
        *path, last = key.split(".")
        branch: Any = tree
        for i, name in enumerate([*path, last]):
            if not isinstance(branch, dict) or name not in branch:
                known = ", ".join(sorted(branch)) if isinstance(branch, dict) else "nothing: it is a value"
                raise BadInput(f"unknown setting {key!r}: {'.'.join(key.split('.')[:i]) or 'the pipeline'} has {known}")
            if i < len(path):
                branch = branch[name]
        branch[last] = value
        if last == "kind" and len(path) == 1:  # another member of a union starts from its own defaults
            tree[path[0]] = {"kind": value}
    try:
        return PipelineSettings.model_validate(tree)
    except ValidationError as error:
        lines = [f"{'.'.join(map(str, e['loc']))} = {e['input']!r}: {e['msg']}" for e in error.errors()]
        raise BadInput("settings refused: " + "; ".join(lines)) from error


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
        "motion.iterations": 250,
        "motion.views": 1,
        "motion.frames_per_iteration": 12,
        "motion.plane_rate": 0.0256,
        "motion.network_rate": 0.00256,
        "motion.ladder": PREVIEW_LADDER,
        "motion.reference_size": 256,
        "mesh.max_faces": 20000,
    },
)

PROFILES: dict[str, PipelineSettings] = {"preview": PREVIEW}


def profile(name: str) -> PipelineSettings:
    """The named profile.

    Raises:
        BadInput: no such profile.
    """
    if name not in PROFILES:
        raise BadInput(f"unknown profile {name!r}; choose one of: {', '.join(PROFILES)}")
    return PROFILES[name]
