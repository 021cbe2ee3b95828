import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "dg4d_lib" / "visual_hull"))
from creatures import creature, seen

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.input_settings import SubjectSettings
from dg4d_lib.metrics.image import iou
from dg4d_lib.settings import GeometricPriorSettings
from dg4d_lib.visual_hull.known import KnownView
from steps.artifacts.media import read_png, write_png, write_zip
from steps.fitting.priors import known_views, read_bank, subject_shapes
from steps.prepare_subject import run as prepare_subject
from steps.prepare_views import run
from steps.profiles import PREVIEW, step_settings
from steps.runtime.job import Job, StepReport
from steps.sources.views import VIEWS_JSON, GivenView, GivenViews, PlacedCamera

SIZE = 96


class Workplace:
    """A folder with a prepared input, a picture or frames, to which views are added."""

    def __init__(
        self, folder: Path, front: KnownView | bytes, mask: Path | None = None, box: tuple[int, ...] = ()
    ) -> None:
        self.folder, self.box = folder, box
        self.files = {"source": folder / "front"} | ({"mask": mask} if mask else {})
        self.files["source"].write_bytes(front if isinstance(front, bytes) else png(front, folder))
        outputs = {port: folder / f"{port}.out" for port in ("footage", "pose")}
        outputs |= {port: folder / f"{port}.png" for port in ("subject", "picture")}
        prepare_subject(Job(self.files, outputs, self.settings("prepare_subject"), 0, print, folder))
        if outputs["footage"].exists():
            self.files["footage"] = outputs["footage"]

    def settings(self, step: str) -> object:
        subject = SubjectSettings(size=SIZE, box=self.box)
        return step_settings(step, PREVIEW.model_copy(update={"subject": subject}))

    def prepare(self, given: GivenViews, files: dict[str, bytes]) -> StepReport:
        write_zip(self.folder / "views.zip", [(VIEWS_JSON, given.model_dump_json().encode()), *files.items()])
        inputs = {**self.files, "views": self.folder / "views.zip", "subject": self.folder / "subject.png"}
        outputs = {"known_views": self.folder / "known.zip", "picture": self.folder / "views_picture.png"}
        for name in ("seen", "bank"):
            (self.folder / name).mkdir(exist_ok=True)
        return run(Job(inputs, outputs, self.settings("prepare_views"), 0, lambda *_: None, self.folder / "seen"))

    def known(self) -> list[KnownView]:
        return known_views(read_bank(self.folder / "known.zip", self.folder / "bank"))


def png(view: KnownView, folder: Path) -> bytes:
    write_png(folder / "view.png", view.cutout)
    return (folder / "view.png").read_bytes()


def sides(
    folder: Path, *azimuths: float, subject: InflatedSurface | None = None
) -> tuple[GivenViews, dict[str, bytes]]:
    files = {f"{i:03d}": png(seen(subject or creature(), azimuth), folder) for i, azimuth in enumerate(azimuths)}
    views = [GivenView(file=f, name=f"{a:g}.png", azimuth=a) for f, a in zip(files, azimuths, strict=True)]
    return GivenViews(views=tuple(views)), files


def test_pictures_become_a_bank_that_replaces_the_guess(tmp_path):
    place = Workplace(tmp_path, seen(creature(), 0))
    report = place.prepare(*sides(tmp_path, 90, 180, 270))
    known = place.known()
    assert [view.camera.azimuth_deg for view in known] == [90, 180, 270] and report.notes == ()
    assert torch.allclose(known[0].cutout[..., 3], seen(creature(), 90).cutout[..., 3], atol=0.01)
    bank = read_bank(tmp_path / "known.zip", tmp_path / "seen")
    subject = read_png(tmp_path / "subject.png")
    truth = seen(creature(), 45).cutout[None, ..., 3:]
    overlaps = [
        float(
            iou(
                seen(subject_shapes(GeometricPriorSettings(), [subject], sides=b).surface(0), 45).cutout[None, ..., 3:],
                truth,
            )
        )
        for b in (None, bank)
    ]
    assert overlaps[0] < 0.4
    assert overlaps[1] > 0.75


def test_the_views_and_their_hull_are_shown(tmp_path):
    place = Workplace(tmp_path, seen(creature(), 0))
    place.prepare(*sides(tmp_path, 90))
    assert read_png(tmp_path / "views_picture.png").shape == (2 * 96, 2 * 96, 3)


def test_a_view_of_something_else_is_refused_by_name_with_the_picture(tmp_path):
    other = creature()
    wide = InflatedSurface(other.vertices * torch.tensor([1.6, 0.3, 0.6]), *list(vars(other).values())[1:])
    given, files = sides(tmp_path, 90, 180, 270)
    files["001"] = png(seen(wide, 180), tmp_path)
    place = Workplace(tmp_path, seen(creature(), 0))
    with pytest.raises(BadInput, match=r"180\.png \(azimuth 180, elevation 0\) contradicts the others"):
        place.prepare(given, files)
    assert (tmp_path / "seen" / "views.png").is_file()


def clip(folder: Path, azimuths: list[float], exposure: float = 1.0) -> bytes:
    """Return a zip of frames from these azimuths."""
    views = [seen(creature(), azimuth) for azimuth in azimuths]
    dimmed = [replace(v, cutout=v.cutout * torch.tensor([exposure] * 3 + [1])) for v in views]
    frames = [(f"{i:03d}.png", png(view, folder)) for i, view in enumerate(dimmed)]
    write_zip(folder / "frames.zip", frames)
    return (folder / "frames.zip").read_bytes()


@pytest.mark.parametrize("sign", [1, pytest.param(-1, marks=pytest.mark.slow)])
def test_a_turntable_of_either_direction_is_placed_around_the_subject(sign, tmp_path):
    place = Workplace(tmp_path, seen(creature(), 0))
    place.prepare(GivenViews(turntable="turn"), {"turn": clip(tmp_path, [sign * 36.0 * i for i in range(10)])})
    known = place.known()
    assert [round(view.camera.azimuth_deg) % 360 for view in known] == [
        round(sign * 36 * i) % 360 for i in range(1, 10)
    ]


@pytest.mark.parametrize(
    ("azimuths", "refusal"),
    [
        ([0.0] * 9, "--turntable shows no turn"),
        (
            [0.0, 90, 180, 270],
            "--turntable has 4 frames; give a video, or a folder of frames, of one whole turn with 8 or more",
        ),
        ([4.0 * i for i in range(12)], "--turntable is not a whole turn"),
    ],
)
def test_a_turntable_that_is_no_turn_is_refused(azimuths, refusal, tmp_path):
    place = Workplace(tmp_path, seen(creature(), 0))
    with pytest.raises(BadInput, match=refusal):
        place.prepare(GivenViews(turntable="turn"), {"turn": clip(tmp_path, azimuths)})


def placed(azimuth: float, elevation: float = 0.0) -> PlacedCamera:
    matrix = OrbitCamera(elevation, azimuth).viewmat().inverse()[:3] @ torch.diag(
        torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)
    )
    return PlacedCamera(matrix=[tuple(row) for row in matrix.tolist()], focal=OrbitCamera().focal / 256)


def on_pedestal(view: KnownView) -> KnownView:
    """Return the view with a block at the lower edge."""
    cutout = view.cutout.clone()
    cutout[-8:-1, SIZE // 3 : 2 * SIZE // 3] = torch.tensor([0.3, 0.3, 0.8, 1])
    return replace(view, cutout=cutout)


@pytest.mark.parametrize("excluded_by", ["", "mask", "box"])
def test_pictures_of_known_cameras_are_placed_by_them(excluded_by, tmp_path):
    front = seen(creature(), 0)
    mask = tmp_path / "mask.png" if excluded_by == "mask" else None
    write_png(tmp_path / "mask.png", front.cutout[..., 3:].expand(-1, -1, 3))
    box = (0, 0, SIZE, SIZE - 8) if excluded_by == "box" else ()
    place = Workplace(tmp_path, on_pedestal(front) if excluded_by else front, mask, box)
    files = {"000": png(seen(creature(), 75, 20), tmp_path), "001": png(seen(creature(), 200), tmp_path)}
    cameras = [placed(75, 20), placed(200)]
    views = [GivenView(file=f, name=f, camera=c) for f, c in zip(files, cameras, strict=True)]
    place.prepare(GivenViews(views=tuple(views), input_camera=placed(0)), files)
    for view, (azimuth, elevation) in zip(place.known(), [(75, 20), (-160, 0)], strict=True):
        assert (view.camera.azimuth_deg, view.camera.elevation_deg) == pytest.approx((azimuth, elevation), abs=1e-3)
        truth = seen(creature(), azimuth, elevation).cutout
        assert float(iou(view.cutout[None, ..., 3:], truth[None, ..., 3:])) > 0.95


def far(view: KnownView, margin: int) -> KnownView:
    """Return the view in the middle of a larger picture."""
    return replace(view, cutout=torch.nn.functional.pad(view.cutout, (0, 0, *[margin] * 4)))


def test_pictures_of_known_cameras_may_show_the_subject_small(tmp_path):
    found = []
    for margin in (100, 500):
        folder = tmp_path / str(margin)
        folder.mkdir()
        place = Workplace(folder, far(seen(creature(), 0), margin))
        files = {"000": png(far(seen(creature(), 75, 20), margin), folder)}
        focal = SIZE / (SIZE + 2 * margin)
        cameras = [placed(*each).model_copy(update={"focal": placed(0).focal * focal}) for each in ((0,), (75, 20))]
        place.prepare(
            GivenViews(views=(GivenView(file="000", name="side", camera=cameras[1]),), input_camera=cameras[0]), files
        )
        found.append(place.known()[0].cutout)
    small, smaller = ((cutout[None, ..., 3:]) for cutout in found)
    assert float(iou(small, smaller)) > 0.99
    assert (found[0] - found[1]).abs().mean() < 0.01


@pytest.mark.parametrize("turned", ["the input", "side.png"])
def test_a_picture_of_another_shape_than_its_camera_is_refused(turned, tmp_path):
    place = Workplace(tmp_path, seen(creature(), 0))
    files = {"000": png(seen(creature(), 75), tmp_path)}
    sizes = [(960, 640) if turned == name else (2 * SIZE, 2 * SIZE) for name in ("the input", "side.png")]
    own, side = (placed(at).model_copy(update={"size": size}) for at, size in zip((0, 75), sizes, strict=True))
    given = GivenViews(views=(GivenView(file="000", name="side.png", camera=side),), input_camera=own)
    with pytest.raises(BadInput, match=rf"{turned} is {SIZE} x {SIZE} pixels, its camera 960 x 640: .*EXIF"):
        place.prepare(given, files)


def test_synchronized_videos_get_the_exposure_of_the_input_in_all_frames(tmp_path):
    place = Workplace(tmp_path, clip(tmp_path, [0.0] * 2))
    views = tuple(GivenView(file=f, name=f, camera=placed(a)) for f, a in (("00", 75), ("01", 200)))
    files = {"00": clip(tmp_path, [75.0] * 2, 0.5), "01": clip(tmp_path, [200.0] * 2, 0.5)}
    report = place.prepare(GivenViews(views=views, input_camera=placed(0)), files)
    assert report.notes == (
        "exposure adjusted to the input: 00 (azimuth 75, elevation 0), 01 (azimuth -160, elevation 0)",
    )
    bank = read_bank(tmp_path / "known.zip", tmp_path / "bank")
    for frame in (0, 1):
        for view, azimuth in zip(known_views(bank, frame), (75, 200), strict=True):
            mean, expected = (
                each[each[..., 3] > 0.9][:, :3].mean() for each in (view.cutout, seen(creature(), azimuth).cutout)
            )
            assert float(mean) == pytest.approx(float(expected), rel=0.05)  # half of it before


def test_synchronized_videos_have_as_many_frames_as_the_input_before_any_are_left_out(tmp_path):
    place = Workplace(tmp_path, clip(tmp_path, [0.0] * 3))
    views = tuple(GivenView(file=f, name=f, camera=placed(a)) for f, a in (("00", 75), ("01", 200)))
    given = GivenViews(views=views, input_camera=placed(0))
    place.prepare(given, {"00": clip(tmp_path, [75.0] * 3), "01": clip(tmp_path, [200.0] * 3)})
    with pytest.raises(BadInput, match="01 has 6 frames and the input 3;"):
        place.prepare(given, {"00": clip(tmp_path, [75.0] * 3), "01": clip(tmp_path, [200.0] * 6)})


def test_a_video_among_pictures_is_refused(tmp_path):
    place = Workplace(tmp_path, seen(creature(), 0))
    given, files = sides(tmp_path, 90)
    files["000"] = clip(tmp_path, [0.0, 90])
    with pytest.raises(BadInput, match="is a video; --view takes pictures"):
        place.prepare(given, files)


def test_a_bundle_that_names_a_missing_file_is_refused(tmp_path):
    place = Workplace(tmp_path, seen(creature(), 0))
    given, _ = sides(tmp_path, 90)
    with pytest.raises(BadInput, match="which is not among the views"):
        place.prepare(given, {})
    assert json.loads(given.model_dump_json())["views"][0]["file"] == "000"
