import csv
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from fake_steps import PNG
from tiny_s3 import BUCKET, TinyS3

from dg4d_lib.errors import BackendUnavailable, BadInput, DG4DError
from flows.inputs import sources
from flows.inputs.manifest import Item, items_of, parse_changes
from flows.inputs.models import put_model
from flows.inputs.naming import unique_names
from steps.store.artifact_store import ArtifactStore


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")


def items(inputs: Path | str, out: str = "out", **changes: object) -> list[Item]:
    return items_of(inputs, Path(out), "preview", changes, 3)


def test_a_folder_gives_its_pictures_and_videos_with_their_places(tmp_path: Path) -> None:
    touch(tmp_path, "b.png", "deep/er/c.mp4", "a.JPG", "notes.txt", ".hidden.png", ".git/d.png")
    assert [item.name for item in items(tmp_path)] == ["a", "b", "deep/er/c"]


def test_packages_and_the_output_folder_are_no_inputs(tmp_path: Path) -> None:
    touch(tmp_path, "a.png", "out/a/contact_sheet.png", "made/contact_sheet.png")
    (tmp_path / "made" / "provenance.json").write_text(json.dumps({"files": {}}))
    assert [item.name for item in items(tmp_path, str(tmp_path / "out"))] == ["a"]


def test_no_two_items_share_a_folder_and_none_lies_within_another(tmp_path: Path) -> None:
    touch(tmp_path, "a.png", "A.mp4", "b.png", "b/c.png", "d.png")
    assert [item.name for item in items(tmp_path)] == ["A-mp4", "a-png", "b/c", "b-png", "d"]
    assert unique_names([("x", ""), ("x", ""), ("x-2", "")]) == ["x", "x-2", "x-2-2"]


def test_a_csv_has_a_row_per_item_with_knobs_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text(
        "path,video,name,seed,set,mesh.grid\n"
        "p/cat.png,,,,,\n"
        "p/dog.png,p/run.mp4,hero,7,motion.views=2; pack.splats=false,64\n"
    )
    cat, dog = items(tmp_path / "m.csv", **{"static.iterations": 9})
    assert cat.request is not None
    assert dog.request is not None
    assert (cat.name, cat.request.picture, cat.request.seed, cat.request.video) == (
        "cat",
        tmp_path / "p/cat.png",
        3,
        None,
    )
    assert (dog.name, dog.request.video, dog.request.seed) == ("hero", tmp_path / "p/run.mp4", 7)
    settings = dog.request.settings
    assert (settings.motion.views, settings.pack.splats, settings.mesh.grid) == (2, False, 64)
    assert cat.request.settings.mesh.grid != 64
    assert settings.static.iterations == cat.request.settings.static.iterations == 9


def test_a_json_manifest_says_the_same(tmp_path: Path) -> None:
    rows = [{"path": "p/cat.png", "set": {"mesh.grid": 32}, "name": "../../cat"}]
    (tmp_path / "m.json").write_text(json.dumps(rows))
    (cat,) = items(tmp_path / "m.json")
    assert cat.request is not None
    assert (cat.name, cat.request.picture, cat.request.settings.mesh.grid) == ("cat", tmp_path / "p/cat.png", 32)


def test_columns_name_a_model_a_mask_and_a_box_of_the_subject(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text(
        "path,asset,mask,box\n"
        "run.mp4,models/fox.glb,mask.png,\n"
        ",models/owl.spz,,\n"
        'cat.png,,,"120, 40,300,420"\n'
        "dog.png,,,120x40\n"
    )
    fox, owl, cat, dog = items(tmp_path / "m.csv")
    assert fox.request is not None and owl.request is not None and cat.request is not None
    assert (fox.name, owl.name) == ("run", "owl")
    assert (fox.request.asset, fox.request.mask) == (tmp_path / "models/fox.glb", tmp_path / "mask.png")
    assert (owl.request.picture, owl.request.asset) == (None, tmp_path / "models/owl.spz")
    assert (cat.request.asset, cat.request.settings.subject.box) == (None, (120, 40, 300, 420))
    assert dog.request is None and "row 4: a box is X,Y,W,H" in dog.error


def test_a_row_of_a_manifest_becomes_a_job_with_its_model_and_mask(tmp_path: Path) -> None:
    (tmp_path / "fox.png").write_bytes(PNG)
    (tmp_path / "fox.glb").write_bytes(b"glTF same")
    (tmp_path / "m.json").write_text(json.dumps([{"path": "fox.png", "asset": "fox.glb", "mask": "fox.png"}]))
    (item,) = items(tmp_path / "m.json")
    with item.fetch() as request:
        request.check()
        store = ArtifactStore(tmp_path / "store")
        job = request.to_job(store)
    assert job.asset == put_model(tmp_path / "fox.glb", store)
    assert job.mask == job.source and store.path(job.source).read_bytes() == PNG


def test_columns_name_a_depth_picture_or_layers(tmp_path: Path) -> None:
    (tmp_path / "fox.png").write_bytes(PNG)
    (tmp_path / "m.csv").write_text("path,depth,layers\nfox.png,fox.png,\nfox.png,,fox.png\nfox.png,fox.png,fox.png\n")
    jobs = []
    for item in items(tmp_path / "m.csv"):
        with item.fetch() as request:
            if request.depth and request.layers:
                with pytest.raises(BadInput, match="--depth and --layers cannot be combined"):
                    request.check()
                continue
            request.check()
            jobs.append(request.to_job(ArtifactStore(tmp_path / "store")))
    assert [(job.depth == job.source, job.layers == job.source) for job in jobs] == [(True, False), (False, True)]
    assert {"source", "depth"} == set(jobs[0].given())


def test_a_row_with_a_model_and_views_is_refused(tmp_path: Path) -> None:
    (tmp_path / "fox.png").write_bytes(PNG)
    (tmp_path / "fox.glb").write_bytes(b"glTF same")
    (tmp_path / "m.json").write_text(json.dumps([{"path": "fox.png", "asset": "fox.glb", "views": "180=fox.png"}]))
    (item,) = items(tmp_path / "m.json")
    assert item.request is not None
    with pytest.raises(BadInput, match="give the model, or the pictures, not both"):
        item.request.check()


@pytest.mark.parametrize("suffix", [".csv", ".json"])
def test_words_may_stand_in_place_of_a_path(tmp_path: Path, suffix: str) -> None:
    rows = [
        {"text": "A red, red dragon!", "text.weights": "some/pictures", "seed": "7"},
        {"text": "a RED red dragon", "name": "deep/second"},
        {"text": "a red red dragon"},
        {"path": "a.png"},
    ]
    file = tmp_path / f"m{suffix}"
    if suffix == ".json":
        file.write_text(json.dumps(rows))
    else:
        with file.open("w", newline="") as lines:
            table = csv.DictWriter(lines, ["path", "text", "name", "seed", "text.weights"])
            table.writeheader()
            table.writerows(rows)
    found = items(file)
    assert [item.name for item in found] == ["a-red-red-dragon", "deep/second", "a-red-red-dragon-2", "a"]
    first, _, _, picture = (item.request for item in found)
    assert first is not None and picture is not None
    assert (first.picture, first.text, first.seed) == (None, "A red, red dragon!", 7)
    assert first.settings.text.weights == "some/pictures"
    assert (picture.picture, picture.text) == (tmp_path / "a.png", "")


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ({"text": "a fox"}, "text.weights=FOLDER"),
        ({"text": "a fox", "path": "fox.png", "text.weights": "some/pictures"}, "not both"),
        ({"text": "a fox", "video": "fox.mp4", "text.weights": "some/pictures"}, "not both"),
        ({"text": "  ", "text.weights": "some/pictures"}, "is empty"),
        ({"text": "a fox", "text.weights": "some/pictures"}, "dg4d weights pull some/pictures"),
    ],
)
def test_words_that_nothing_can_be_made_of_are_refused_before_any_work(
    tmp_path: Path, row: dict[str, str], says: str
) -> None:
    touch(tmp_path, "fox.png", "fox.mp4")
    (tmp_path / "m.json").write_text(json.dumps([row]))
    (item,) = items(tmp_path / "m.json")
    assert item.request is not None
    with pytest.raises(DG4DError, match=re.escape(says)):
        item.request.check()


def test_a_bad_row_is_a_bad_item_and_no_more(tmp_path: Path) -> None:
    rows = [
        {"path": "a.png", "mesh.grit": 1},
        {"path": "b.png", "seed": "x"},
        {"path": "c.png"},
        {"path": "d", "seed": -1},
    ]
    (tmp_path / "m.json").write_text(json.dumps(rows))
    found = items(tmp_path / "m.json")
    assert [bool(item.request) for item in found] == [False, False, True, False]
    assert "mesh.grit" in found[0].error


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("m.csv", "file\nx.png\n", "unknown column 'file'"),
        ("m.csv", "path,seed,seed\na.png,1,2\n", "two columns 'seed'"),
        ("m.json", "{", "cannot be read"),
        ("m.json", '{"path": 1}', "list of rows"),
        ("m.jsonl", '{"path": "a.png"\n{', "cannot be read"),
        ("m.parquet", "PAR1", "cannot be read"),
        ("m.txt", "x", "neither a folder nor a manifest"),
        ("m.csv", "path\n", "holds no pictures"),
    ],
)
def test_a_manifest_that_is_wrong_as_a_whole_is_refused(tmp_path: Path, name: str, content: str, says: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(BadInput, match=says):
        items(tmp_path / name)


def test_an_empty_or_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no pictures"):
        items(tmp_path)
    with pytest.raises(BadInput, match="does not exist"):
        items(tmp_path / "nothing")


def test_values_are_json_where_they_can_be_and_kinds_come_first() -> None:
    changes = parse_changes(
        [
            "prior.size=64",
            "deformation.scales=[1, 2]",
            "pack.splats=false",
            "mesh.mode=per_frame",
            "prior.kind=geometric",
        ]
    )
    assert changes == {
        "prior.kind": "geometric", "prior.size": 64, "deformation.scales": [1, 2], "pack.splats": False,
        "mesh.mode": "per_frame",
    }  # fmt: skip
    assert next(iter(changes)) == "prior.kind"
    with pytest.raises(BadInput, match="NAME=VALUE"):
        parse_changes(["motion.iterations"])


@pytest.mark.parametrize("column", ["path", "video", "bank"])
@pytest.mark.parametrize("name", ["../outside.png", "/etc/hostname", "p/link.png", "round", "p/\0.png"])
def test_what_leads_out_of_the_folder_of_a_list_is_a_bad_item(tmp_path: Path, column: str, name: str) -> None:
    touch(tmp_path, "outside.png", "list/p/cat.png")
    (tmp_path / "list/p/link.png").symlink_to(tmp_path / "outside.png")
    (tmp_path / "list/round").symlink_to(tmp_path / "list/round")
    row = {"path": "p/cat.png", column: name, "name": "bad"}
    (tmp_path / "list/m.json").write_text(json.dumps([row, {"path": "p/cat.png", "name": "good"}]))
    bad, good = items(tmp_path / "list/m.json")
    assert (bad.request, good.error) == (None, "")
    assert re.search(f"{column} .* leads out of the folder", bad.error)


def test_a_link_that_leads_out_of_a_folder_is_a_bad_item(tmp_path: Path) -> None:
    touch(tmp_path, "outside.png", "in/a.png")
    (tmp_path / "in/b.png").symlink_to(tmp_path / "outside.png")
    (tmp_path / "in/c.png").symlink_to(tmp_path / "in/a.png")
    assert [(item.name, bool(item.error)) for item in items(tmp_path / "in")] == [
        ("a", False),
        ("b", True),
        ("c", False),
    ]


def test_a_linked_folder_that_leads_out_of_a_folder_is_a_bad_item(tmp_path: Path) -> None:
    touch(tmp_path, "outside/b.png", "in/a.png", "in/deep/c.png", "out/d.png")
    for name, target in (("elsewhere", "outside"), ("inside", "in/deep"), (".hidden", "outside"), ("own", "out")):
        (tmp_path / "in" / name).symlink_to(tmp_path / target)
    found = items(tmp_path / "in", str(tmp_path / "out"))
    assert [(item.name, bool(item.error)) for item in found] == [("a", False), ("deep/c", False), ("elsewhere", True)]
    assert "the folder 'elsewhere' leads out of the folder" in found[-1].error and "copy" in found[-1].error


def test_a_pattern_leaves_out_folders_that_it_matches_and_linked_ones(tmp_path: Path) -> None:
    touch(tmp_path, "outside/b.png", "in/a.png", "in/deep/c.png")
    (tmp_path / "in" / "elsewhere").symlink_to(tmp_path / "outside")
    assert [(item.name, item.error) for item in items(f"{tmp_path}/in/*", str(tmp_path / "out"))] == [("a", "")]


def test_a_pattern_gives_what_it_matches_named_from_its_first_plain_folder(tmp_path: Path) -> None:
    touch(tmp_path, "in/a.png", "in/deep/b.png", "in/deep/c.jpg", "in/.d.png", "in/out/e.png", "f.png")
    found = items(f"{tmp_path}/in/**/*.png", f"{tmp_path}/in/out")
    assert [(item.name, item.request and item.request.picture) for item in found] == [
        ("a", tmp_path / "in/a.png"),
        ("deep/b", tmp_path / "in/deep/b.png"),
    ]
    with pytest.raises(BadInput, match="holds no pictures"):
        items(f"{tmp_path}/in/*.webp")
    with pytest.raises(BadInput, match=r"the pattern '.*' matches nothing: .*nowhere does not exist"):
        items(f"{tmp_path}/nowhere/*.png")


def test_a_folder_whose_name_looks_like_a_pattern_is_a_folder(tmp_path: Path) -> None:
    touch(tmp_path, "take[1]/a.png")
    assert [item.name for item in items(tmp_path / "take[1]")] == ["a"]


def test_packages_below_a_pattern_are_no_inputs(tmp_path: Path) -> None:
    touch(tmp_path, "made/input/subject.png", "a.png")
    (tmp_path / "made" / "provenance.json").write_text(json.dumps({"files": {}}))
    assert [item.name for item in items(f"{tmp_path}/**/*.png")] == ["a"]


ROWS = [
    {"path": "low.png", "priority": -1, "seed": 3},
    {"path": "first.png"},
    {"path": "urgent.png", "priority": 7, "mesh.grid": 64},
    {"path": "second.png"},
]


@pytest.mark.parametrize("kind", ["csv", "json", "jsonl", "parquet"])
def test_every_kind_of_manifest_says_the_same_and_higher_priority_comes_first(tmp_path: Path, kind: str) -> None:
    file = tmp_path / f"m.{kind}"
    if kind == "parquet":
        arrow = pytest.importorskip("pyarrow", reason="Parquet needs pyarrow")
        parquet = pytest.importorskip("pyarrow.parquet")
        parquet.write_table(
            arrow.Table.from_pylist([{"priority": None, "seed": None, "mesh.grid": None} | r for r in ROWS]), file
        )
    elif kind == "csv":
        with file.open("w", newline="") as lines:
            table = csv.DictWriter(lines, ["path", "priority", "seed", "mesh.grid"])
            table.writeheader()
            table.writerows(ROWS)
    else:
        text = "\n\n".join(map(json.dumps, ROWS)) if kind == "jsonl" else json.dumps(ROWS)
        file.write_text(text)
    found = items(file)
    assert [item.name for item in found] == ["urgent", "first", "second", "low"]
    assert all(item.error == "" for item in found)
    settings = [item.request.settings.mesh.grid for item in found if item.request]
    assert settings[0] == 64 != settings[1]
    assert found[0].request is not None and found[0].request.seed == 3  # the seed of the batch


def test_without_pyarrow_a_parquet_manifest_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "m.parquet").write_bytes(b"PAR1")
    monkeypatch.setattr("flows.inputs.rows.find_spec", lambda name: None)
    with pytest.raises(BackendUnavailable, match="run `make setup`"):
        items(tmp_path / "m.parquet")


@pytest.mark.parametrize(("column", "value"), [("seed", 1.5), ("seed", "x"), ("priority", "high"), ("seed", -1)])
def test_a_number_that_is_none_is_a_bad_item(tmp_path: Path, column: str, value: object) -> None:
    (tmp_path / "m.json").write_text(json.dumps([{"path": "a.png", column: value}]))
    (item,) = items(tmp_path / "m.json")
    assert item.request is None and column in item.error


def test_the_files_of_a_manifest_may_lie_below_a_root_and_nowhere_else(tmp_path: Path) -> None:
    touch(tmp_path, "pictures/a.png", "lists/b.png")
    (tmp_path / "lists/m.json").write_text(json.dumps([{"path": "a.png"}, {"path": "../lists/b.png"}]))
    a, b = items_of(tmp_path / "lists/m.json", Path("out"), "preview", {}, 0, root=tmp_path / "pictures")
    assert a.request is not None and a.request.picture == tmp_path / "pictures/a.png"
    assert b.request is None and "leads out of the folder" in b.error
    with pytest.raises(BadInput, match="--root"):
        items_of(tmp_path / "pictures", Path("out"), "preview", {}, 0, root=tmp_path)
    with pytest.raises(BadInput, match="is not a folder"):
        items_of(tmp_path / "lists/m.json", Path("out"), "preview", {}, 0, root=tmp_path / "gone")


def test_rows_that_want_the_same_share_their_settings(tmp_path: Path) -> None:
    (tmp_path / "m.json").write_text(json.dumps([{"path": f"{i}.png", "mesh.grid": 64} for i in range(50)]))
    assert len({id(item.request.settings) for item in items(tmp_path / "m.json") if item.request}) == 1


@pytest.fixture
def bucket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TinyS3]:
    server = TinyS3()
    for name, value in server.environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    yield server
    server.stop()


def test_a_prefix_of_an_object_store_gives_its_pictures_which_are_fetched_in_their_turn(
    bucket: TinyS3, tmp_path: Path
) -> None:
    for key in ("in/b.png", "in/deep/a.mp4", "in/notes.txt", "in/.hidden.png", "other/c.png"):
        bucket.objects[key] = (f"bytes of {key}".encode(), 0.0)
    found = items(f"s3://{BUCKET}/in/")
    assert [item.name for item in found] == ["b", "deep/a"]
    with found[1].fetch() as request:
        assert request.picture is not None and request.source_name == "a.mp4"
        assert request.picture.read_bytes() == b"bytes of in/deep/a.mp4"
    assert not request.picture.exists()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sources, "LARGEST_FILE_BYTES", 5)
        with pytest.raises(BadInput, match="at most 5 are read"), found[1].fetch():
            pass
    del bucket.objects["in/b.png"]
    with pytest.raises(BadInput, match=r"not in .* any more"), found[0].fetch():
        pass
    with pytest.raises(BadInput, match="holds no pictures"):
        items(f"s3://{BUCKET}/empty/")


def test_objects_that_are_named_as_if_they_lay_outside_are_bad_items(bucket: TinyS3) -> None:
    bucket.objects["in/a\\..\\up.png"] = (b"x", 0.0)
    bucket.objects["in/a.png"] = (b"x", 0.0)
    found = items(f"s3://{BUCKET}/in")
    assert sorted((bool(item.error), item.request is None) for item in found) == [(False, False), (True, True)]


def test_an_object_store_that_does_not_answer_is_named(bucket: TinyS3, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("steps.store.opening.PATIENCE_S", 0.2)
    bucket.stop()
    with pytest.raises(BackendUnavailable, match="does not answer"):
        items(f"s3://{BUCKET}/in2/")
    bucket.start()
