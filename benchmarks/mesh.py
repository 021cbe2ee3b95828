"""Speed of mesh rasterization against ray casting, and of texture sampling: CPU time per frame.

Run with `python -m benchmarks.mesh` (a minute; `--quick`: seconds; `--json FILE` keeps the rows). The mesh deforms, so
acceleration structures of peers are built for every frame; rays are computed in advance. Missing peers are listed;
`pip install --target DIR embreex open3d` and `PYTHONPATH=DIR` add them. Face and barycentric coordinates of every
pixel:

`embreex`      Intel's Embree
`open3d`       Open3D's RaycastingScene, based on Embree
`trimesh`      trimesh's `intersects_first`, based on Embree: face ids only

One iteration on a texture, value and gradient, of all frames; ours is trilinear between mip levels, the peers bilinear:

`texture_list`      grid_sample at the covered pixels of all frames as one list
`texture_frames`    grid_sample of all frames in one call, with the texture expanded
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any

from benchmarks.measure import Times, interleaved, machine, new_console, parser_of, write_rows  # before torch

import numpy as np  # isort: skip
import torch
from numpy.typing import NDArray
from rich.table import Column, Table
from torch import Tensor
from torch.nn.functional import grid_sample

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.cameras.viewpoints import turntable
from dg4d_lib.mesh_rasterizer.texture import build_lookup, sample_bilinear, sample_texture
from dg4d_lib.mesh_rasterizer.zbuffer import interpolate, rasterize_mesh

FRAMES, TEXELS = 14, 1024

Picture = NDArray[np.int64]  # face of every pixel, -1: none
Rays = tuple[NDArray[np.float32], ...]  # of all pixels: origins, directions, and both concatenated
Peer = Callable[[NDArray[np.float32], NDArray[np.int32], Rays], Picture]  # vertices, faces


@dataclass(frozen=True)
class Row:
    """Comparison with a peer; times per frame."""

    peer: str
    faces: int
    size: int
    views: int
    ours_cpu_ms: float
    peer_cpu_ms: float
    cpu_ratio: float


@dataclass(frozen=True)
class Finding:
    """Row with additional columns: wall times, and the fraction of pixels with the same triangle as ours."""

    row: Row
    ours_wall_ms: float
    peer_wall_ms: float
    agreement: float | None = None


@dataclass(frozen=True)
class Scene:
    """Deforming mesh with a camera per frame.

    Attributes:
        states: vertices of every frame, "t v 3".
        faces: "f 3".
        uvs: "v 2".
        cameras: t cameras.
    """

    states: Tensor
    faces: Tensor
    uvs: Tensor
    cameras: Sequence[OrbitCamera]


def bumpy_ball(faces: int, size: int, frames: int) -> Scene:
    """Return a closed surface with waves and about this many faces, by longitude and latitude."""
    rows = round(math.sqrt(faces / 4))
    v, u = torch.meshgrid(torch.linspace(0, 1, rows + 1), torch.linspace(0, 1, 2 * rows + 1), indexing="ij")
    polar, around = math.pi * v, 2 * math.pi * u
    radius = 0.7 + 0.08 * (3 * around).sin() * polar.sin() ** 2 + 0.05 * (9 * polar).cos()
    sphere = torch.stack([polar.sin() * around.cos(), polar.cos(), polar.sin() * around.sin()], -1)
    rest = (radius[..., None] * sphere).reshape(-1, 3)
    index = torch.arange(len(rest), dtype=torch.int32).reshape(u.shape)
    a, b, c, d = (part.flatten() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    triangles = torch.cat([torch.stack([a, b, c], -1), torch.stack([b, d, c], -1)])
    times = torch.arange(frames)[:, None, None] / frames
    states = rest + 0.04 * torch.sin(2 * math.pi * (times + rest[:, [1, 2, 0]]))
    uvs = torch.stack([u, v], -1).reshape(-1, 2)
    return Scene(states, triangles, uvs, turntable(frames, OrbitCamera(12.0, width=size, height=size)))


def rays(camera: OrbitCamera) -> Rays:
    y, x = torch.meshgrid(*[torch.arange(side) + 0.5 for side in (camera.height, camera.width)], indexing="ij")
    sides = [(x - 0.5 * camera.width) / camera.focal, (y - 0.5 * camera.height) / camera.focal, torch.ones_like(x)]
    directions = torch.stack(sides, -1).double().reshape(-1, 3) @ camera.viewmat()[:3, :3]
    origins = camera.position().expand_as(directions)
    pair = origins.float().contiguous().numpy(), directions.float().contiguous().numpy()
    return *pair, np.concatenate(pair, 1)


def embreex() -> Peer:
    scenes, meshes = import_module("embreex.rtcore_scene"), import_module("embreex.mesh_construction")

    def cast(vertices: NDArray[np.float32], faces: NDArray[np.int32], cast_from: Rays) -> Picture:
        scene = scenes.EmbreeScene()
        meshes.TriangleMesh(scene, vertices, faces)
        hits: Picture = scene.run(*cast_from[:2], output=1)["primID"].astype(np.int64)
        return hits

    return cast


def open3d() -> Peer:
    library: Any = import_module("open3d")
    threads = torch.get_num_threads()

    def cast(vertices: NDArray[np.float32], faces: NDArray[np.int32], cast_from: Rays) -> Picture:
        scene = library.t.geometry.RaycastingScene(nthreads=threads)
        scene.add_triangles(library.core.Tensor(vertices), library.core.Tensor(faces.view(np.uint32)))
        found = scene.cast_rays(library.core.Tensor(cast_from[2]), nthreads=threads)
        hits: Picture = found["primitive_ids"].numpy().view(np.int32).astype(np.int64)
        return hits

    return cast


def trimesh() -> Peer:
    import_module("embreex")  # without it, trimesh takes a minute per image
    library: Any = import_module("trimesh")

    def cast(vertices: NDArray[np.float32], faces: NDArray[np.int32], cast_from: Rays) -> Picture:
        hits: Picture = library.Trimesh(vertices, faces, process=False).ray.intersects_first(*cast_from[:2])
        return hits

    return cast


def available_peers() -> tuple[dict[str, Peer], dict[str, str]]:
    """Return the available peers, and the reasons why others are missing."""
    found, missing = {}, {}
    for prepare in (embreex, open3d, trimesh):
        try:
            found[prepare.__name__] = prepare()
        except ImportError as error:
            missing[prepare.__name__] = str(error)
    return found, missing


def of_drawing(scene: Scene, peers: dict[str, Peer], rounds: int) -> Iterator[Finding]:
    states, faces = [state.numpy() for state in scene.states], scene.faces.numpy()
    cast_from = [rays(camera) for camera in scene.cameras]

    def cast(peer: Peer) -> list[Picture]:
        return [peer(state, faces, lines) for state, lines in zip(states, cast_from, strict=True)]

    def ours() -> Tensor:
        return rasterize_mesh(scene.states, scene.faces, scene.cameras).faces

    taken = interleaved({"ours": ours, **{name: partial(cast, peer) for name, peer in peers.items()}}, rounds)
    seen = ours().flatten(1).numpy()
    for name, peer in peers.items():
        yield finding(scene, name, taken["ours"], taken[name], float((np.stack(cast(peer)) == seen).mean()))


def of_texture(scene: Scene, rounds: int) -> Iterator[Finding]:
    generator = torch.Generator().manual_seed(0)
    texture = torch.rand(TEXELS, TEXELS, 3, generator=generator, requires_grad=True)
    fragments = rasterize_mesh(scene.states, scene.faces, scene.cameras)
    lookup = build_lookup(scene.states, scene.faces, scene.uvs, (TEXELS, TEXELS), scene.cameras, fragments)
    everywhere = interpolate(fragments, scene.faces, scene.uvs)
    places = everywhere[lookup.covered]
    pull = torch.randn(len(places), 3, generator=generator)
    pulls = torch.zeros(*lookup.covered.shape, 3)
    pulls[lookup.covered] = pull

    def by_frames() -> Tensor:
        expanded = texture.movedim(-1, 0).expand(len(everywhere), -1, -1, -1)
        return grid_sample(expanded, 2 * everywhere - 1, align_corners=False, padding_mode="border").movedim(1, -1)

    functions: dict[str, Callable[[], object]] = {
        "ours": lambda: torch.autograd.grad(sample_texture(texture, lookup), texture, pull),
        "texture_list": lambda: torch.autograd.grad(sample_bilinear(texture, places), texture, pull),
        "texture_frames": lambda: torch.autograd.grad(by_frames(), texture, pulls),
    }
    taken = interleaved(functions, rounds)
    for peer in list(functions)[1:]:
        yield finding(scene, peer, taken["ours"], taken[peer])


def finding(scene: Scene, peer: str, ours: Times, theirs: Times, agreement: float | None = None) -> Finding:
    views = len(scene.cameras)
    times = ours.cpu_ms / views, theirs.cpu_ms / views, theirs.cpu_ms / ours.cpu_ms
    row = Row(peer, len(scene.faces), scene.cameras[0].width, views, *times)
    return Finding(row, ours.wall_ms / views, theirs.wall_ms / views, agreement)


def main() -> None:
    options = parser_of(__doc__, "a small case, few rounds").parse_args()
    count, sizes, frames, rounds = (5_000, (128,), 3, 3) if options.quick else (50_000, (256, 512), FRAMES, 7)
    console, (peers, missing) = new_console(), available_peers()
    found = []
    for size in sizes:
        scene = bumpy_ball(count, size, frames)
        found += [*of_drawing(scene, peers, rounds), *of_texture(scene, rounds)]
    console.print(table(f"{machine()}; milliseconds per frame, {frames} frames", found))
    for name, reason in missing.items():
        console.print(f"{name} is missing: {reason}", markup=False, highlight=False)
    if options.json:
        write_rows(options.json, [each.row for each in found])


def table(title: str, found: list[Finding]) -> Table:
    """Return findings as a table."""
    result = Table(
        Column("peer", no_wrap=True), "faces", "px", "ours CPU", "peer CPU", "ratio", "ours wall", "peer wall",
        "same face", title=title,
    )  # fmt: skip
    for each in found:
        row = each.row
        times = f"{row.ours_cpu_ms:.2f}", f"{row.peer_cpu_ms:.2f}", f"{row.cpu_ratio:.1f}"
        walls = f"{each.ours_wall_ms:.2f}", f"{each.peer_wall_ms:.2f}"
        agreement = "" if each.agreement is None else f"{100 * each.agreement:.3f} %"
        result.add_row(row.peer, str(row.faces), str(row.size), *times, *walls, agreement)
    return result


if __name__ == "__main__":
    main()
