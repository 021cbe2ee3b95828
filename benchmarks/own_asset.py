"""Quality of `--asset`: true meshes of the first frame, driven by their videos, against the frozen ground truth.

    python -m benchmarks.own_asset FOLDER [--only panda mage] [--sheets DIR]
    python -m benchmarks.own_asset --synthetic

FOLDER has a folder per object with `input/`, `view_AZIMUTH/`, `bank/` and `mesh.npz`. The model of an object is its
mesh of frame 0, with colors baked from frame 0 of the bank; its place is searched as for any model.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks import true_views
from benchmarks.measure import parser_of
from benchmarks.true_views import SIZE, Figures, Subject, mean

import numpy as np  # isort: skip
import torch  # isort: skip
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import avg_pool2d

from benchmarks.objects.drawing import Painted
from benchmarks.objects.specimens import OBJECTS
from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.cameras.orbit import OrbitCamera, viewmats
from dg4d_lib.fitting.asset_motion import fit_asset_motion
from dg4d_lib.fitting.asset_pose import find_placement
from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.images import over_white, resize
from dg4d_lib.mesh.models.control_graph import build_control_graph
from dg4d_lib.mesh.models.model import Model, ModelPart
from dg4d_lib.mesh.models.surface_cloud import cover_surface
from dg4d_lib.mesh.texturing.bake import locate_texels
from dg4d_lib.mesh.texturing.unwrap import unwrap
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.metrics.surface import chamfer_distance, sample_surface
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.video.driving import DrivingVideo
from steps.animate_asset import moved_vertices, moving_graph
from steps.fitting.priors import read_bank_folder
from steps.profiles import PREVIEW

TEXTURE = 512  # texels per side of baked models
SAMPLES = 20000  # points of a surface for the chamfer distance
DEPTH_SLACK = 0.02  # world units by which a texel may lie behind the surface that a bank view shows
COLUMNS = ("psnr", "psnr_obj", "iou", "terr", "chamfer", "flipped", "input")
FPS = 12.0
SHEET_COLUMNS, SHEET_SIZE = 6, 288  # frames of a contact sheet, and pixels per side of each


@dataclass(frozen=True)
class OwnModel:
    """Model of a subject at its first frame, and the true meshes.

    Attributes:
        subject: footage and true views.
        model: mesh of frame 0, in world units.
        vertices: of the true meshes.
        faces: of the true meshes.
        weights: of the faces in samples of the surface.
    """

    subject: Subject
    model: Model
    vertices: Float[Tensor, "t v 3"]
    faces: Int[Tensor, "f 3"]
    weights: Float[Tensor, " f"]


def read_models(folder: Path, names: Sequence[str] = ()) -> Iterator[OwnModel]:
    """Read the objects of a data set that have meshes and a bank, all of them if none is named."""
    for subject in true_views.read_subjects(folder, names):
        truth = subject.truth
        if truth is None or truth.mesh is None or truth.bank is None:
            continue
        with np.load(truth.mesh) as archive:
            vertices = torch.from_numpy(archive["vertices"].astype(np.float32))
            faces = torch.from_numpy(archive["faces"].astype(np.int64))
            weights = torch.from_numpy(archive["face_weight"].astype(np.float32))
        yield OwnModel(subject, baked_model(vertices[0], faces, truth.bank), vertices, faces, weights)


def synthetic_models(frames: int, names: Sequence[str] = ()) -> Iterator[OwnModel]:
    """Render our own objects, for tuning."""
    azimuths = (-75.0, 15.0, 105.0, 195.0)
    cameras = [OrbitCamera(0, azimuth, width=SIZE, height=SIZE) for azimuth in (0.0, *azimuths)]
    for name, make in OBJECTS.items():
        if names and name not in names:
            continue
        painted = Painted(make())
        pictures = torch.stack([painted.draw(frame / frames, cameras) for frame in range(frames)], 1)
        vertices = torch.stack([painted.vertices(frame / frames) for frame in range(frames)])
        linear = np.power(painted.colors.numpy(), 2.2)
        part = ModelPart(name, vertices[0].numpy(), painted.faces.numpy(), colors=linear)
        views = dict(zip(azimuths, pictures[1:], strict=True))
        subject = Subject(name, pictures[0], views)
        yield OwnModel(subject, Model((part,)), vertices, painted.faces, torch.ones(len(painted.faces)))


def baked_model(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], bank_folder: Path) -> Model:
    """Return a mesh with a texture: means over the views of a bank's first frame that see a texel, by their angle."""
    bank = read_bank_folder(bank_folder)
    sources, corners, uvs = map(torch.from_numpy, unwrap(vertices.numpy(), faces.numpy(), TEXTURE))
    split, corners = vertices[sources.long()], corners.long()
    normals = vertex_normals(vertices, faces)[sources.long()]
    texels = locate_texels(split, normals, corners, uvs, TEXTURE)
    pictures = bank.pictures[:, bank.frames.index(0)].float() / 255
    depth = rasterize_mesh(vertices, faces, list(bank.cameras)).depth
    total, weight = torch.zeros(len(texels.rows), 3), torch.full((len(texels.rows), 1), 1e-9)
    for camera, matrix, picture, nearest in zip(bank.cameras, viewmats(bank.cameras), pictures, depth, strict=True):
        seen = texels.positions @ matrix[:3, :3].T.float() + matrix[:3, 3].float()
        pixel = seen[:, :2] / seen[:, 2:] * camera.focal + camera.width / 2
        column, row = (pixel.floor().long().clamp(0, camera.width - 1)).T
        towards = torch.nn.functional.normalize(camera.position().float() - texels.positions, dim=-1)
        facing = (towards * texels.normals).sum(-1).abs()  # some meshes are one-sided
        visible = (seen[:, 2] < nearest[row, column] + DEPTH_SLACK) & (picture[row, column, 3] > 0.9)
        share = (facing.square().square() * visible + 1e-6 * (picture[row, column, 3] > 0.5))[:, None]
        total += share * picture[row, column, :3]
        weight += share
    texture = np.full((TEXTURE, TEXTURE, 4), 255, np.uint8)
    texture[texels.rows, texels.columns, :3] = (255 * total / weight).round().clamp(0, 255).numpy()
    for _ in range(4):  # grow the charts, for bilinear sampling
        texture = _grown(texture, texels.rows, texels.columns)
    return Model((ModelPart("object", split.numpy(), corners.numpy(), uvs.numpy(), texture),))


def _grown(texture: np.ndarray, rows: Tensor, columns: Tensor) -> np.ndarray:
    empty = np.ones(texture.shape[:2], bool)
    empty[rows, columns] = False
    nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
    return texture[tuple(nearest)]


def render_model(model: Model, moved: Float[Tensor, "t v 3"], camera: OrbitCamera) -> Float[Tensor, "t s s 4"]:
    """Render a model unlit at all frames, straight alpha."""
    fine = replace(camera, width=2 * camera.width, height=2 * camera.height)
    frames = []
    for vertices in moved:
        fragments = rasterize_mesh(vertices.float(), torch.from_numpy(model.faces).long(), [fine])
        covered = fragments.faces[0] >= 0
        picture = torch.zeros(fine.height, fine.width, 4)
        colors, _ = model.sample(
            fragments.faces[0][covered].long().numpy(), fragments.barycentrics[0][covered].double().numpy()
        )
        picture[covered] = torch.cat([torch.from_numpy(colors), torch.ones(len(colors), 1)], 1)
        frames.append(avg_pool2d(picture.movedim(-1, 0)[None], 2)[0].movedim(0, -1))
    rendering = torch.stack(frames)
    return torch.cat([rendering[..., :3] / rendering[..., 3:].clamp(min=1e-6), rendering[..., 3:]], -1)


def score(own: OwnModel, moved: Float[Tensor, "t v 3"], faces: Int[Tensor, "f 3"]) -> Figures:
    """Compare renders and meshes of a motion with the ground truth."""
    rows = []
    for azimuth, truth in _views(own.subject):
        rendering = render_model(own.model, moved, OrbitCamera(0, azimuth, width=SIZE, height=SIZE))
        rows.append(true_views.figures(over_white(rendering), rendering[..., 3:], truth))
    return {**mean(rows[1:]), "chamfer": _chamfer(own, moved, faces, None), "input": rows[0]["psnr"]}


def frozen(own: OwnModel) -> Figures:
    """Return the figures of the true first frame of each view and of the true first mesh, frozen."""
    rows = []
    for _, truth in _views(own.subject):
        still = truth[:1].expand_as(truth)
        rows.append(true_views.figures(over_white(still), still[..., 3:], truth))
    rest = own.vertices[:1].expand_as(own.vertices)
    distance = _chamfer(own, rest, own.faces, own.weights)
    return {**mean(rows[1:]), "chamfer": distance, "flipped": 0.0, "input": rows[0]["psnr"]}


def _views(subject: Subject) -> list[tuple[float, Float[Tensor, "t s s 4"]]]:
    """Return azimuths and true pictures, those of the input first."""
    return [(0.0, resize(subject.footage, (SIZE, SIZE))), *subject.views.items()]


def _chamfer(
    own: OwnModel, moved: Float[Tensor, "t v 3"], faces: Int[Tensor, "f 3"], weights: Float[Tensor, " f"] | None
) -> float:
    """Return the mean distance of moved meshes from the true ones."""
    generator = torch.Generator().manual_seed(0)
    distances = [
        chamfer_distance(
            sample_surface(ours, faces, SAMPLES, generator, weights),
            sample_surface(theirs, own.faces, SAMPLES, generator, own.weights),
        )
        for ours, theirs in zip(moved, own.vertices, strict=True)
    ]
    return float(np.mean(distances))


def animate(own: OwnModel, settings: AssetSettings) -> tuple[Float[Tensor, "t v 3"], int]:
    """Place a subject's model and fit its motion; return its vertices at all frames and the number of flipped faces."""
    rasterize = get_rasterizer("auto")
    generator = torch.Generator().manual_seed(0)
    footage, covered = own.subject.footage, cover_surface(own.model, settings.points, generator)
    placement = find_placement(covered.cloud, footage[0], rasterize)
    surface = covered.placed(placement.quat, placement.scale, placement.shift)
    graph = build_control_graph(surface.fine.vertices, surface.fine.faces, settings.nodes)
    bound = graph.of(surface.nearest)
    video = DrivingVideo(footage[..., :3].contiguous(), footage[..., 3:].contiguous(), FPS)
    motion = fit_asset_motion(surface.cloud, bound, video, rasterize, settings, generator)
    return moved_vertices(surface, moving_graph(graph, motion, settings.rigid_parts, surface.fine.faces), motion)


def measure(
    models: Iterator[OwnModel],
    settings: AssetSettings,
    show: Callable[[str], None],
    sheets: Path | None = None,
) -> dict[str, Figures]:
    """Animate models and show the figures of each beside the frozen ground truth; return ours.

    Args:
        models: with their ground truth.
        settings: of the fit.
        show: prints a line.
        sheets: folder for a contact sheet of each.
    """
    found: dict[str, Figures] = {}
    still: dict[str, Figures] = {}
    show(f"{'':24}" + "".join(f"{column:>10}" for column in COLUMNS))
    for own in models:
        begun, name = time.perf_counter(), own.subject.name
        vertices, flipped = animate(own, settings)
        found[name] = {**score(own, vertices, torch.from_numpy(own.model.faces)), "flipped": float(flipped)}
        still[name] = frozen(own)
        show(row(name, found[name]) + f"   {time.perf_counter() - begun:.0f} s")
        show(row("  truth, frozen", still[name]))
        if sheets is not None:
            sheets.mkdir(parents=True, exist_ok=True)
            true_views.write_sheet(sheets / f"{name}.png", [sheet(own, vertices)])
    show(row("mean", mean(list(found.values()))))
    show(row("  truth, frozen", mean(list(still.values()))))
    return found


def write_line(text: str) -> None:
    """Write a line to standard output, at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def row(name: str, figures: Figures) -> str:
    """Return a line of the table."""
    return f"{name:24}" + "".join(f"{figures[column]:10.3f}" for column in COLUMNS)


def sheet(own: OwnModel, moved: Float[Tensor, "t v 3"]) -> Float[Tensor, "h w 3"]:
    """Compose some frames: for every view a row of the ground truth and one of ours."""
    frames = torch.linspace(0, len(moved) - 1, SHEET_COLUMNS).round().long()
    rows = []
    for azimuth, truth in _views(own.subject):
        camera = OrbitCamera(0, azimuth, width=SHEET_SIZE, height=SHEET_SIZE)
        ours = over_white(render_model(own.model, moved[frames], camera))
        theirs = resize(over_white(truth[frames]), (SHEET_SIZE, SHEET_SIZE))
        rows += [torch.cat(list(theirs), 1), torch.cat(list(ours), 1)]
    return torch.cat(rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure the objects of a folder, or our own."""
    parser = parser_of(__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--only", nargs="+", default=(), help="names of objects")
    parser.add_argument("--synthetic", action="store_true", help="our own objects instead")
    parser.add_argument("--frames", type=int, default=16, help="of our own objects")
    parser.add_argument("--sheets", type=Path, metavar="DIR", help="folder for a contact sheet of each")
    given = parser.parse_args(arguments)
    if given.folder is None and not given.synthetic:
        parser.error("give a folder, or --synthetic")
    models = synthetic_models(given.frames, given.only) if given.synthetic else read_models(given.folder, given.only)
    found = measure(models, PREVIEW.asset, write_line, given.sheets)
    if given.json:
        given.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
