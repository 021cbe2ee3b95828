"""Settings of the pipeline and of its steps, named profiles, and changes by dotted keys."""

import functools
from collections.abc import Collection, Sequence
from operator import attrgetter
from types import UnionType
from typing import Annotated, Any, Literal, Self, Union, get_args, get_origin

from pydantic import AfterValidator, Field, TypeAdapter, ValidationError, create_model, model_validator

from dg4d_lib.asset_settings import AssetSettings, GateSettings, PackSettings, ScoreSettings
from dg4d_lib.errors import BadInput, quoted
from dg4d_lib.input_settings import (
    DrivingSettings,
    NoViewsSettings,
    SubjectSettings,
    TextSettings,
    ViewsSettings,
    WarpSettings,
)
from dg4d_lib.rasterizer.backends import backend_name
from dg4d_lib.refiner_settings import IdentitySettings, ImageToImageSettings, RefinerSettings, VideoToVideoSettings
from dg4d_lib.settings import (
    DeformationSettings,
    GeometricPriorSettings,
    HexPlaneSettings,
    ImageDreamPriorSettings,
    MeshSettings,
    MotionSettings,
    PriorSettings,
    ResolutionStage,
    Settings,
    StaticSettings,
    Zero123PriorSettings,
)
from dg4d_lib.weights.registry import lookup_weights
from steps.catalog import STEPS
from steps.contract import StepSpec, alternatives, load_object, settings_errors

LARGEST_WHOLE = 2**53  # largest integer that every JSON reader represents exactly
ZERO123_VARIANTS = {"zero123-xl": "xl", "stable-zero123": "stable"}  # by name in the registry
IMAGEDREAM_RING = 4  # views scored together, as RING in dg4d_lib/guidance/imagedream.py, which imports torch
RENAMED_SETTINGS = {  # old name: new name, empty if the value is fixed now; removed with 1.0
    "text.steps": "text.num_inference_steps",
    "text.guidance": "text.guidance_scale",
    **{
        f"{section}.model.{old}": f"{section}.model.{new}"
        for section in ("driving", "refiner")
        for old, new in {
            "steps": "num_inference_steps",
            "guidance_start": "min_guidance_scale",
            "guidance_end": "max_guidance_scale",
            "motion_bucket": "motion_bucket_id",
            "noise_augmentation": "noise_aug_strength",
            "frames_at_once": "decode_chunk_size",
        }.items()
    },
    "prior.turn_deg": "subject.turn_deg",
    "prior.coverage_weight": "",
    "prior.level": "",
    "prior.input_elevation_deg": "",
    "refiner.prior.input_elevation_deg": "",
    **{
        f"{stage}.{old}": f"{stage}.{new}"
        for stage in ("static", "motion")
        for old, new in {
            "ladder": "resolution_schedule",
            "noise_start": "t_max_start",
            "noise_end": "t_max_end",
            "mean_rate": "means_lr",
            "mean_rate_end": "means_lr_end",
            **{f"{name}_rate": f"{name}_lr" for name in ("color", "opacity", "scale", "rotation")},
        }.items()
    },
    "motion.network_rate": "motion.network_lr",
    "motion.plane_rate": "motion.plane_lr",
    "static.start": "static.start.kind",
    "static.points": "static.start.points",
    "static.lgm.steps": "static.start.num_inference_steps",
    **{
        f"static.lgm.{name}": f"static.start.{name}"
        for name in ("weights", "views_weights", "precision", "guidance_scale")
    },
    **{f"static.{name}": "" for name in ("blob_radius", "radius_jitter", "densify_scale", "reset_opacity_every")},
    "mesh.min_cosine": "",
    "mesh.smoothing": "mesh.fairing (a wavelength in world units, 0.25 in preview)",
    "refiner.steps": "refiner.num_inference_steps",
    "refiner.skipped": "refiner.strength (1 less the old value)",
    "refiner.skipped_start": "refiner.strength_start (1 less the old value)",
    "refiner.skipped_end": "refiner.strength_end (1 less the old value)",
    "refiner.texture.rate": "refiner.texture.lr",
}

RasterizerName = Literal["auto", "reference", "cpu", "cuda_gsplat"]
Backend = Annotated[RasterizerName, AfterValidator(backend_name)]  # `auto` resolved to the backend of this machine


class PipelineSettings(Settings):
    """All settings of the pipeline, as in `--set stage.name=value`."""

    rasterizer: RasterizerName = Field("auto", description="auto: cuda_gsplat where that can run, else cpu")
    text: TextSettings = TextSettings()
    subject: SubjectSettings = SubjectSettings()
    asset: AssetSettings = AssetSettings()
    driving: DrivingSettings = WarpSettings()
    views: ViewsSettings = NoViewsSettings()
    prior: PriorSettings = GeometricPriorSettings()
    static: StaticSettings = StaticSettings()
    deformation: DeformationSettings = HexPlaneSettings()
    motion: MotionSettings = MotionSettings()
    mesh: MeshSettings = MeshSettings()
    refiner: RefinerSettings = IdentitySettings()
    pack: PackSettings = PackSettings()
    gates: GateSettings = GateSettings()

    @model_validator(mode="after")
    def _refuse_flow_matching_priors(self) -> Self:
        """Refuse models of flow matching where noise has to be predicted."""
        for owner, name in (("prior", getattr(self.prior, "weights", "")), *_refiner_weights(self.refiner)):
            if name and lookup_weights(name).flow_matching:
                raise ValueError(flow_matching_refusal(owner, name))
        return self

    @model_validator(mode="after")
    def _refuse_other_variants(self) -> Self:
        """Refuse weights that the registry lists under the other variant of Zero-1-to-3."""
        for owner, prior in (("prior", self.prior), ("refiner.prior", getattr(self.refiner, "prior", None))):
            if isinstance(prior, Zero123PriorSettings):
                name = lookup_weights(prior.weights).name
                if ZERO123_VARIANTS.get(name, prior.variant) != prior.variant:
                    raise ValueError(variant_refusal(owner, prior, ZERO123_VARIANTS[name]))
        return self

    @model_validator(mode="after")
    def _refuse_incomplete_rings(self) -> Self:
        """Refuse numbers of views that form no rings for ImageDream."""
        if isinstance(self.prior, ImageDreamPriorSettings):
            for name, stage in (("static", self.static), ("motion", self.motion)):
                if stage.iterations and stage.guidance_weight and stage.views % IMAGEDREAM_RING:
                    raise ValueError(ring_refusal(name, stage.views))
        return self

    @model_validator(mode="before")
    @classmethod
    def _refuse_old_names(cls, given: Any) -> Any:
        for old, new in RENAMED_SETTINGS.items():
            branch = given
            for name in old.split("."):
                branch = branch.get(name) if isinstance(branch, dict) else None
            if branch is not None and not isinstance(branch, dict | Settings):
                raise ValueError(_renamed(old, new))
        return given


def flow_matching_refusal(owner: str, name: str) -> str:
    """Return the sentence that refuses a model of flow matching as a critic."""
    return (
        f"{owner}.weights = {name} is a flow-matching model: it generates views (views.weights) and videos "
        f"(driving.weights), but score distillation and refinement need one that predicts noise; use zero123-xl, "
        "stable-zero123 or imagedream for the prior, svd for the refiner"
    )


def variant_refusal(owner: str, prior: Zero123PriorSettings, variant: str) -> str:
    """Return the sentence that refuses weights of another variant of Zero-1-to-3."""
    return (
        f"{owner}.variant = {prior.variant} does not fit {owner}.weights = {prior.weights}, which are of the variant "
        f"{variant}; set {owner}.variant={variant}"
    )


def ring_refusal(stage: str, views: int) -> str:
    """Return the sentence that refuses a number of views with ImageDream as the prior."""
    return (
        f"{stage}.views = {views} does not fit prior.kind = imagedream, which scores {IMAGEDREAM_RING} views together; "
        f"set {stage}.views to a multiple of {IMAGEDREAM_RING}, for example {stage}.views={IMAGEDREAM_RING}"
    )


def _refiner_weights(refiner: RefinerSettings) -> list[tuple[str, str]]:
    match refiner:
        case VideoToVideoSettings():
            return [("refiner.model", refiner.model.weights)]
        case ImageToImageSettings():
            return [("refiner.prior", refiner.prior.weights)]
    return []


class FrameRange(Settings):
    """Frames of one task of `extract_mesh`, for a mesh per frame."""

    first_frame: int = Field(0, ge=0, description="first frame of this task")
    end_frame: int = Field(0, ge=0, description="one past the last; 0 is all frames")


class PackNotes(Settings):
    """Sentences that are stored in the files of a package."""

    notes: tuple[str, ...] = Field((), description="for example that no model was used")


class ScoreAssetSettings(Settings):
    """Settings of `score_asset`, which reads no settings of the pipeline."""

    rasterizer: Backend
    mesh: bool = Field(False, description="the textured mesh is scored instead of the splats")
    actionbench: bool = Field(False, description="also compare meshes by the metrics of ActionBench")
    max_frames: int = Field(
        0, ge=0, description="subject.max_frames of an asset that follows a video, which has such frames only; 0: all"
    )
    score: ScoreSettings = ScoreSettings()


def settings_class(spec: StepSpec) -> type[Settings]:
    """Return the class of a step's settings: its own fields, and one for each section that it declares."""
    return _settings_class(spec.name, spec.settings, spec.sections)


@functools.cache
def _settings_class(name: str, own: str, sections: tuple[str, ...]) -> type[Settings]:
    base: type[Settings] = load_object(own)
    fields: dict[str, Any] = {section.rpartition(".")[2]: (_annotation(section), ...) for section in sections}
    return create_model(name, __base__=base, __doc__=f"Settings of `{name}`.", **fields) if fields else base


def _annotation(section: str) -> Any:
    """Return the annotated type of a section; in requests, the rasterizer is never `auto`."""
    if section == "rasterizer":
        return Backend
    owner: Any = PipelineSettings
    *path, last = section.split(".")
    for name in path:
        owner = owner.model_fields[name].annotation
    field = owner.model_fields[last]
    return Annotated[field.annotation, Field(discriminator=field.discriminator), *field.metadata]


def step_settings(step: str, settings: PipelineSettings, **values: Any) -> Settings:
    """Make the settings of a step from the sections that it declares and from values of the run such as `notes`."""
    spec = STEPS[step]
    sections = {section.rpartition(".")[2]: attrgetter(section)(settings) for section in spec.sections}
    return settings_class(spec)(**sections, **values)


def is_read(setting: str, steps: Collection[str]) -> bool:
    """Return true if one of the steps reads a setting of the pipeline, given by its dotted name."""
    sections = {section for spec in STEPS.values() if spec.name in steps for section in spec.sections}
    return any(f"{setting}.".startswith(f"{section}.") for section in sections)


def revise(settings: PipelineSettings, changes: dict[str, Any]) -> PipelineSettings:
    """Return validated settings with some dotted keys changed.

    Changes of a `kind` come first and reset its section to the defaults of that kind.

    Raises:
        BadInput: a key does not exist, or a value is out of range; says which and what is allowed.
    """
    tree = settings.model_dump(mode="json")
    for key, value in changes.items():
        if key in RENAMED_SETTINGS and not isinstance(value, dict):
            raise BadInput(_renamed(key, RENAMED_SETTINGS[key]))
        if isinstance(value, int) and abs(value) > LARGEST_WHOLE:
            raise BadInput(f"{key} = {quoted(value)} is out of range; use at most {LARGEST_WHOLE}")
    for key, value in sorted(changes.items(), key=lambda change: not change[0].endswith(".kind")):
        *path, last = key.split(".")
        branch: Any = tree
        for i, name in enumerate([*path, last]):
            if not isinstance(branch, dict) or name not in branch:
                section, rest = key.split(".")[:i], key.split(".")[i:]
                selected = branch.get("kind") if isinstance(branch, dict) else None
                if selected and (kinds := _kinds_with(section, rest)):
                    raise BadInput(_other_kind(key, ".".join(section), kinds, selected))
                known = ", ".join(sorted(branch)) if isinstance(branch, dict) else "nothing: it is a value"
                raise BadInput(f"unknown setting {key!r}: {'.'.join(key.split('.')[:i]) or 'the pipeline'} has {known}")
            if i < len(path):
                branch = branch[name]
        if last == "kind" and branch[last] != value:
            branch.clear()
        branch[last] = value
        changed = key.split(".")[0]
        tree[changed] = _with_defaults(changed, tree[changed])
    try:
        return PipelineSettings.model_validate(tree)
    except ValidationError as error:
        raise BadInput(f"settings refused: {settings_errors(error, tree, 'dg4d settings')}") from error


def _kinds_with(section: Sequence[str], rest: Sequence[str]) -> list[str]:
    """Return the kinds of a section that have a setting, given by the rest of its name; [] if it has no kinds."""
    owners: list[type[Settings]] = [PipelineSettings]
    for name in section:
        owners = [below for owner in owners for below in _classes_of(owner, name)]
    return [
        owner.model_fields["kind"].default for owner in owners if "kind" in owner.model_fields and _has(owner, rest)
    ]


def _has(owner: type[Settings], names: Sequence[str]) -> bool:
    """Return true if settings of a class have a field of this name, for some choice of the kinds below."""
    first, *rest = names
    if not rest:
        return first in owner.model_fields
    return any(_has(below, rest) for below in _classes_of(owner, first))


def _classes_of(owner: type[Settings], name: str) -> list[type[Settings]]:
    """Return the settings class of a field, or those of its kinds; [] if it is a value or does not exist."""
    if name not in owner.model_fields:
        return []
    annotation = owner.model_fields[name].annotation
    choices = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
    return [one for one in choices if isinstance(one, type) and issubclass(one, Settings)]


def _other_kind(key: str, section: str, kinds: list[str], selected: str) -> str:
    return (
        f"{key} exists with {section}.kind={alternatives(kinds)}; {section}.kind is {selected}. "
        f"Add `--set {section}.kind={kinds[0]}`."
    )


def _renamed(old: str, new: str) -> str:
    return f"the setting {old} is now {new}" if new else f"the setting {old} is gone: its value is fixed"


def _with_defaults(section: str, value: Any) -> Any:
    """Return a section with the defaults of a changed `kind`; one that is not valid yet, or no section, unchanged."""
    if not isinstance(value, dict):
        return value
    adapter = _adapter(section)
    try:
        return adapter.dump_python(adapter.validate_python(value), mode="json")
    except ValidationError:
        return value


@functools.cache
def _adapter(section: str) -> TypeAdapter[Any]:
    return TypeAdapter(_annotation(section))


PUBLIC_BOX = 1.6  # half side of the planes' box in the public code, over which the paper chose a resolution of 32
LGM_SCALE = 4 / 3  # our camera radius over LGM's, as WORLD_SCALE in dg4d_lib/reconstruction/lgm.py, which imports torch
SMOOTHNESS = 0.01 / 3  # a third of the public code's weight: measured as a mean over the three time planes
PREVIEW_SCHEDULE = [ResolutionStage(until=1.0, size=128).model_dump()]
SMALL_AT_FIRST = [
    ResolutionStage(until=0.3, size=128).model_dump()
]  # until half of the fit the input view loses 0.4 dB

PREVIEW = revise(
    PipelineSettings(),
    {
        "subject.size": 256,
        "prior.kind": "learned",
        "static.iterations": 250,
        "static.views": 4,
        "static.resolution_schedule": PREVIEW_SCHEDULE,
        "static.viewpoints": 64,
        "static.start.kind": "surface",
        "deformation.features": 16,
        "deformation.hidden": 32,
        "deformation.spatial": 64,
        "deformation.smoothness_weight": SMOOTHNESS,
        "motion.iterations": 250,
        "motion.views": 1,
        "motion.frames_per_iteration": 12,
        "motion.fine_tune": True,
        "motion.plane_lr": 0.0256,
        "motion.network_lr": 0.00256,
        "motion.rigidity_weight": 150.0,
        "motion.resolution_schedule": PREVIEW_SCHEDULE,
        "motion.reference_size": 256,
        "motion.reference_schedule": SMALL_AT_FIRST,
        "motion.viewpoints": 24,
        "motion.guided_frames": 6,
        "mesh.mode": "auto",
        "mesh.max_faces": 20000,
        "mesh.source": "prior",
        "mesh.fairing": 0.25,
    },
)

PAPER = revise(
    PipelineSettings(),
    {
        "driving.kind": "svd",
        "prior.kind": "zero123",
        "deformation.half_side": PUBLIC_BOX,
        "mesh.mode": "per_frame",
        "refiner.kind": "video_to_video",
    },
)
PAPER_LGM = revise(
    PAPER,
    {
        "static.start.kind": "lgm",
        "static.iterations": 0,
        "deformation.half_side": LGM_SCALE * PUBLIC_BOX,
        "motion.length_scale": LGM_SCALE,
    },
)
VIDEO = revise(PAPER, {"subject.max_frames": 32, "motion.iterations": 500})
VIDEO_FAST = revise(VIDEO, {"subject.max_frames": 16, "motion.views": 1})

RELEASE = revise(
    PAPER,
    {
        "static.t_max_start": 1.0,
        "static.t_max_end": 0.0,
        "deformation.spatial": 64,
        "deformation.temporal": 25,
        "deformation.scales": [1, 2, 4, 8],
        "motion.t_max_start": 1.0,
        "motion.t_max_end": 0.0,
        "motion.t_max_limit": 0.5,
        "motion.guidance_weight": 4.0,
        "motion.alpha_weight": 0.0,
    },
)

REFERENCE = revise(
    PAPER_LGM,
    {
        "prior.weights": "stable-zero123",
        "prior.variant": "stable",
        "static.t_max_start": 1.0,
        "static.t_max_end": 0.0,
        "deformation.temporal": 12,
        "deformation.endpoint": False,
        "motion.iterations": 500,
        "motion.t_max_start": 1.0,
        "motion.t_max_end": 0.0,
        "motion.fine_tune": True,
    },
)

QUALITY = revise(
    PAPER,
    {
        "driving.candidates": 4,
        "deformation.half_side": 0.0,
        "deformation.scales": [1, 4],
        "deformation.smoothness_weight": SMOOTHNESS,
        "motion.iterations": 500,
        "motion.fine_tune": True,
        "mesh.mode": "tracked",
        "mesh.texture_size": 2048,
    },
)

OPEN = revise(
    PREVIEW,
    {
        "subject.size": 512,
        "driving.kind": "diffusers",
        "driving.frames": 24,
        "driving.generated_frames": 49,
        "driving.fps": 12.0,
        "views.kind": "image_edit",
        "mesh.mode": "tracked",
        "mesh.max_faces": 100000,
        "mesh.texture_size": 2048,
    },
)

ProfileName = Literal["preview", "paper", "paper-lgm", "video", "video-fast", "release", "reference", "quality", "open"]
PROFILES: dict[str, PipelineSettings] = {
    "preview": PREVIEW,
    "paper": PAPER,
    "paper-lgm": PAPER_LGM,
    "video": VIDEO,
    "video-fast": VIDEO_FAST,
    "release": RELEASE,
    "reference": REFERENCE,
    "quality": QUALITY,
    "open": OPEN,
}


def profile(name: str) -> PipelineSettings:
    """Return a profile by name.

    Raises:
        BadInput: there is no such profile.
    """
    if name not in PROFILES:
        raise BadInput(f"unknown profile {name!r}; choose one of: {', '.join(PROFILES)}")
    return PROFILES[name]
