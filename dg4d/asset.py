"""Finished assets: meshes, Gaussians and renderings at any time."""

import html
import math
import shutil
import tempfile
import weakref
from functools import cached_property
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dg4d_lib.errors import BadInput
from flows.inputs.json_text import loads
from flows.inputs.package_record import RECORD, REPORT, record_of
from flows.packages.acceptance import failing_gates
from flows.packages.publish import check_writable, load_verified
from flows.packages.view import viewer_html, viewer_of_package
from steps.artifacts.archives import unpack
from steps.artifacts.package_files import ASSET, MANIFEST
from steps.store.files import remove_tree

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from trimesh import Trimesh

    from dg4d_lib.assets.placement import Placement, Surface
    from dg4d_lib.cameras.orbit import OrbitCamera
    from dg4d_lib.gaussians.cloud import Gaussians
    from steps.artifacts.packages import Manifest
    from steps.artifacts.rendering import Renderer, States

APPLE_DOUBLE = "__MACOSX"  # folder that macOS adds to zips, for attributes of files
FRAME_HEIGHT = 520  # pixels of the viewer in a notebook
ROUNDING = 1e-6  # frames by which a time counts as that of a frame


def load(package: str | Path) -> "Asset":
    """Load a package: a folder that `make` wrote, or a zip of one.

    Digests are verified where the package has a provenance record. Nothing in the package is executed.

    Raises:
        BadInput: there is no package, or files of it are missing, altered or unsafe.
    """
    path = Path(package)
    if path.is_dir():
        return Asset(path, record=load_verified(path))
    if not path.is_file():
        raise BadInput(f"{path} does not exist; give a folder that `dg4d make` wrote, or a zip of one")
    folder = Path(tempfile.mkdtemp(prefix="dg4d-asset-"))
    try:
        unpack(path, folder, str(path), lambda name: not name.startswith(f"{APPLE_DOUBLE}/"))
        root = _package_root(folder)
        record = load_verified(root) if (root / RECORD).exists() else {"item": path.stem}
        asset = Asset(root, record=record, package=path)
    except BadInput as error:
        remove_tree(folder)
        raise BadInput(str(error).replace(str(folder), str(path))) from error
    except BaseException:
        remove_tree(folder)
        raise
    weakref.finalize(asset, remove_tree, folder)
    return asset


def _package_root(folder: Path) -> Path:
    """Return the folder of the package in an unpacked zip: itself, or its only folder, as in a zip of the folder."""
    if (folder / MANIFEST).exists():
        return folder
    folders = [path for path in folder.iterdir() if path.is_dir()]
    return folders[0] if len(folders) == 1 else folder


class Asset:
    """Animated 3D asset in a package.

    Times are seconds. The animation loops: a time after the end, or before the start, is taken modulo `duration_s`.
    Files are read when they are needed; if the folder holds another asset by then, that raises BadInput.

    Args:
        folder: unpacked package.
        record: provenance of the package.
        package: zip that the package was unpacked from.
    """

    def __init__(self, folder: Path, record: dict[str, Any], package: Path | None = None) -> None:
        from steps.artifacts.packages import read_manifest

        self.folder = folder
        self.manifest: Manifest = read_manifest(folder)
        self._record, self._package = record, package

    @property
    def name(self) -> str:
        """Name of the asset."""
        return str(self._record.get("item", "asset"))

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.manifest.frames

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.manifest.fps

    @property
    def duration_s(self) -> float:
        """Length of one loop in seconds."""
        return self.manifest.frames / self.manifest.fps

    @property
    def provenance(self) -> dict[str, Any]:
        """Provenance record; only the name for a zip without one."""
        return self._record

    @cached_property
    def report(self) -> dict[str, Any]:
        """Report of the conversion: steps, times, quality gates, notes; empty for a zip without one."""
        path = self._checked_folder() / REPORT
        if not path.is_file():
            return {}
        try:
            content = loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise BadInput(f"{path} cannot be read: {error}; make the asset again") from error
        return content if isinstance(content, dict) else {}

    @property
    def failing(self) -> list[str] | None:
        """Quality gates that the asset fails; None if they were not evaluated."""
        return failing_gates(self._checked_folder())

    def mesh(self, t: float = 0.0) -> "Trimesh":
        """Return the textured mesh at a time, in meters and y up, as in the files of the package."""
        import trimesh
        from PIL import Image

        from steps.artifacts.rendering import mesh_at

        found = mesh_at(self._surface, self._position(t)[0])
        pixels = (found.texture.clamp(0, 1) * 255).round().byte().numpy()
        uvs = found.uvs.numpy().copy()
        uvs[:, 1] = 1 - uvs[:, 1]  # trimesh counts rows of a texture from the bottom
        visual = trimesh.visual.TextureVisuals(uv=uvs, image=Image.fromarray(pixels))
        vertices = self._placement.points(found.vertices).numpy()
        return trimesh.Trimesh(vertices, found.faces.numpy(), visual=visual, process=False)

    def gaussians(self, t: float = 0.0) -> "Gaussians":
        """Return the Gaussians at a time, in the coordinates of `mesh`.

        They have means, scales, rotations, opacities and colors as torch tensors.
        """
        return self._placement.gaussians(self._states(self._position(t)).at(0))

    def render(
        self, camera: "OrbitCamera | None" = None, t: float = 0.0, *, mesh: bool = False
    ) -> "NDArray[np.float32]":
        """Render the asset as an RGBA picture in [0, 1] with straight alpha, shape (height, width, 4).

        Args:
            camera: pose, field of view and size, at most 4096 x 4096 pixels; it looks at the middle of the input
                picture, from a distance in units of the fit, whatever the height of the asset. None: the camera of the
                input picture, 256 x 256 pixels.
            t: time in seconds.
            mesh: render the textured mesh instead of the Gaussians.

        Raises:
            BadInput: the time or the size is out of range, or the folder holds another asset.
            BackendUnavailable: the rasterizer cannot run here.
        """
        from dg4d_lib.cameras.orbit import OrbitCamera

        camera = OrbitCamera() if camera is None else camera
        _check_size(camera)
        rendered = (self._render_mesh if mesh else self._render_gaussians)(self._position(t), [camera])
        picture: NDArray[np.float32] = rendered[0].detach().float().cpu().numpy()
        return picture

    def save_glb(self, path: str | Path) -> Path:
        """Write the animated textured mesh as binary glTF; return the path.

        Raises:
            BadInput: the file cannot be written, or the folder holds another asset.
        """
        path, folder = Path(path), self._checked_folder()
        check_writable(path.parent)
        try:
            shutil.copyfile(folder / ASSET, path)
        except OSError as error:
            raise BadInput(f"{path} cannot be written: {error.strerror or error}; choose another path") from error
        return path

    def __repr__(self) -> str:
        return f"<dg4d.Asset {self.name!r}: {self.frames} frames at {self.fps:g} fps in {self.folder}>"

    def _repr_html_(self) -> str:
        """Return the viewer page in an isolated frame, for notebooks."""
        if self._package is not None and "files" not in self._record:
            page = viewer_of_package(self._package, self.name)
        else:
            folder = self._checked_folder()
            page = viewer_html(self._record, lambda name: (folder / name).read_bytes())
        title, content = html.escape(self.name, quote=True), html.escape(page, quote=True)
        return (
            f'<iframe title="{title}" sandbox="allow-scripts allow-downloads" width="100%" height="{FRAME_HEIGHT}" '
            f'style="border:0" srcdoc="{content}"></iframe>'
        )

    def _checked_folder(self) -> Path:
        """Return the folder.

        Raises:
            BadInput: the package in it was replaced or removed since the asset was loaded.
        """
        if "files" in self._record and (record_of(self.folder) or {}).get("files") != self._record["files"]:
            raise BadInput(
                f"the folder {self.folder} now holds another asset, or none, instead of the {self.name!r} that was "
                "loaded; make each asset in a folder of its own: give out=..."
            )
        return self.folder

    def _position(self, t: float) -> Any:
        """Return a time as a position in frames, in a tensor."""
        import torch

        if not math.isfinite(t):
            raise BadInput(f"the time is {t}; give seconds, for example 0.5")
        frame = t * self.fps
        if abs(frame - round(frame)) < ROUNDING:
            frame = round(frame)
        return torch.tensor([frame % self.frames], dtype=torch.float64)

    @property
    def _placement(self) -> "Placement":
        """Map from the coordinates of the fit, which `steps.artifacts.rendering` reads, to meters."""
        return self.manifest.placement.placement

    @cached_property
    def _states(self) -> "States":
        from steps.artifacts.rendering import read_states

        return read_states(self._checked_folder(), self.manifest)

    @cached_property
    def _surface(self) -> "Surface":
        from steps.artifacts.rendering import read_surface

        return read_surface(self._checked_folder(), self.manifest)

    @cached_property
    def _render_gaussians(self) -> "Renderer":
        from dg4d_lib.rasterizer.interface import get_rasterizer
        from steps.artifacts.rendering import splat_renderer

        return splat_renderer(self._states, get_rasterizer("auto"))

    @cached_property
    def _render_mesh(self) -> "Renderer":
        from steps.artifacts.rendering import mesh_renderer

        return mesh_renderer(self._surface)


def _check_size(camera: "OrbitCamera") -> None:
    """Refuse pictures that are too large, and sizes that are not whole numbers; the camera checks the rest.

    Raises:
        BadInput: says what was given and what is allowed.
    """
    from steps.artifacts.rendering import LARGEST

    sides: tuple[Any, Any] = camera.width, camera.height  # the types are not checked at run time
    if not all(isinstance(side, Integral) and 1 <= int(side) <= LARGEST for side in sides):
        raise BadInput(
            f"the picture is {sides[0]} x {sides[1]} pixels; give a camera whose width and height are whole numbers "
            f"from 1 to {LARGEST}"
        )
