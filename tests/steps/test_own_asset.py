"""A model of the user's own: read, placed, set in motion, and packed."""

import json
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from dg4d_lib.assets.formats.foreign_glb import read_foreign_glb
from dg4d_lib.assets.formats.glb import read_glb
from dg4d_lib.assets.formats.gltf import INDEX_DATA, VERTEX_DATA, GlbReader, GltfDocument
from dg4d_lib.assets.formats.model_glb import write_model_glb
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.fitting import skeleton_motion
from dg4d_lib.fitting.node_motion import NodeMotion
from dg4d_lib.gaussians.ply import read_ply, write_ply
from dg4d_lib.mesh.models.model import Model, ModelPart
from dg4d_lib.mesh.models.surface_cloud import cover_surface
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.video.driving import DrivingVideo
from steps import animate_asset, pack_asset, prepare_asset
from steps.artifacts.media import read_png, write_frames, write_png
from steps.artifacts.meshes import read_tracked
from steps.artifacts.motions import read_motion
from steps.artifacts.packages import read_manifest
from steps.artifacts.placements import read_placement
from steps.artifacts.rendering import read_surface
from steps.catalog import STEPS
from steps.profiles import PREVIEW, revise, step_settings
from steps.runtime.job import Job
from steps.sources.models import embed_files, read_model

SMALL = revise(
    PREVIEW,
    {
        "subject.size": 64,
        "asset.points": 600,
        "asset.fit_points": 600,
        "asset.nodes": 12,
        "asset.size": 32,
        "asset.track_iterations": 1,
        "asset.joint_iterations": 2,
        "mesh.texture_size": 64,
        "pack.splats": False,
        "pack.spz": False,
        "pack.rig": False,
    },
)
CAMERA = OrbitCamera(width=64, height=64)


def fish() -> Model:
    """Return a long body with a red front, a blue back and a green fin on one side."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    vertices = ball.vertices * (0.35, 0.35, 0.8)
    fin = (vertices[:, 1] > 0.1) & (vertices[:, 2] < -0.2)
    vertices[fin] *= (1, 1.8, 1)
    colors = np.where(vertices[:, 2:] > 0.2, (1.0, 0, 0), (0, 0, 1.0)).astype(float)
    colors[vertices[:, 0] > 0.2] = (0, 1, 0)
    return Model((ModelPart("fish", vertices.astype(np.float32), np.asarray(ball.faces), colors=colors),))


def zipped(folder: Path, **files: bytes) -> Path:
    path = folder / "model.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name.replace("_", "."), content)
    return path


def job_of(step: str, folder: Path, inputs: dict[str, Path], settings=SMALL, **values: object) -> Job:
    folder.mkdir(exist_ok=True, parents=True)
    (folder / "pictures").mkdir(exist_ok=True)
    spec = STEPS[step]
    outputs = {name: folder / f"{name}{port.suffix}" for name, port in spec.outputs.items()}
    known = {name: path for name, path in inputs.items() if spec.input_port(name)}
    return Job(known, outputs, step_settings(step, settings, **values), 0, lambda *_: None, folder / "pictures")


def render(model: Model, azimuth: float) -> torch.Tensor:
    """Return a cut-out of a model from an azimuth."""
    cloud = cover_surface(model, 3000, torch.Generator().manual_seed(5)).cloud
    drawn = get_rasterizer("cpu")(cloud, [OrbitCamera(0, azimuth, width=64, height=64)], torch.zeros(3))
    color, alpha = drawn.color[0], drawn.alpha[0]
    return torch.cat([color / alpha.clamp_min(1e-4), alpha], -1).clamp(0, 1)


@pytest.fixture(scope="module")
def model_zip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return zipped(tmp_path_factory.mktemp("model"), model_glb=write_model_glb(fish()))


@pytest.fixture(scope="module")
def prepared(model_zip: Path, tmp_path_factory: pytest.TempPathFactory) -> Job:
    """Return the job that placed the fish in a picture of it from azimuth 60, at half its size and to the left."""
    folder = tmp_path_factory.mktemp("prepared")
    matrix = np.diag([0.7, 0.7, 0.7, 1.0])
    write_png(folder / "subject.png", render(fish().placed(matrix), 60.0))
    job = job_of("prepare_asset", folder / "out", {"model": model_zip, "subject": folder / "subject.png"})
    prepare_asset.run(job)
    return job


def test_azimuth_and_scale_are_found(prepared: Job) -> None:
    placement = read_placement(prepared.outputs["placement"])
    assert placement.azimuth_deg == pytest.approx(60, abs=8)
    assert placement.scale == pytest.approx(0.7, rel=0.07)  # the picture is drawn a pixel wider than the model
    assert placement.agreement > 0.85


def test_the_glb_is_kept_to_the_byte(prepared: Job) -> None:
    assert read_foreign_glb(prepared.outputs["glb"].read_bytes(), 10**6).model.parts[0].name == "fish"


def test_a_picture_of_something_else_is_refused_with_a_picture_of_both(model_zip: Path, tmp_path: Path) -> None:
    ring = torch.zeros(64, 64, 4)
    ring[4:60, 4:60] = 1
    ring[12:52, 12:52] = 0
    write_png(tmp_path / "ring.png", ring)
    job = job_of("prepare_asset", tmp_path, {"model": model_zip, "subject": tmp_path / "ring.png"})
    with pytest.raises(BadInput, match=r"does not agree with the first frame.*--asset-azimuth"):
        prepare_asset.run(job)
    assert (job.pictures / "model_and_subject.png").is_file()


def test_a_model_alone_becomes_its_own_subject(model_zip: Path, tmp_path: Path) -> None:
    settings = revise(SMALL, {"asset.find_azimuth": False, "asset.azimuth_deg": 90.0})
    job = job_of("prepare_asset", tmp_path, {"model": model_zip}, settings)
    report = prepare_asset.run(job)
    subject = read_png(job.outputs["subject"])
    assert subject[..., 3].mean() > 0.05
    middle = subject[24:40, 24:40, :3].mean((0, 1))
    assert middle.argmax() == 1  # the green side is at azimuth 90
    assert any("render of the model" in note for note in report.notes)
    assert any("(1 mesh part, " in note for note in report.notes)


@pytest.fixture(scope="module")
def animated(prepared: Job, tmp_path_factory: pytest.TempPathFactory) -> tuple[Job, dict[str, Path]]:
    """Return the job that moved the placed fish to the right in three frames, and the inputs for packing."""
    folder = tmp_path_factory.mktemp("animated")
    cloud = read_ply(prepared.outputs["gaussians"])
    frames = []
    for frame in range(3):
        shifted = cloud.means + torch.tensor([0.08 * frame, 0, 0])
        drawn = get_rasterizer("cpu")(type(cloud)(**{**vars(cloud), "means": shifted}), [CAMERA], torch.zeros(3))
        color, alpha = drawn.color[0], drawn.alpha[0]
        frames.append(torch.cat([color / alpha.clamp_min(1e-4), alpha], -1).clamp(0, 1))
    video = torch.stack(frames)
    write_frames(folder / "video.zip", DrivingVideo(video[..., :3], video[..., 3:], 5.0))
    write_png(folder / "subject.png", video[0])
    inputs = {**prepared.outputs, "driving_video": folder / "video.zip", "subject": folder / "subject.png"}
    settings = revise(SMALL, {"asset.track_iterations": 2})
    job = job_of("animate_asset", folder / "out", inputs, settings)
    animate_asset.run(job)
    return job, {**inputs, **job.outputs}


def test_the_motion_of_the_video_is_found(animated: tuple[Job, dict[str, Path]], prepared: Job) -> None:
    fitted = read_motion(animated[0].outputs["motion"])
    cloud = read_ply(prepared.outputs["gaussians"])
    moved = fitted.deformation.displace(cloud.means, torch.linspace(0, 1, 3)).means.mean(1)
    torch.testing.assert_close(moved[2] - moved[0], torch.tensor([0.16, 0.0, 0.0]), atol=0.03, rtol=0)


def test_the_note_tells_rigid_parts_from_a_surface_that_bends() -> None:
    turns = torch.tensor([[1.0, 0, 0, 0], [0.9, 0.1, 0, 0], [0.9, 0, 0.1, 0]])
    quats = turns[[0, 1, 1, 2, 2, 2]].expand(4, 6, 4)
    motion = NodeMotion(quats, torch.zeros(4, 6, 3), quats[:, 0], torch.zeros(4, 3))
    assert "The model was animated as 3 rigid parts," in animate_asset.motion_note(motion, 4)
    assert animate_asset.motion_note(motion, 2) == animate_asset.NOTE


def test_the_package_has_the_users_own_mesh(animated: tuple[Job, dict[str, Path]], tmp_path: Path) -> None:
    settings = revise(SMALL, {"pack.height_m": 0.3, "pack.fps": 8.0})
    job = job_of("pack_asset", tmp_path / "pack", animated[1], settings, notes=("a note",))
    report = pack_asset.run(job)
    with zipfile.ZipFile(job.outputs["package"]) as archive:
        archive.extractall(tmp_path / "package")
    manifest = read_manifest(tmp_path / "package")
    assert manifest.mode == "own"
    own = read_foreign_glb((tmp_path / "package/asset.glb").read_bytes(), 10**6)
    assert own.model.parts[0].name == "fish"
    assert len(own.model.vertices) == len(fish().vertices)
    surface = read_surface(tmp_path / "package", manifest)
    assert len(surface.offsets) == 5 and len(surface.mesh.faces) == len(fish().faces)
    merged = read_glb((tmp_path / "package/asset_merged.glb").read_bytes())
    first = (merged.mesh.vertices + merged.offsets[0]).numpy()
    for ours, theirs in ((own.model.vertices.min(0), first.min(0)), (own.model.vertices.max(0), first.max(0))):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)
    assert np.ptp(own.model.vertices[:, 1]) == pytest.approx(0.3, abs=1e-4)
    sampler = own.reader.tree["animations"][0]["samplers"][0]
    assert own.reader.tree["accessors"][sampler["input"]]["max"] == [manifest.duration_s] == [5 / 8]
    assert "asset.glb keeps the keys of the driving video, 5 per second, not 8" in report.notes


ALONG, UPPER = 13, 0.4  # vertices along the arm, and half of its length


def arm_glb() -> bytes:
    """Return a skinned arm along x, red, then blue, with joints at its left end and in its middle."""
    x = np.linspace(-UPPER, UPPER, ALONG)
    around = [(-0.1, -0.1), (0.1, -0.1), (0.1, 0.1), (-0.1, 0.1)]
    vertices = np.concatenate([np.stack([x, np.full(ALONG, y), np.full(ALONG, z)], 1) for y, z in around])
    sides = [(ALONG * side, ALONG * ((side + 1) % 4)) for side in range(4)]
    quads = [(a + k, b + k, b + k + 1, a + k + 1) for a, b in sides for k in range(ALONG - 1)]
    faces = np.array([corners for a, b, c, d in quads for corners in ((a, b, c), (a, c, d))])
    colors = np.where(vertices[:, :1] < 0, [[0.8, 0.1, 0.1]], [[0.1, 0.1, 0.8]])
    document, above = GltfDocument({}), vertices[:, :1] > 0
    binding = np.tile(np.eye(4, dtype="<f4"), (2, 1, 1))
    binding[0, 3, 0] = UPPER  # column by column: the first joint is bound at the left end
    rows = {
        "POSITION": vertices.astype("<f4"),
        "COLOR_0": colors.astype("<f4"),
        "JOINTS_0": np.tile(np.array([0, 1, 0, 0], np.uint8), (len(vertices), 1)),
        "WEIGHTS_0": np.concatenate([~above, above, 0 * above, 0 * above], 1).astype("<f4"),
    }
    attributes = {name: document.add_accessor(name, values, VERTEX_DATA) for name, values in rows.items()}
    indices = document.add_accessor("triangles", faces.ravel().astype("<u2"), INDEX_DATA)
    mesh = document.add("meshes", name="arm", primitives=[{"attributes": attributes, "indices": indices}])
    document.add("nodes", name="shoulder", translation=[-UPPER, 0.0, 0.0], children=[1])
    document.add("nodes", name="elbow", translation=[UPPER, 0.0, 0.0])
    view = document.add_view("binding", binding.tobytes())
    matrices = document.add("accessors", bufferView=view, componentType=5126, count=2, type="MAT4")
    skin = document.add("skins", joints=[0, 1], inverseBindMatrices=matrices)
    node = document.add("nodes", name="arm", mesh=mesh, skin=skin)
    document.tree["scene"] = document.add("scenes", nodes=[0, node])
    return document.to_bytes()


def bent_arm(angle: float) -> Model:
    """Return the arm with its forearm raised by an angle, in radians."""
    (part,) = read_foreign_glb(arm_glb(), 1000).model.parts
    c, s = np.cos(angle), np.sin(angle)
    raised = part.vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], np.float32)
    return Model((replace(part, vertices=np.where(part.vertices[:, :1] > 0, raised, part.vertices)),))


def test_a_skinned_model_is_posed_as_the_first_frame_shows_it_and_its_joints_move_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"RATES": (0.06,), "FINISHED": 20, "TRACKED": 20, "TRUED": 5}.items():
        monkeypatch.setattr(skeleton_motion, name, value)
    finer = revise(SMALL, {"asset.size": 48, "asset.points": 1200, "asset.fit_points": 1200})
    angles = np.array([1.3, 1.1, 0.9])
    frames = torch.stack([render(bent_arm(angle), 0.0) for angle in angles])
    write_png(tmp_path / "subject.png", frames[0])
    path = zipped(tmp_path, model_glb=arm_glb())
    prepare = job_of("prepare_asset", tmp_path / "prepare", {"model": path, "subject": tmp_path / "subject.png"}, finer)
    report = prepare_asset.run(prepare)
    placement = read_placement(prepare.outputs["placement"])
    assert placement.posed and placement.agreement > 0.8
    assert prepare_asset.POSE_NOTE in report.notes
    write_frames(tmp_path / "video", DrivingVideo(frames[..., :3], frames[..., 3:], 10.0))
    inputs = {name: prepare.outputs[name] for name in ("gaussians", "glb", "placement")}
    animate = job_of("animate_asset", tmp_path / "animate", {**inputs, "driving_video": tmp_path / "video"}, finer)
    notes = animate_asset.run(animate).notes
    assert animate_asset.JOINT_NOTE in notes
    moving = read_foreign_glb(animate.outputs["moving"].read_bytes(), 1000)
    assert "skins" in moving.reader.tree
    tracked = read_tracked(animate.outputs["tracked"])
    moved = tracked.mesh.vertices + tracked.offsets
    tips = moved[:, (tracked.mesh.vertices[:, 0] == tracked.mesh.vertices[:, 0].max())].mean(1)
    height = (tips[:, 1] - moved[:, :, 1].mean(1)) / placement.scale
    expected = np.stack([bent_arm(angle).vertices for angle in angles])
    right = bent_arm(0.0).vertices[:, 0] > UPPER - 1e-4
    assert height.tolist() == pytest.approx((expected[:, right, 1].mean(1) - expected[..., 1].mean(1)), abs=0.08)


def test_splats_stay_splats(tmp_path: Path) -> None:
    cloud = cover_surface(fish(), 500, torch.Generator().manual_seed(0)).cloud
    write_ply(tmp_path / "a.ply", cloud)
    path = zipped(tmp_path, model_ply=(tmp_path / "a.ply").read_bytes())
    job = job_of("prepare_asset", tmp_path / "prepare", {"model": path})
    prepare_asset.run(job)
    assert not job.outputs["glb"].exists()
    placed = read_ply(job.outputs["gaussians"])
    torch.testing.assert_close(placed.harmonics, cloud.harmonics)
    scale = read_placement(job.outputs["placement"]).scale
    torch.testing.assert_close(placed.scales, scale * cloud.scales)


def test_more_splats_than_allowed_are_merged_and_all_move(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", cover_surface(fish(), 900, torch.Generator().manual_seed(0)).cloud)
    path = zipped(tmp_path, model_ply=(tmp_path / "a.ply").read_bytes())
    few = revise(SMALL, {"asset.max_splats": 500, "asset.fit_points": 200})
    job = job_of("prepare_asset", tmp_path / "prepare", {"model": path}, few)
    report = prepare_asset.run(job)
    assert any("900 splats were merged to 500" in note for note in report.notes)
    placed = read_ply(job.outputs["gaussians"])
    assert len(placed) == 500
    subject = read_png(job.outputs["subject"])
    color, alpha = subject[..., :3], subject[..., 3:]
    shifted = torch.stack([color, color.roll(3, 1)]), torch.stack([alpha, alpha.roll(3, 1)])
    write_frames(tmp_path / "video.zip", DrivingVideo(*shifted, 8.0))
    inputs = {"gaussians": job.outputs["gaussians"], "driving_video": tmp_path / "video.zip"}
    moved = job_of("animate_asset", tmp_path / "animate", inputs, few)
    animate_asset.run(moved)
    shift = read_motion(moved.outputs["motion"]).deformation.displace(placed.means, torch.tensor([1.0])).means[0]
    assert shift.shape == (500, 3)
    assert (shift[:, 0] > 0.02).all()


@pytest.mark.parametrize("kind", ["png", "webp", "jpeg"])
def test_textures_beside_a_gltf_are_embedded_as_their_content_is(kind: str, tmp_path: Path) -> None:
    Image.new("RGB", (4, 4)).save(tmp_path / "paint", kind)
    document = GltfDocument({})
    document.add("images", uri="paint")
    (tmp_path / "model.gltf").write_text(json.dumps(document.tree))
    reader = GlbReader(embed_files(tmp_path / "model.gltf"))
    (image,) = reader.tree["images"]
    assert image["mimeType"] == f"image/{kind}"
    assert bytes(reader.view(image["bufferView"])) == (tmp_path / "paint").read_bytes()


REFUSED = {
    "no faces": ({"model_obj": b"v 0 0 0\nv 1 0 0\n"}, "no faces"),
    "nan": ({"model_obj": b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"}, "not finite"),
    "flat": ({"model_obj": b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"}, "no area"),
    "missing texture": (
        {"model_obj": b"mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n",
         "a_mtl": b"newmtl m\nmap_Kd paint.png\n"},
        r"texture 'paint\.png' of the model is missing",
    ),
    "missing buffer": ({"model_gltf": json.dumps(
        {"asset": {"version": "2.0"}, "buffers": [{"uri": "a.bin", "byteLength": 4}]}).encode()}, "buffer .* missing"),
    "no json": ({"model_gltf": b"{"}, r"not a glTF 2\.0 file \(Expecting"),
    "no object": ({"model_gltf": b"[]"}, r"not a glTF 2\.0 file \(its JSON is not an object"),
    "no glb": ({"model_glb": b"{}"}, r"not a GLB 2\.0 file \(it starts with"),
    "splats without color": (
        {"model_ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nend_header\n"},
        "no splat colors",
    ),
    "no gzip": ({"model_spz": b"\x1f\x8bnothing"}, "SPZ is broken"),
    "no usdz": ({"model_usdz": b"PK nothing"}, "USDZ is broken"),
    "two models": ({"model_obj": b"", "model_ply": b""}, "must be one of"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_unusable_models_get_a_sentence(case: str, tmp_path: Path) -> None:
    files, sentence = REFUSED[case]
    job = job_of("prepare_asset", tmp_path / "out", {"model": zipped(tmp_path, **files)})
    with pytest.raises(BadInput, match=sentence):
        prepare_asset.run(job)


def test_a_zip_bomb_as_usdz_is_refused_before_it_grows(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "bomb", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.usdc", bytes(10**7))
    path = zipped(tmp_path, model_usdz=(tmp_path / "bomb").read_bytes())
    with pytest.raises(BadInput, match="compressed entries"):
        prepare_asset.run(job_of("prepare_asset", tmp_path / "out", {"model": path}))
    assert sys.getsizeof(path.read_bytes()) < 10**6


def test_too_many_triangles_of_an_obj_are_refused(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "f 1 2 3\n" * 101
    settings = revise(SMALL, {"asset.max_faces": 100})
    path = zipped(tmp_path, model_obj=text.encode())
    with pytest.raises(BadInput, match=r"more than 100 triangles.*asset\.max_faces"):
        prepare_asset.run(job_of("prepare_asset", tmp_path / "out", {"model": path}, settings))


def test_an_obj_after_a_byte_order_mark_has_its_materials_and_what_is_missing_is_noted(tmp_path: Path) -> None:
    text = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl A\nf 1 2 3\nusemtl B\nf 3 2 1\n"
    materials = "newmtl A\nKd 1 0 0\n"
    path = zipped(tmp_path, model_obj=text.encode("utf-8-sig"), a_mtl=materials.encode("utf-8-sig"))
    (tmp_path / "scratch").mkdir()
    own = read_model(path, tmp_path / "scratch", SMALL.asset, 1.0)
    assert own.glb is not None and own.glb.model.parts[0].factor == (1, 0, 0)
    assert own.notes == ("no color was found for the materials 'B'",)
