import zipfile
from pathlib import Path

import pytest

from dg4d_lib.errors import BadInput
from steps.catalog import STEPS
from steps.contract import StepRequest
from steps.runtime.installed_code import request_version
from steps.runtime.perform import perform
from steps.store.artifact_store import ArtifactStore

SPEC = STEPS["join_meshes"]


def part(store: ArtifactStore, folder: Path, **entries: str) -> object:
    with zipfile.ZipFile(folder / "part.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(f"{name[1:]}.safetensors", content)
    return store.put(folder / "part.zip", SPEC.inputs["meshes"].media_type)


def joined(store: ArtifactStore, *parts: object) -> zipfile.ZipFile:
    inputs = {f"meshes_{i:03d}": each for i, each in enumerate(parts)}
    request = StepRequest(step=SPEC.name, version=request_version(SPEC), inputs=inputs, settings={}, seed=0)
    result, error = perform(request, store)
    if error is not None:
        raise error
    assert result.provenance.inputs == {name: each.digest for name, each in inputs.items()}
    return zipfile.ZipFile(store.path(result.outputs["meshes"]))


def test_parts_become_one_whatever_their_order(tmp_path: Path) -> None:
    store = ArtifactStore(tmp_path / "store")
    one, two = part(store, tmp_path, _000="a", _001="b"), part(store, tmp_path, _002="c")
    with joined(store, two, one) as whole, joined(store, one, two) as other:
        assert whole.filename == other.filename  # equal bytes
        assert whole.namelist() == ["000.safetensors", "001.safetensors", "002.safetensors"]
        assert whole.read("002.safetensors") == b"c"


def test_parts_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    store = ArtifactStore(tmp_path / "store")
    with pytest.raises(BadInput, match=r"000\.safetensors"):
        joined(store, part(store, tmp_path, _000="a"), part(store, tmp_path, _000="b"))


@pytest.mark.parametrize(
    ("names", "says"),
    [([], "needs the input meshes"), (["meshes"], "meshes"), (["meshes_000", "whole"], "no input whole")],
)
def test_inputs_of_another_name_are_refused(tmp_path: Path, names: list[str], says: str) -> None:
    store = ArtifactStore(tmp_path / "store")
    one = part(store, tmp_path, _000="a")
    request = StepRequest(
        step=SPEC.name, version=request_version(SPEC), inputs=dict.fromkeys(names, one), settings={}, seed=0
    )
    _, error = perform(request, store)
    assert isinstance(error, BadInput) and says in str(error)
