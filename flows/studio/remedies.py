"""Remedies for failed quality gates: settings with which a conversion is worth another try."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, NamedTuple

from dg4d_lib.errors import BadInput
from flows.engine.versions import VersionStep
from steps.profiles import PipelineSettings, is_read, revise


class Remedy(NamedTuple):
    """Change of settings.

    Attributes:
        label: words of its button.
        changes: new values by the names of the settings.
    """

    label: str
    changes: dict[str, Any]

    def lines(self) -> list[str]:
        """Return the changes as `--set` takes them."""
        return [f"{name}={value:g}" if isinstance(value, float) else f"{name}={value}" for name, value in
                self.changes.items()]  # fmt: skip


Candidate = Callable[[PipelineSettings], Remedy]


def _times(label: str, *names: str, factor: float = 2) -> Candidate:
    """Return a remedy that multiplies settings."""

    def remedy(settings: PipelineSettings) -> Remedy:
        values = {name: _value(settings, name) for name in names}
        changed = {
            name: round(value * factor) if isinstance(value, int) else round(value * factor, 6)
            for name, value in values.items()
        }
        return Remedy(label, changed)

    return remedy


def _set(label: str, **values: Any) -> Candidate:
    """Return a remedy that sets values; `__` stands for the dot in a name."""
    return lambda _: Remedy(label, {name.replace("__", "."): value for name, value in values.items()})


def _other_surface(settings: PipelineSettings) -> Remedy:
    """Return a lower threshold, or the Gaussians' surface in place of the shape network's, which has no threshold."""
    if settings.mesh.source == "prior" and settings.mesh.mode != "per_frame":
        return Remedy("the surface of the Gaussians", {"mesh.source": "gaussians"})
    return _times("a lower threshold", "mesh.density_threshold", factor=0.5)(settings)


def _longer_shape(settings: PipelineSettings) -> Remedy:
    """Return more iterations of the static stage, or of the dynamic one where the profile has no static one."""
    if settings.static.iterations == 0:
        return LONGER_MOTION(settings)
    return _times("twice the shape iterations", "static.iterations")(settings)


LONGER_MOTION = _times("twice the motion iterations", "motion.iterations")
FRAME_MESHES = _set("a mesh per frame", mesh__mode="per_frame")
FINER_GRID = _times("a finer mesh grid", "mesh.grid", factor=1.5)
LONGER_TRACKING = _times("twice the iterations over all frames", "asset.joint_iterations")
MORE_NODES = _times("more control nodes", "asset.nodes")
MORE_POINTS = _times("more splats on the model", "asset.points")
STIFFER_MODEL = _times("a stiffer surface", "asset.rigidity", factor=3)
SMOOTHER_MODEL = _times("a smoother motion of the model", "asset.smoothness", factor=3)

# By gate, and by the form of the asset where it depends on that. Settings that no step of the version reads are left
# out: those of `asset` are for a model of the user's own, the others mostly for fitted shapes.
LOW: Mapping[str, tuple[Candidate, ...]] = {  # for values below the bounds
    "fidelity splats": (
        _times("longer fits", "static.iterations", "motion.iterations"),
        LONGER_TRACKING,
        MORE_NODES,
    ),
    "fidelity mesh": (_times("a finer texture render", "mesh.render_size"), LONGER_TRACKING, MORE_NODES),
    "silhouette": (LONGER_MOTION, LONGER_TRACKING, MORE_NODES),
    "consistency": (_longer_shape, _times("more views", "static.views"), MORE_POINTS),
    "agreement": (_other_surface, FRAME_MESHES, MORE_POINTS),
    "sharpness splats": (_longer_shape, MORE_POINTS),
    "sharpness mesh": (_times("a larger texture", "mesh.texture_size", "mesh.render_size"),),
    "motion": (LONGER_MOTION, LONGER_TRACKING),
}
HIGH: Mapping[str, tuple[Candidate, ...]] = {  # for values above them
    "flicker": (_set("a smoother motion", deformation__smoothness_weight=0.01), LONGER_MOTION, SMOOTHER_MODEL),
    "floaters splats": (_times("a higher opacity threshold", "static.prune_opacity", factor=3),),
    "floaters mesh": (_times("a higher size threshold for pieces", "mesh.min_component", factor=3),),
    "flaws": (_other_surface, FINER_GRID, STIFFER_MODEL),
    "folds": (FRAME_MESHES, _times("a coarser mesh grid", "mesh.grid", factor=0.75), STIFFER_MODEL),
    "sharpness": (_times("a lower color learning rate", "static.color_lr", factor=0.5),),
    "motion": (
        _times("lower motion learning rates", "motion.plane_lr", "motion.network_lr", factor=0.5),
        SMOOTHER_MODEL,
    ),
}


def remedies(gate: Mapping[str, Any], settings: PipelineSettings, steps: Sequence[VersionStep]) -> list[Remedy]:
    """Return the remedies for a failed gate that the settings allow and that have an effect.

    Args:
        gate: row of the verdict.
        settings: of the conversion.
        steps: of the version.
    """
    if gate["passed"]:
        return []
    low = gate["least"] is not None and gate["value"] < gate["least"]
    table, bound = (LOW, gate["least"]) if low else (HIGH, gate["most"])
    forms = [form for form, value in gate["values"].items() if (value < bound if low else value > bound)]
    candidates = [
        candidate
        for name in (gate["name"], *(f"{gate['name']} {form}" for form in forms))
        for candidate in table.get(name, ())
    ]
    names = {step.label.partition(" ")[0] for step in steps}  # without the part of the frames
    used = revise(settings, _known(names, steps))
    return [remedy for candidate in dict.fromkeys(candidates) if (remedy := _allowed(candidate, used, names))]


def _known(names: Collection[str], steps: Sequence[VersionStep]) -> dict[str, Any]:
    """Return settings that the version used whatever was set."""
    known: dict[str, Any] = {}
    if "prepare_asset" in names:
        known["mesh.source"] = "gaussians"  # the shape of the user's own splats is not guessed
    if any("meshes" in step.outputs for step in steps):
        known["mesh.mode"] = "per_frame"  # also chosen by `auto`
    return known


def _allowed(candidate: Candidate, settings: PipelineSettings, steps: Collection[str]) -> Remedy | None:
    """Return the changes of a remedy that steps read; None if nothing changes, or a value or name is not allowed."""
    try:
        remedy = candidate(settings)
        remedy = remedy._replace(changes={k: value for k, value in remedy.changes.items() if is_read(k, steps)})
        changed = revise(settings, remedy.changes)
    except (BadInput, AttributeError):
        return None
    return remedy if changed != settings else None


def _value(settings: PipelineSettings, name: str) -> Any:
    value: Any = settings
    for part in name.split("."):
        value = getattr(value, part)
    return value
