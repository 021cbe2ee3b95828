"""Every trained profile by the real steps: tiny random weights in the real formats, small numbers, on a GPU too."""

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import torch
from media_files import save, save_zip, walk
from tiny_imagedream import write_imagedream, write_lgm
from tiny_qwen_edit import save_tiny_lora, save_tiny_qwen_edit, shrink_inputs
from tiny_svd import save_tiny_svd
from tiny_wan import save_tiny_wan
from tiny_weights import write_zero123

from dg4d_lib.diffusion.view_generation import ViewGenerator
from dg4d_lib.shape_prior import packaged
from dg4d_lib.weights.registry import KNOWN
from steps.artifacts.package_files import ABOUT, ASSET, MANIFEST, MERGED, MESHES, PLAYBACK, RIGGED, SPLATS
from steps.catalog import STEPS
from steps.contract import ArtifactRef, ProvenanceRecord, StepRequest, StepResult
from steps.profiles import PROFILES, PipelineSettings, profile, revise, step_settings
from steps.runtime.installed_code import request_version
from steps.runtime.perform import perform
from steps.runtime.weights import identities, weights_in
from steps.store.artifact_store import ArtifactStore

FRAMES = 3
LADDER = [{"until": 1.0, "size": 32}]
TINY: dict[str, Any] = {
    "subject.size": 64,
    "subject.max_frames": FRAMES,
    "static.iterations": 2,
    "static.views": 1,
    "static.start.points": 300,
    "static.reference_size": 32,
    "static.resolution_schedule": LADDER,
    "motion.iterations": 2,
    "motion.views": 1,
    "motion.reference_size": 32,
    "motion.resolution_schedule": LADDER,
    "mesh.grid": 32,
    "mesh.edge_length": 0.06,
    "mesh.max_faces": 400,
    "mesh.texture_size": 64,
    "mesh.render_size": 64,
    "driving.frames": FRAMES,
    "driving.height": 64,
    "driving.width": 64,
    "driving.model.num_inference_steps": 2,
    "refiner.texture.iterations": 2,
    "refiner.texture.size": 64,
    "refiner.model.num_inference_steps": 4,
    "pack.preview_size": 64,
    "pack.preview_turns": 1,
    "pack.sheet_size": 32,
    "pack.sheet_frames": 2,
}
OF_MODELS = ("driving.height", "driving.width", "driving.model", "refiner")
WRITERS = {
    "zero123-xl": write_zero123,
    "stable-zero123": write_zero123,
    "svd": save_tiny_svd,
    "imagedream": write_imagedream,
    "lgm": write_lgm,
    "wan2.2-ti2v-5b": save_tiny_wan,
    "qwen-image-edit-2511": save_tiny_qwen_edit,
    "qwen-multiple-angles": save_tiny_lora,
}
ALWAYS = {MANIFEST, *ABOUT} - {RIGGED, PLAYBACK, MERGED}


@dataclass
class Run:
    """One order, step by step in this process."""

    profile: str
    store: ArtifactStore
    settings: PipelineSettings = field(init=False)
    records: list[ProvenanceRecord] = field(default_factory=list)

    def __post_init__(self) -> None:
        changes = dict(TINY)
        if self.profile == "preview":  # its stages have no large models
            changes = {key: value for key, value in TINY.items() if not key.startswith(OF_MODELS)}
        if self.profile == "open":
            changes = {key: value for key, value in TINY.items() if not key.startswith(("refiner", "driving.model"))}
            changes |= {
                "driving.num_inference_steps": 1,
                "driving.generated_frames": 0,
                "driving.prompt": "the subject",
            }
            changes |= {"views.num_inference_steps": 2, "views.size": 64, "views.min_weight": 0.0}
            changes |= {"views.azimuths_deg": [90, 180], "views.elevations_deg": [0]}
        if self.profile == "release":
            changes["deformation.spatial"] = 8  # its planes have up to 512 cells per side
        if profile(self.profile).static.start.kind == "lgm":
            changes["static.start.num_inference_steps"] = 2
            del changes["static.start.points"]
        self.settings = revise(profile(self.profile), changes)

    def step(self, name: str, inputs: Mapping[str, ArtifactRef | None], **values: object) -> dict[str, ArtifactRef]:
        tree = step_settings(name, self.settings, **values).model_dump(mode="json")
        request = StepRequest(
            step=name,
            version=request_version(STEPS[name]),
            inputs={port: ref for port, ref in inputs.items() if ref is not None},
            settings=tree,
            seed=0,
            weights=identities(weights_in(tree)),
        )
        outcome, error = perform(request, self.store)
        assert isinstance(outcome, StepResult), error
        self.records.append(outcome.provenance)
        return outcome.outputs

    def notes(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(note for record in self.records for note in record.notes))

    def make(self, source: ArtifactRef) -> Path:
        """The package of a source."""
        prepared = self.step("prepare_subject", {"source": source})
        subject, footage = prepared["subject"], prepared.get("footage")
        video = self.step("drive_video", {"subject": subject, "footage": footage})["driving_video"]
        known = None
        if self.settings.views.kind != "none":
            known = self.step("generate_views", {"subject": subject})["known_views"]
        gaussians = self.step("fit_gaussians", {"subject": subject, "known_views": known})["gaussians"]
        fitted = self.step("fit_motion", {"gaussians": gaussians, "driving_video": video, "known_views": known})
        assert ("gaussians" in fitted) == self.settings.motion.fine_tune
        cloud = {"gaussians": fitted.get("gaussians", gaussians), "motion": fitted["motion"]}
        surface = self.step("extract_mesh", {**cloud, "plan": self.step("plan_mesh", cloud)["plan"]})
        del surface["picture"]
        if self.settings.refiner.kind != "identity":
            refined = self.step("refine_texture", {**surface, "subject": subject, "driving_video": video})
            assert refined.keys() == surface.keys() and refined != surface
            surface = refined
        packed = self.step(
            "pack_asset", {"subject": subject, "driving_video": video, **cloud, **surface}, notes=self.notes()
        )
        return self.store.path(packed["package"])


@pytest.fixture(scope="module", autouse=True)
def weights(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A tiny stand-in for everything that a profile names, where pulled weights would lie."""
    home = tmp_path_factory.mktemp("weights")
    for name, write in WRITERS.items():
        write(home / name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DG4D_WEIGHTS", str(home))
        patch.setenv("DG4D_CODE_VERSION", "unchanging")
        yield home


def source_of(folder: Path, store: ArtifactStore, moving: bool) -> ArtifactRef:
    pictures = {f"{i}.png": picture for i, picture in enumerate(walk(FRAMES))}
    path = save_zip(folder / "walk.zip", pictures, folder) if moving else save(folder / "disc.png", pictures["0.png"])
    return store.put(path, "application/octet-stream")


@pytest.mark.slow
@pytest.mark.gpu
@pytest.mark.parametrize(
    ("name", "moving", "used"),
    [
        ("paper", False, {"drive_video": {"svd"}}),
        pytest.param(
            "paper-lgm",
            False,
            {"drive_video": {"svd"}, "fit_gaussians": {"zero123-xl", "imagedream", "lgm"}},
            marks=pytest.mark.slow,
        ),
        ("video", True, {}),
        ("video-fast", True, {}),
        ("release", False, {"drive_video": {"svd"}}),
        pytest.param(
            "reference",
            False,
            {"drive_video": {"svd"}, "fit_gaussians": {"stable-zero123", "imagedream", "lgm"}},
            marks=pytest.mark.slow,
        ),
        pytest.param("quality", False, {"drive_video": {"svd"}}, marks=pytest.mark.slow),
    ],
)
def test_a_file_becomes_a_package_by_the_models_that_its_profile_names_and_no_others(
    name: str, moving: bool, used: dict[str, set[str]], tmp_path: Path
) -> None:
    run = Run(name, ArtifactStore(tmp_path / "store"))
    package = run.make(source_of(tmp_path, run.store, moving))

    prior = "stable-zero123" if name == "reference" else "zero123-xl"
    expected = {"fit_gaussians": {prior}, "fit_motion": {prior}, "refine_texture": {"svd"}, **used}
    for record in run.records:
        named = expected.get(record.step, set())
        assert record.licenses == {each: str(KNOWN[each].license) for each in named}, record.step
        assert {file.partition("/")[0] for file in record.weights} == named, record.step
        assert bool(record.flops) == bool(named) and all(count > 1e6 for count in record.flops.values()), record.step
        assert ("gpu" in record.machine) == torch.cuda.is_available()

    said = run.notes()
    assert f"prior: Zero-1-to-3, weights {prior}" in said
    assert any("LGM" in note for note in said) == (name in ("paper-lgm", "reference"))
    assert any("best of 4" in note for note in said) == (name == "quality")
    assert not [note for note in said if "no model" in note or "without a" in note]

    with zipfile.ZipFile(package) as files:
        names, manifest = set(files.namelist()), json.loads(files.read(MANIFEST))
        assert files.read(ASSET).startswith(b"glTF")
    per_frame = name != "quality"
    assert names - {RIGGED, PLAYBACK} == {
        *ALWAYS,
        *(f"{SPLATS}/{frame:03d}.{form}" for frame in range(FRAMES) for form in ("ply", "spz")),
        *(f"{MESHES}/{frame:03d}.glb" for frame in range(FRAMES * per_frame)),
    }
    assert manifest["frames"] == FRAMES and set(said) <= set(manifest["notes"])


@pytest.mark.slow
@pytest.mark.gpu
def test_open_becomes_a_package_by_models_that_may_be_sold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shrink_inputs(monkeypatch)
    subject = torch.ones(64, 64, 3)
    subject[16:48, 20:44] = torch.tensor([0.8, 0.2, 0.1])
    generate = ViewGenerator.generate
    monkeypatch.setattr(ViewGenerator, "generate", lambda self, *given: [subject for _ in generate(self, *given)])
    run = Run("open", ArtifactStore(tmp_path / "store"))
    with zipfile.ZipFile(run.make(source_of(tmp_path, run.store, moving=False))) as files:
        assert files.read(ASSET).startswith(b"glTF")
    licenses = {name: text for record in run.records for name, text in record.licenses.items()}
    models = {"wan2.2-ti2v-5b", "qwen-image-edit-2511", "qwen-multiple-angles"}
    assert models <= set(licenses) and all(KNOWN[name].license.commercial == "yes" for name in models)
    said = run.notes()
    assert any("visual hull of 3 views" in note for note in said)
    assert any("video model wan2.2-ti2v-5b" in note for note in said)


@pytest.mark.gpu
@pytest.mark.slow
def test_the_preview_draws_wherever_there_is_a_device(tmp_path: Path) -> None:
    """Its prior is the processor's everywhere."""
    run = Run("preview", ArtifactStore(tmp_path / "store"))
    with zipfile.ZipFile(run.make(source_of(tmp_path, run.store, moving=False))) as files:
        assert files.read(ASSET).startswith(b"glTF")
    used = {name for record in run.records for name in record.weights}
    assert used == set(packaged.digests()) and not any(record.flops for record in run.records)
    assert all(("gpu" in record.machine) == torch.cuda.is_available() for record in run.records)
    assert any("shape network" in note for note in run.notes())


@pytest.mark.parametrize("name", PROFILES)
def test_a_profile_names_weights_of_the_registry_and_the_preview_none(name: str) -> None:
    named = set(weights_in(profile(name).model_dump(mode="json")))
    assert named <= set(KNOWN)
    assert bool(named) == (name != "preview")
    assert named <= set(WRITERS)  # so the test above leaves none out
