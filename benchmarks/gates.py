"""Calibration of the quality gates: values on good and on degraded assets, and the bounds between them.

Run with `python -m benchmarks.gates [PACKAGE ...] [--poor PACKAGE ...]` (minutes; `--json FILE` keeps the rows). A
package is a folder written by `dg4d make` with a tracked mesh, whose steps are still in $DG4D_HOME, which has the
driving video. `--poor` are packages with visible faults; none should pass. Three shapes of our own, with splats on the
surface of their mesh, are always among the good ones.

Every good asset is degraded in every way below, each aimed at one gate. A gate separates if it passes every good asset
and fails every asset degraded for it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.measure import WIDTH, machine, parser_of, write_rows  # before torch: how its threads wait

import numpy as np  # isort: skip
import torch
from jaxtyping import Float
from rich.console import Console
from rich.table import Column, Table
from torch import Tensor
from torch.nn.functional import interpolate
from trimesh.creation import icosphere

from dg4d_lib.asset_settings import GateSettings
from dg4d_lib.assets.animated import Asset4D, states_between
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh, sh_to_rgb
from dg4d_lib.images import resize_planes
from dg4d_lib.mesh.render import render_mesh
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.metrics.gates import Gate, evaluate_gates
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.video.driving import DrivingVideo
from flows.packages.publish import load_verified
from steps.artifacts.media import read_frames, read_png
from steps.artifacts.package_files import SUBJECT
from steps.artifacts.packages import read_manifest
from steps.artifacts.rendering import read_states, read_surface
from steps.check_asset import LoadedAsset, collect_evidence
from steps.contract import ArtifactRef
from steps.store.artifact_store import ArtifactStore
from steps.store.files import home

FRAMES, SIZE, FPS = 12, 256, 12.0  # frames, pixels and frame rate of our own shapes
SOLID = 3.0  # opacity logit of their splats
SPREAD = 0.6  # standard deviation of their splats, in edge lengths
INSET = 0.97  # distance of splat centers from the middle, relative to the surface


@dataclass(frozen=True)
class Sample:
    """Asset in memory, with its inputs.

    Attributes:
        name: of the object.
        states: cloud at every frame.
        surface: deforming mesh.
        video: driving video.
        cutout: input picture.
    """

    name: str
    states: Gaussians
    surface: Asset4D
    video: DrivingVideo
    cutout: Float[Tensor, "h w 4"]


@dataclass(frozen=True)
class Row:
    """Degradation, and the gate that it is aimed at."""

    spoiled_by: str
    gate: str
    least: float | None
    most: float | None
    good_min: float
    good_max: float
    spoiled_min: float
    spoiled_max: float
    good_passed: int
    spoiled_failed: int
    assets: int
    also_fails: str

    @property
    def separates(self) -> bool:
        """True if all good assets pass and all degraded ones fail."""
        return self.good_passed == self.spoiled_failed == self.assets


Spoil = Callable[[Sample], Sample]


def read_package(folder: Path) -> Sample:
    """Read a package.

    Raises:
        BadInput: it is broken, has a mesh per frame, or its driving video is kept no more.
    """
    record, manifest, store = load_verified(folder), read_manifest(folder), ArtifactStore(home() / "store")
    surface = read_surface(folder, manifest)
    if not isinstance(surface, Asset4D):
        raise BadInput(f"{folder} has a mesh per frame; give packages made with mesh.mode=tracked")
    packing = next(step for step in record["steps"] if step["step"] == "pack_asset")
    digest = packing["inputs"]["driving_video"]
    sizes = {entry.name: entry.size_bytes for entry in store.artifacts()}
    if digest not in sizes:
        raise BadInput(
            f"the driving video of {folder} is not in {store.root}; set DG4D_HOME to the home in which it was made"
        )
    with TemporaryDirectory() as scratch:
        ref = ArtifactRef(digest=digest, media_type="application/zip", size_bytes=sizes[digest])
        video = read_frames(store.path(ref), Path(scratch))
    states = read_states(folder, manifest)(torch.arange(manifest.frames, dtype=torch.float64))
    return Sample(folder.name, states, surface, video, read_png(folder / SUBJECT))


def own_sample(name: str) -> Sample:
    """Return a closed shape of our own as a nearly perfect asset: a mesh, and splats on its surface."""
    ball = icosphere(subdivisions=5, radius=1.0)
    ways, faces = torch.tensor(ball.vertices, dtype=torch.float32), torch.tensor(ball.faces, dtype=torch.int64)
    turns = torch.arange(FRAMES) / FRAMES * 2 * torch.pi
    shape, motion = SHAPES[name]
    places = torch.stack([motion(shape(ways)[:, None] * ways, 0.06 * turn.sin()) for turn in turns])
    colors = 0.5 + 0.4 * torch.sin(7 * ways + torch.tensor([0.0, 2.0, 4.0]) + 3 * ways.roll(1, 1))
    edge = (places[0][faces] - places[0][faces.roll(1, 1)]).norm(dim=-1).mean()
    states = Gaussians(
        means=INSET * places,
        log_scales=(SPREAD * edge).log().expand(FRAMES, len(ways), 3),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(FRAMES, len(ways), 4),
        opacity_logits=torch.full((len(ways),), SOLID),
        harmonics=rgb_to_sh(colors),
    )
    blank = TexturedMesh(places[0], faces, torch.zeros(len(ways), 2), torch.zeros(1, 1, 3))
    surface = Asset4D(*_painted(blank, places - places[0], colors), FPS)
    color, alpha = render_mesh(surface.mesh, [OrbitCamera(width=SIZE, height=SIZE)] * FRAMES, surface.offsets)
    return Sample(name, states, surface, DrivingVideo(color, alpha, FPS), torch.cat([color, alpha], -1)[0])


def _bent(places: Tensor, amount: Tensor) -> Tensor:
    """Bend sideways, increasingly with height."""
    return places + 2 * amount * places[:, 1:2].square() * torch.tensor([1.0, 0, 0])


def _breathing(places: Tensor, amount: Tensor) -> Tensor:
    return places * (1 + amount * torch.tensor([1.0, -1.0, 1.0]))


def _twisted(places: Tensor, amount: Tensor) -> Tensor:
    """Twist about the vertical axis, increasingly with height."""
    angle = 5 * amount * places[:, 1]
    x, y, z = places.unbind(1)
    return torch.stack([x * angle.cos() + z * angle.sin(), y, z * angle.cos() - x * angle.sin()], 1)


SHAPES: dict[str, tuple[Callable[[Tensor], Tensor], Callable[[Tensor, Tensor], Tensor]]] = {
    "stone": (lambda ways: 0.6 + 0.06 * torch.sin(4 * ways).prod(1), _breathing),
    "peanut": (lambda ways: 0.4 + 0.3 * ways[:, 1].square(), _bent),
    "star": (lambda ways: 0.45 + 0.25 * (ways.pow(4).sum(1) - 0.5), _twisted),
}


def _painted(
    mesh: TexturedMesh, offsets: Float[Tensor, "t v 3"], colors: Float[Tensor, "v 3"]
) -> tuple[TexturedMesh, Float[Tensor, "t w 3"]]:
    """Return the mesh with one texel per triangle."""
    side = int(np.ceil(np.sqrt(len(mesh.faces))))
    texture = torch.zeros(side * side, 3)
    texture[: len(mesh.faces)] = colors[mesh.faces].mean(1)
    texel = torch.arange(len(mesh.faces))
    uvs = (torch.stack([texel % side, texel // side], -1) + 0.5) / side
    corners = mesh.faces.flatten()
    faces = torch.arange(len(corners)).reshape(-1, 3)
    uvs = uvs.repeat_interleave(3, 0)
    return TexturedMesh(mesh.vertices[corners], faces, uvs, texture.reshape(side, side, 3)), offsets[:, corners]


def _noise(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0))


def _recolored(sample: Sample, change: Callable[[Tensor], Tensor]) -> Sample:
    """Replace the colors of splats and mesh."""
    colors = rgb_to_sh(change(sh_to_rgb(sample.states.harmonics)).clamp(0, 1))
    states = replace(sample.states, harmonics=colors)
    return replace(_retextured(sample, change), states=states)


def _retextured(sample: Sample, change: Callable[[Tensor], Tensor]) -> Sample:
    mesh = replace(sample.surface.mesh, texture=change(sample.surface.mesh.texture).clamp(0, 1))
    return replace(sample, surface=replace(sample.surface, mesh=mesh))


def _moved(sample: Sample, change: Callable[[Tensor], Tensor]) -> Sample:
    """Change the positions "t n 3" of splats and mesh."""
    rest = sample.surface.mesh.vertices
    offsets = change(rest + sample.surface.offsets) - rest
    states = replace(sample.states, means=change(sample.states.means))
    return replace(sample, states=states, surface=replace(sample.surface, offsets=offsets))


def _mesh_moved(sample: Sample, change: Callable[[Tensor], Tensor]) -> Sample:
    return replace(_moved(sample, change), states=sample.states)


def _splats_moved(sample: Sample, change: Callable[[Tensor], Tensor]) -> Sample:
    return replace(_moved(sample, change), surface=sample.surface)


def _refaced(sample: Sample, faces: Tensor) -> Sample:
    return replace(sample, surface=replace(sample.surface, mesh=replace(sample.surface.mesh, faces=faces)))


def _blurred(texture: Float[Tensor, "h w 3"], texels: int) -> Float[Tensor, "h w 3"]:
    """Replace the texture by one of very low resolution."""
    planes = texture.movedim(-1, 0)[None]
    small = resize_planes(planes, (texels, texels))
    return interpolate(small, texture.shape[:2], mode="bilinear")[0].movedim(0, -1)


def _deepened(means: Float[Tensor, "t n 3"]) -> Float[Tensor, "t n 3"]:
    """Scatter splats along the rays of the input camera, which leaves the input view unchanged."""
    eye = torch.tensor([0.0, 0.0, 2.0])
    rays = torch.nn.functional.normalize(means - eye, dim=-1)
    return means + 0.1 * _noise(1, means.shape[1], 1) * rays


def _scattered(means: Float[Tensor, "t n 3"]) -> Float[Tensor, "t n 3"]:
    """Move one of a hundred splats to a random position."""
    generator = torch.Generator().manual_seed(0)
    away = torch.rand(means.shape[1], 1, generator=generator) < 0.01
    return torch.where(away, torch.rand(means.shape[1], 3, generator=generator) * 1.6 - 0.8, means)


def _torn(places: Float[Tensor, "t n 3"]) -> Float[Tensor, "t n 3"]:
    """Raise the right half in one frame by a fifth of the subject."""
    torn = places.clone()
    middle = places[len(places) // 2]
    torn[len(places) // 2, :, 1] += 0.3 * (middle[:, 0] > middle[:, 0].median())
    return torn


def _holed(sample: Sample) -> Sample:
    """Remove everything around one Gaussian."""
    means = sample.states.means[0]
    near = (means - means[len(means) // 2])[:, :2].norm(dim=-1) < 0.25
    return replace(sample, states=replace(sample.states, opacity_logits=sample.states.opacity_logits - 20.0 * near))


SPOILS: dict[str, tuple[str, Spoil]] = {
    "washed-out colors": ("fidelity", lambda s: _recolored(s, lambda c: (1 + c) / 2)),
    "a hole in the splats": ("fidelity", _holed),
    "shifted by a twentieth": ("silhouette", lambda s: _moved(s, lambda p: p + torch.tensor([0.09, 0, 0]))),
    "enlarged by a tenth": ("silhouette", lambda s: _moved(s, lambda p: 1.1 * p)),
    "a torn frame of the mesh": ("silhouette", lambda s: _mesh_moved(s, _torn)),
    "splats scattered in depth": ("consistency", lambda s: _splats_moved(s, _deepened)),
    "every frame jumps": ("flicker", lambda s: _moved(s, lambda p: p + 0.03 * _noise(len(p), 1, 3).to(p))),
    "floaters": ("floaters", lambda s: _splats_moved(s, _scattered)),
    "one in fifty triangles gone": (
        "flaws",
        lambda s: _refaced(s, s.surface.mesh.faces[torch.arange(len(s.surface.mesh.faces)) % 50 > 0]),
    ),
    "turned inside out": ("flaws", lambda s: _refaced(s, s.surface.mesh.faces.flip(1))),
    "a crumpled mesh": ("folds", lambda s: _mesh_moved(s, lambda p: p + 0.02 * _noise(*p.shape).to(p))),
    "a mesh too thick": ("agreement", lambda s: _mesh_moved(s, lambda p: 1.15 * p)),
    "a blurred texture": ("sharpness", lambda s: _retextured(s, partial(_blurred, texels=16))),
    "noisy colors": ("sharpness", lambda s: _recolored(s, lambda c: c + 0.3 * _noise(*c.shape))),
    "frozen": ("motion", lambda s: _moved(s, lambda p: p[:1].expand_as(p))),
    "a frozen mesh": ("motion", lambda s: _mesh_moved(s, lambda p: p[:1].expand_as(p))),
    "three times the motion": ("motion", lambda s: _moved(s, lambda p: p[:1] + 3 * (p - p[:1]))),
}


def measure_gates(sample: Sample) -> dict[str, Gate]:
    """Return every gate by name."""
    parts = LoadedAsset(partial(states_between, sample.states), sample.surface, len(sample.surface.offsets))
    evidence = collect_evidence(parts, sample.video, sample.cutout, get_rasterizer("cpu"))
    return {gate.name: gate for gate in evaluate_gates(evidence, GateSettings())}


def rows(samples: Sequence[Sample], tell: Callable[[str], None]) -> list[Row]:
    """Return a row per degradation."""
    good = []
    for sample in samples:
        good.append(measure_gates(sample))
        tell(f"{sample.name}: {_verdict(good[-1])}")
    return [_row(name, gate, good, [measure_gates(spoil(sample)) for sample in samples])
            for name, (gate, spoil) in SPOILS.items()]  # fmt: skip


def _row(name: str, meant: str, good: Sequence[dict[str, Gate]], spoiled: Sequence[dict[str, Gate]]) -> Row:
    fine, bad = ([gates[meant] for gates in each] for each in (good, spoiled))
    others = [gate for gate in spoiled[0] if gate != meant and not any(gates[gate].passed for gates in spoiled)]
    return Row(
        name,
        meant,
        fine[0].least,
        fine[0].most,
        min(gate.value for gate in fine),
        max(gate.value for gate in fine),
        min(gate.value for gate in bad),
        max(gate.value for gate in bad),
        sum(gate.passed for gate in fine),
        sum(not gate.passed for gate in bad),
        len(good),
        ", ".join(others),
    )


def _verdict(gates: dict[str, Gate]) -> str:
    values = ", ".join(f"{name} {gate.value:.3g}" for name, gate in gates.items())
    failing = [name for name, gate in gates.items() if not gate.passed]
    return (f"not accepted ({', '.join(failing)})" if failing else "accepted") + f": {values}"


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("packages", nargs="*", type=Path, help="folders of good packages")
    parser.add_argument("--poor", nargs="*", default=[], type=Path, help="folders of packages with visible faults")
    options = parser.parse_args()
    console = Console(width=WIDTH, soft_wrap=True, highlight=False)
    found = rows([*map(read_package, options.packages), *map(own_sample, SHAPES)], console.print)
    for folder in options.poor:
        console.print(f"{folder.name}, poor: {_verdict(measure_gates(read_package(folder)))}")
    console.print(table(found))
    if options.json:
        write_rows(options.json, found)


def table(found: Sequence[Row]) -> Table:
    """Return the rows as a table."""
    count = found[0].assets
    result = Table(
        Column("spoiled by", no_wrap=True), "gate", "bounds", "good", "spoiled", "separates", "also fails",
        title=f"{machine()}; {count} assets",
    )  # fmt: skip
    for row in found:
        bounds = f"{'' if row.least is None else f'{row.least:g}'}..{'' if row.most is None else f'{row.most:g}'}"
        ranges = f"{row.good_min:.3g}..{row.good_max:.3g}", f"{row.spoiled_min:.3g}..{row.spoiled_max:.3g}"
        answer = "yes" if row.separates else f"{row.good_passed} good pass, {row.spoiled_failed} spoiled fail"
        result.add_row(row.spoiled_by, row.gate, bounds, *ranges, answer, row.also_fails)
    return result


if __name__ == "__main__":
    main()
