"""Remedies for failed quality gates: settings with which a conversion is worth another try."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from dg4d_lib.errors import BadInput
from steps.profiles import PipelineSettings, revise


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


LONGER_MOTION = _times("twice the motion iterations", "motion.iterations")
LONGER_SHAPE = _times("twice the shape iterations", "static.iterations")
FRAME_MESHES = _set("a mesh per frame", mesh__mode="per_frame")
FINER_GRID = _times("a finer mesh grid", "mesh.grid", factor=1.5)

LOW: Mapping[str, tuple[Candidate, ...]] = {  # for values below the bounds, by gate
    "fidelity": (
        _times("longer fits", "static.iterations", "motion.iterations"),
        _times("a finer texture render", "mesh.render_size"),
    ),
    "silhouette": (LONGER_MOTION,),
    "consistency": (LONGER_SHAPE, _times("more views", "static.views")),
    "agreement": (_other_surface, FRAME_MESHES),
    "sharpness": (_times("a larger texture", "mesh.texture_size", "mesh.render_size"), LONGER_SHAPE),
    "motion": (LONGER_MOTION,),
}
HIGH: Mapping[str, tuple[Candidate, ...]] = {  # for values above them
    "flicker": (_set("a smoother motion", deformation__smoothness_weight=0.01), LONGER_MOTION),
    "floaters": (
        _times("faint splats pruned", "static.prune_opacity", factor=3),
        _times("small pieces removed", "mesh.min_component", factor=3),
    ),
    "flaws": (_other_surface, FINER_GRID),
    "folds": (FRAME_MESHES, _times("a coarser mesh grid", "mesh.grid", factor=0.75)),
    "sharpness": (_times("a lower color rate", "static.color_lr", factor=0.5),),
    "motion": (_times("slower motion rates", "motion.plane_lr", "motion.network_lr", factor=0.5),),
}


def remedies(gate: Mapping[str, Any], settings: PipelineSettings) -> list[Remedy]:
    """Return the remedies for a failed gate that the settings allow.

    Args:
        gate: row of the verdict.
        settings: of the conversion.
    """
    if gate["passed"]:
        return []
    table = LOW if gate["least"] is not None and gate["value"] < gate["least"] else HIGH
    return [remedy for candidate in table.get(gate["name"], ()) if (remedy := _allowed(candidate, settings))]


def _allowed(candidate: Candidate, settings: PipelineSettings) -> Remedy | None:
    """Return a remedy; None if it changes nothing, a value leaves its bounds, or the profile has no such setting."""
    try:
        remedy = candidate(settings)
        changed = revise(settings, remedy.changes)
    except (BadInput, AttributeError):
        return None
    return remedy if changed != settings else None


def _value(settings: PipelineSettings, name: str) -> Any:
    value: Any = settings
    for part in name.split("."):
        value = getattr(value, part)
    return value
