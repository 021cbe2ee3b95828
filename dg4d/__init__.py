"""Python API: pictures and videos become animated 3D assets.

asset = dg4d.make("newt.png")
asset.render(dg4d.Camera(azimuth_deg=30), t=0.5)
"""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dg4d.asset import Asset, load
    from dg4d.making import Batch, batch, make
    from dg4d.progress import Progress
    from dg4d_lib.cameras.orbit import OrbitCamera as Camera
    from dg4d_lib.errors import BackendUnavailable, BadInput, DG4DError
    from flows.step_errors import StepError

__all__ = [
    "Asset",
    "BackendUnavailable",
    "BadInput",
    "Batch",
    "Camera",
    "DG4DError",
    "Progress",
    "StepError",
    "batch",
    "load",
    "make",
]

_PLACES = {
    "Asset": "dg4d.asset:Asset",
    "BackendUnavailable": "dg4d_lib.errors:BackendUnavailable",
    "BadInput": "dg4d_lib.errors:BadInput",
    "Batch": "dg4d.making:Batch",
    "Camera": "dg4d_lib.cameras.orbit:OrbitCamera",
    "DG4DError": "dg4d_lib.errors:DG4DError",
    "Progress": "dg4d.progress:Progress",
    "StepError": "flows.step_errors:StepError",
    "batch": "dg4d.making:batch",
    "load": "dg4d.asset:load",
    "make": "dg4d.making:make",
}


_PARTS = ("dg4d_lib", "steps", "flows")  # packages that are installed beside this one


def __getattr__(name: str) -> Any:
    """Import a public name when it is used first; `import dg4d` alone imports nothing heavy."""
    if name not in _PLACES:
        raise AttributeError(f"module 'dg4d' has no attribute {name!r}; it has: {', '.join(__all__)}")
    _check_parts()
    from steps.store.files import make_folders_absolute

    make_folders_absolute()
    module, _, attribute = _PLACES[name].partition(":")
    value = getattr(import_module(module), attribute)
    globals()[name] = value
    return value


def _check_parts() -> None:
    """Refuse foreign modules that hide a part of dg4d, such as a `steps.py` beside a script.

    Raises:
        ImportError: names the file.
    """
    site = Path(__file__).resolve().parents[1]
    for part in _PARTS:
        spec = find_spec(part)
        origin = spec.origin if spec is not None and spec.origin else None
        if origin is None or Path(origin).resolve().parents[1] != site:
            raise ImportError(
                f"{origin or 'nothing'} hides the package {part!r} of dg4d in {site}: rename it, or remove its folder "
                "from sys.path"
            )


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
