from pathlib import Path

import pytest
from tiny_text_to_image import save_pipeline

from dg4d_lib.asset_settings import CutoutGateSettings
from dg4d_lib.input_settings import SubjectSettings, TextSettings
from steps.artifacts.media import read_png
from steps.catalog import STEPS
from steps.contract import StepFailure, StepRequest, StepResult
from steps.profiles import PREVIEW, step_settings
from steps.runtime.installed_code import request_version
from steps.runtime.perform import perform
from steps.runtime.weights import identities, weights_in, without_paths
from steps.store.artifact_store import ArtifactStore


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_pipeline(tmp_path_factory.mktemp("models") / "tiny")


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_WEIGHTS", str(tmp_path / "weights"))


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    return ArtifactStore(tmp_path / "store")


def draw(weights: str, store: ArtifactStore, words: str = "a red dragon", seed: int = 0) -> StepResult | StepFailure:
    text = TextSettings(weights=weights, size=64, num_inference_steps=2)
    settings = step_settings("draw_picture", PREVIEW.model_copy(update={"text": text}))
    tree = without_paths(settings.model_dump(mode="json"))
    request = StepRequest(
        step="draw_picture",
        version=request_version(STEPS["draw_picture"]),
        inputs={"text": store.put_bytes(words.encode(), "text/plain")},
        settings=tree,
        seed=seed,
        weights=identities(weights_in(tree)),
    )
    return perform(request, store)[0]


def test_words_become_a_picture_and_the_record_says_by_what(model: Path, store: ArtifactStore, tmp_path: Path) -> None:
    result = draw(str(model), store)
    assert isinstance(result, StepResult)
    store.get(result.outputs["picture"], tmp_path / "picture.png")
    assert read_png(tmp_path / "picture.png").shape == (64, 64, 3)
    record = result.provenance
    assert {name.split("/")[1] for name in record.weights} >= {"unet", "vae", "text_encoder", "tokenizer", "scheduler"}
    assert list(record.licenses) == [record.settings["text"]["weights"]]
    assert "a red dragon" in record.notes[0]
    assert str(model.parent) not in record.model_dump_json()


def test_equal_requests_give_equal_bytes_and_seed_and_words_count(model: Path, store: ArtifactStore) -> None:
    first = draw(str(model), store).outputs["picture"].digest
    assert draw(str(model), store).outputs["picture"].digest == first
    assert draw(str(model), store, seed=1).outputs["picture"].digest != first
    assert draw(str(model), store, "a blue newt").outputs["picture"].digest != first


def test_without_a_pipeline_the_knob_is_named(store: ArtifactStore) -> None:
    failure = draw("", store)
    assert isinstance(failure, StepFailure)
    assert failure.kind == "bad_input"
    assert "--set text.weights=" in failure.message


def test_missing_weights_name_the_command(store: ArtifactStore) -> None:
    failure = draw("somebody/pictures", store)
    assert isinstance(failure, StepFailure)
    assert failure.kind == "missing"
    assert "`dg4d weights pull somebody/pictures`" in failure.message


def test_what_was_drawn_is_cut_out(store: ArtifactStore, tmp_path: Path) -> None:
    picture = draw(str(save_pipeline(tmp_path / "square", square=True)), store).outputs["picture"]
    request = StepRequest(
        step="prepare_subject",
        version=request_version(STEPS["prepare_subject"]),
        inputs={"source": picture},
        settings={
            "subject": SubjectSettings(size=64, framing="keep").model_dump(mode="json"),
            "cutout": CutoutGateSettings().model_dump(mode="json"),
        },
        seed=0,
    )
    outcome = perform(request, store)[0]
    assert isinstance(outcome, StepResult), outcome
    store.get(outcome.outputs["subject"], tmp_path / "subject.png")
    subject = read_png(tmp_path / "subject.png")
    inside, outside = subject[16:48, 16:48], subject[:4]
    assert inside[..., 3].min() > 0.99
    assert inside[..., 0].min() > inside[..., 1].max() + 0.3  # red
    assert outside[..., 3].max() < 0.01
