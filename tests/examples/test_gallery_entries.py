"""Gallery: its pictures are those that the code draws, and the page names what is there."""

import re
import sys
from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image

from examples import make_examples
from examples.gallery import creatures, make_gallery, things
from examples.gallery.figures import Figure, Part, both_sides, box, disk, left_right, ring
from examples.gallery.make_gallery import ENTRIES, FOLDER, PAGE, page, read_results
from examples.gallery.pictures import octopus
from examples.shapes import Field, ellipsoid
from flows.inputs.manifest import parse_changes
from steps.profiles import profile, revise

MOST_OF_ALL = 2_500_000  # bytes in the repository
BALL = ellipsoid((0, 0, 0), (0.3, 0.3, 0.3))


def test_the_page_is_the_one_that_the_figures_give() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(read_results())
    assert set(read_results()) == {entry.name for entry in ENTRIES} and len(ENTRIES) == 10


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.name)
def test_every_entry_has_a_picture_a_film_and_a_command_that_works(entry) -> None:
    picture, film = FOLDER / entry.picture, FOLDER / f"{entry.name}_film.webp"
    assert picture.stat().st_size <= 40_000 and film.stat().st_size <= 150_000
    with Image.open(picture) as still, Image.open(film) as moving:
        assert still.size == (512, 512) and getattr(moving, "n_frames", 1) > 20
    revise(profile("preview"), parse_changes(list(entry.changes)))
    assert entry.picture in entry.command


@pytest.mark.parametrize(
    ("program", "arguments", "code", "says"),
    [
        (make_gallery.main, ["--help"], 0, "elephant, robot"),
        (make_gallery.main, ["elefant"], 2, "unknown: elefant; choose from elephant"),
        (make_examples.main, ["--help"], 0, "Make every file of this folder again"),
    ],
)
def test_help_and_wrong_names_make_nothing(
    program: Callable[..., None], arguments: list[str], code: int, says: str,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    def forbidden(*_: object) -> None:
        raise AssertionError("something was made")

    monkeypatch.setattr(make_gallery, "make_entry", forbidden)
    monkeypatch.setattr(make_gallery, "PAGE", None)
    monkeypatch.setattr(make_examples, "write_png", forbidden)
    monkeypatch.setattr(sys, "argv", ["program", *arguments])
    with pytest.raises(SystemExit) as ended:
        program(*([arguments] if program is make_gallery.main else []))
    printed = capsys.readouterr()
    assert ended.value.code == code
    assert says in " ".join((printed.out + printed.err).split())


def test_the_gallery_is_small_and_has_no_other_files() -> None:
    linked = set(re.findall(r"\]\(gallery/([^)]+)\)", PAGE.read_text(encoding="utf-8")))
    assert {path.name for path in FOLDER.iterdir()} == linked | {"times.json"}
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) <= MOST_OF_ALL


def test_the_drawing_in_the_repository_is_the_one_that_is_drawn() -> None:
    with Image.open(FOLDER / "octopus.webp") as stored:
        error = np.abs(np.asarray(stored.convert("RGB"), float) - np.asarray(octopus(), float)).mean()
    assert error < 2


@pytest.mark.parametrize(
    ("shape", "point", "distance"),
    [
        (box((0, 0, 0), (0.3, 0.2, 0.1)), (0.5, 0, 0), 0.2),
        (box((0, 0, 0), (0.3, 0.2, 0.1), lean=np.pi / 2), (0.5, 0, 0), 0.3),
        (disk((0, 0, 0), 0.3, 0.1, axis=1), (0, 0.3, 0), 0.2),
        (disk((0, 0, 0), 0.3, 0.1, axis=2), (0.5, 0, 0), 0.2),
        (ring((0, 0, 0), 0.3, 0.1, axis=1), (0.5, 0, 0), 0.1),
        (both_sides(ellipsoid((0, 0, 0.4), (0.1, 0.1, 0.1))), (0, 0, -0.6), 0.1),
        (left_right(ellipsoid((0.4, 0, 0), (0.1, 0.1, 0.1))), (-0.6, 0, 0), 0.1),
    ],
)
def test_distances_of_solids(shape: Field, point: tuple[float, float, float], distance: float) -> None:
    np.testing.assert_allclose(shape(np.array([point])), [distance], atol=1e-9)


def test_a_figure_has_the_paint_of_the_nearest_part_and_its_last_mark() -> None:
    marks = [(lambda p: p[:, 1], (0.0, 1.0, 0.0)), (lambda p: p[:, 0], (0.0, 0.0, 1.0))]
    other = Part(ellipsoid((0.6, 0, 0), (0.1, 0.1, 0.1)), (1.0, 1.0, 0.0))
    figure = Figure([Part(BALL, (1.0, 0.0, 0.0), marks), other])
    points = np.array([(0.2, 0.22, 0), (0.2, -0.22, 0), (-0.2, -0.22, 0), (0.7, 0, 0)])
    expected = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0)]
    np.testing.assert_allclose(figure.color(points, np.zeros((4, 0))), expected, atol=1e-6)


def test_a_turned_figure_shows_its_other_side() -> None:
    figure = Figure([Part(ellipsoid((0.2, 0.1, 0), (0.2, 0.1, 0.1)), (1.0, 0.0, 0.0))], yaw_deg=90)
    middle = (figure.at(0.0).max(0) + figure.at(0.0).min(0)) / 2
    np.testing.assert_allclose(middle, (0, 0.1, -0.2), atol=0.01)


@pytest.mark.parametrize("figure", [creatures.fish, things.rings])
def test_figures_lie_in_their_box(figure) -> None:
    assert np.abs(figure().skin.points).max() < 0.75
