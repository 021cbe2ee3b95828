from pathlib import Path

import pytest
from fake_steps import PNG, bank_json, picture
from PIL import Image

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.rasterizer import backends
from flows.inputs.conversion_job import MESH_STEPS, SHAPE_STEPS, ConversionJob, ConversionRequest, name_from_text
from flows.stages import planned_steps
from steps.profiles import PREVIEW, revise
from steps.store.artifact_store import ArtifactStore


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    return ArtifactStore(tmp_path / "store")


@pytest.fixture(autouse=True)
def code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_CODE_VERSION", "test")


def request(
    path: Path | None, video: Path | None = None, bank: Path | None = None, asset: Path | None = None, **changes: object
) -> ConversionRequest:
    settings = revise(PREVIEW, dict(changes))
    return ConversionRequest(item="x", picture=path, video=video, bank=bank, asset=asset, settings=settings)


def job(request: ConversionRequest, store: ArtifactStore) -> ConversionJob:
    request.check()
    return request.to_job(store)


def frames(folder: Path, count: int) -> Path:
    folder.mkdir(exist_ok=True)
    for i in range(count):
        (folder / f"{i:03d}.png").write_text(picture(i))
    (folder / "notes.txt").write_text("not a frame")
    return folder


def test_names_do_not_count_but_content_settings_and_seed_do(tmp_path: Path, store: ArtifactStore) -> None:
    (tmp_path / "a.png").write_text(picture("picture"))
    (tmp_path / "b.png").write_text(picture("picture"))
    (tmp_path / "c.png").write_text(picture("another"))
    first = job(request(tmp_path / "a.png"), store)
    assert job(request(tmp_path / "b.png"), store).digest() == first.digest()
    assert first.model_copy(update={"item": "y", "profile": "p"}).digest() == first.digest()
    others = [
        job(request(tmp_path / "c.png"), store),
        job(request(tmp_path / "a.png", **{"mesh.grid": 64}), store),
        first.model_copy(update={"seed": 1}),
        first.model_copy(update={"moving": True}),
    ]
    assert len({first.digest(), *(other.digest() for other in others)}) == 5


def test_other_code_is_another_order(tmp_path: Path, store: ArtifactStore, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.png").write_text(picture("picture"))
    one = job(request(tmp_path / "a.png"), store)
    before = one.digest()
    monkeypatch.setenv("DG4D_CODE_VERSION", "other")
    assert one.digest() != before


def test_another_backend_is_another_order(
    tmp_path: Path, store: ArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.png").write_text(picture("picture"))
    digests = []
    for lack in ("no GPU", ""):
        monkeypatch.setattr(backends, "gsplat_unavailable_reason", lambda lack=lack: lack)
        digests.append(job(request(tmp_path / "a.png"), store).digest())
    assert digests[0] != digests[1]


def test_a_rasterizer_that_cannot_run_is_refused_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text(picture("picture"))
    with pytest.raises(BadInput, match="rasterizer = 'gpu'"):
        request(tmp_path / "a.png", rasterizer="gpu")
    gsplat = request(tmp_path / "a.png", rasterizer="cuda_gsplat")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(backends, "gsplat_unavailable_reason", lambda: "no GPU")
        with pytest.raises(BackendUnavailable, match="no GPU; or choose rasterizer=cpu"):
            gsplat.check()
        patch.setattr(backends, "gsplat_unavailable_reason", str)
        gsplat.check()


def test_a_folder_of_frames_is_a_video_and_equal_frames_are_equal_sources(tmp_path: Path, store: ArtifactStore) -> None:
    (tmp_path / "a.png").write_text(picture("picture"))
    one = job(request(tmp_path / "a.png", frames(tmp_path / "one", 3)), store)
    two = job(request(tmp_path / "a.png", frames(tmp_path / "two", 3)), store)
    assert one.source == two.source
    assert one.moving
    assert (one.source_name, one.picture_name) == ("one", "a.png")
    assert job(request(tmp_path / "a.png", frames(tmp_path / "one", 4)), store).source != one.source
    alone = job(request(None, tmp_path / "two"), store)
    assert (alone.source, alone.source_name, alone.picture_name) == (two.source, "two", "")


@pytest.mark.parametrize(("name", "moving"), [("a.mp4", True), ("a.WEBM", True), ("a.gif", False), ("a.png", False)])
def test_a_video_can_be_the_main_argument(tmp_path: Path, store: ArtifactStore, name: str, moving: bool) -> None:
    (tmp_path / name).write_text(picture("x"))
    assert job(request(tmp_path / name), store).moving == moving


def test_what_cannot_work_is_refused_before_any_work(tmp_path: Path) -> None:
    good = tmp_path / "good.png"
    good.write_text(picture("x"))
    (tmp_path / "empty.png").touch()
    bank = frames(tmp_path / "bank", 1)
    cases = {
        "does not exist": request(tmp_path / "none.png"),
        "is a folder; give one file": request(tmp_path),
        "empty": request(tmp_path / "empty.png"),
        "does not exist;": request(good, tmp_path / "none.mp4"),
        "holds 1 picture;": request(good, frames(tmp_path / "single", 1)),
        "holds no pictures;": request(good, frames(tmp_path / "bare", 0)),
        "needs ground-truth views": request(good, **{"prior.kind": "oracle"}),
        r"no file bank\.json": request(good, bank=bank, **{"prior.kind": "oracle"}),
    }
    for says, bad in cases.items():
        with pytest.raises(BadInput, match=says):
            bad.check()
    (bank / "bank.json").write_text(bank_json("000.png"))
    (bank / "000.png").write_bytes(PNG)
    request(good, bank=bank, **{"prior.kind": "oracle"}).check()
    with pytest.raises(BadInput, match=r"prior\.kind=oracle"):
        request(good, bank=bank).check()


def test_settings_of_a_fitted_shape_have_no_effect_on_a_model(tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(b"glTF")
    (tmp_path / "a.spz").write_bytes(b"NGSP")
    (tmp_path / "scan.ply").write_bytes(b"ply\nelement vertex 3\nelement face 0\nend_header\n")
    (tmp_path / "mesh.ply").write_bytes(b"ply\nelement vertex 3\nelement face 1\nend_header\n")
    changes = {
        "static.iterations": 9, "static.views": 2, "mesh.max_faces": 999, "mesh.texture_size": 512,
        "asset.nodes": 50, "pack.fps": 12, "subject.size": 128, "driving.motion": "wave",
    }  # fmt: skip
    for name in ("a.glb", "mesh.ply"):
        (mesh,) = request(None, asset=tmp_path / name, **changes).unused()
        assert mesh == f"settings without an effect: static.*, mesh.max_faces; {name} keeps its own shape"
    for name in ("a.spz", "scan.ply"):
        (splats,) = request(None, asset=tmp_path / name, **changes).unused()
        assert splats == f"settings without an effect: static.*; {name} keeps its own shape"
    assert request(None, asset=tmp_path / "a.glb").unused() == []


def test_no_step_of_an_own_model_is_left_out(tmp_path: Path, store: ArtifactStore) -> None:
    model = tmp_path / "a.glb"
    model.write_bytes(b"glTF")
    planned = planned_steps(job(request(None, asset=model), store))
    assert not set(planned) & (SHAPE_STEPS | MESH_STEPS)


def test_what_has_no_effect_is_named(tmp_path: Path) -> None:
    for name in ("a.png", "a.mp4"):
        (tmp_path / name).write_text(picture("x"))
    image, video = tmp_path / "a.png", tmp_path / "a.mp4"
    driven = {"driving.motion": "wave"}
    assert request(image, **driven).unused() == request(video).unused() == []
    (motion,) = request(video, **driven).unused()
    assert "driving.* settings" in motion and "a.mp4" in motion
    assert request(image, video).unused() == ["a.png only names the asset: the subject is that of a.mp4"]


def test_a_mesh_per_frame_is_not_resampled_but_a_given_model_is(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text(picture("x"))
    faster = request(tmp_path / "a.png", **{"mesh.mode": "per_frame", "pack.fps": 24.0})
    with pytest.raises(BadInput, match=r"pack\.fps=24 .* --set mesh\.mode=tracked"):
        faster.check()
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    faster.model_copy(update={"asset": tmp_path / "a.obj"}).check()


def test_a_depth_picture_that_is_missing_is_no_video(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text(picture("x"))
    with pytest.raises(BadInput, match="does not exist; give one gray picture"):
        request(tmp_path / "a.png").model_copy(update={"depth": tmp_path / "d.png"}).check()


TEXT = {"text.weights": "somebody/pictures"}


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of all weights, with one set in it."""
    monkeypatch.setenv("DG4D_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    return pipeline(tmp_path / "weights" / "somebody--pictures").parent


def pipeline(folder: Path) -> Path:
    (folder / "unet").mkdir(parents=True)
    (folder / "unet" / "model.safetensors").write_bytes(b"tensors")
    return folder


def words(text: str, **changes: object) -> ConversionRequest:
    return ConversionRequest(item="x", text=text, settings=revise(PREVIEW, {**TEXT, **changes}))


def test_words_are_a_source_whatever_the_spaces_between_them(weights: Path, store: ArtifactStore) -> None:
    one = job(words("a red dragon"), store)
    assert one.generates_picture
    assert not one.moving
    assert one.source_name == '"a red dragon"'
    assert job(words(" a  red\ndragon "), store).digest() == one.digest()
    assert job(words("a red newt"), store).digest() != one.digest()
    assert job(words("a red dragon", **{"text.num_inference_steps": 3}), store).digest() != one.digest()


def test_a_file_that_holds_the_same_words_is_another_order(weights: Path, tmp_path: Path, store: ArtifactStore) -> None:
    (tmp_path / "a.png").write_text("#?RADIANCE dragon")
    assert job(request(tmp_path / "a.png", **TEXT), store).digest() != job(words("#?RADIANCE dragon"), store).digest()


def test_words_that_cannot_work_are_refused_before_any_work(weights: Path, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text(picture("x"))
    cases = {
        "--text is empty": words(" "),
        "has 1001 characters": words("x" * 1001),
        "not both": words("a newt").model_copy(update={"picture": tmp_path / "a.png"}),
        "--set text.weights": words("a newt", **{"text.weights": ""}),
        "nothing to make": ConversionRequest(item="x", settings=PREVIEW),
    }
    for says, bad in cases.items():
        with pytest.raises(BadInput, match=says):
            bad.check()
    with pytest.raises(BackendUnavailable, match="`dg4d weights pull other/pictures`"):
        words("a newt", **{"text.weights": "other/pictures"}).check()


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("A red dragon!", "a-red-dragon"),
        ("../../etc/passwd", "etc-passwd"),
        ("Grüne Äpfel, 3", "grüne-äpfel-3"),
        ("...", "asset"),
        ("word " * 40, "-".join(["word"] * 12)),
    ],
)
def test_words_name_the_asset(text: str, name: str) -> None:
    assert name_from_text(text) == name


def test_other_weights_are_another_order_and_their_place_does_not_count(
    weights: Path, tmp_path: Path, store: ArtifactStore
) -> None:
    one, two = pipeline(tmp_path / "one" / "mine"), pipeline(tmp_path / "two" / "mine")
    first = job(words("a newt", **{"text.weights": str(one)}), store)
    second = job(words("a newt", **{"text.weights": str(two)}), store)
    assert first.digest() == second.digest()
    assert str(tmp_path) not in first.model_dump_json()
    (two / "unet" / "model.safetensors").write_bytes(b"changed")
    assert job(words("a newt", **{"text.weights": str(two)}), store).digest() != first.digest()
    named = job(words("a newt"), store).digest()
    (weights / "somebody--pictures" / "unet" / "model.safetensors").write_bytes(b"changed")
    assert job(words("a newt"), store).digest() != named


def test_weights_that_no_step_will_load_need_not_be_here(weights: Path, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text(picture("x"))
    (tmp_path / "a.mp4").write_text(picture("x"))
    still, second = (Image.new("L", (8, 8), value) for value in (0, 255))
    still.save(tmp_path / "still.gif")
    still.save(tmp_path / "moving.gif", save_all=True, append_images=[second])
    (tmp_path / "cut.gif").write_bytes((tmp_path / "moving.gif").read_bytes()[:-8])
    animated = {"driving.kind": "svd"}
    request(tmp_path / "a.png", **{"text.weights": "not/here"}).check()
    request(tmp_path / "a.mp4", **animated).check()
    request(tmp_path / "moving.gif", **animated).check()
    request(tmp_path / "a.png", video=tmp_path / "a.mp4", **animated).check()
    for name in ("a.png", "still.gif", "cut.gif"):
        with pytest.raises(BackendUnavailable, match="`dg4d weights pull svd`"):
            request(tmp_path / name, **animated).check()


def test_only_weights_that_allow_commercial_use_pass_where_that_is_asked_for(weights: Path, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text(picture("x"))

    def strict(**changes: object) -> ConversionRequest:
        return request(tmp_path / "a.png", **changes).model_copy(update={"commercial_only": True})

    strict().check_licenses()
    strict(**{"driving.kind": "svd"}).check_licenses()
    Image.new("L", (8, 8)).save(tmp_path / "still.gif")
    drives = request(tmp_path / "still.gif", **{"driving.kind": "svd", "driving.model.weights": "somebody/pictures"})
    with pytest.raises(BadInput, match="somebody/pictures"):
        drives.model_copy(update={"commercial_only": True}).check_licenses()
    with pytest.raises(BadInput, match=r"--commercial-only: .* zero123-xl \("):
        strict(**{"prior.kind": "zero123"}).check_licenses()
    with pytest.raises(BadInput, match=r"stable-zero123 .*non-commercial"):
        strict(**{"prior.kind": "zero123", "prior.weights": "stable-zero123", "prior.variant": "stable"}).check()
    with pytest.raises(BadInput, match="somebody/pictures"):
        words("a newt").model_copy(update={"commercial_only": True}).check()


def test_whether_licenses_mattered_is_part_of_the_order(tmp_path: Path, store: ArtifactStore) -> None:
    (tmp_path / "a.png").write_text(picture("x"))
    free = request(tmp_path / "a.png")
    strict = free.model_copy(update={"commercial_only": True})
    assert job(strict, store).commercial_only
    assert job(strict, store).digest() != job(free, store).digest()
