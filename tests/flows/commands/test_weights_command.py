import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import huggingface_hub
import pytest
from fake_steps import picture
from typer.testing import CliRunner, Result

from dg4d_lib.weights.locate import digests
from dg4d_lib.weights.lock import LockedFile, LockEntry, read_lock, write_lock
from dg4d_lib.weights.registry import KNOWN
from flows import cli
from flows.inputs.conversion_job import ConversionRequest
from steps.profiles import PROFILES

LGM = "model_fp16_fixrot.safetensors"


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "home" / "weights"


def dg4d(*arguments: str) -> Result:
    return CliRunner().invoke(cli.app, [*arguments])


def pulled(home: Path) -> Path:
    folder = home / "lgm"
    folder.mkdir(parents=True)
    (folder / LGM).write_bytes(b"tensors" * 1000)
    files = {
        name: LockedFile(sha256=digest, size=(folder / name).stat().st_size) for name, digest in digests(folder).items()
    }
    write_lock(home, "lgm", LockEntry(hub_id="ashawkey/LGM", revision="c0ffee" + "0" * 34, files=files))
    return folder / LGM


def line_of(name: str, listing: str) -> str:
    return next(line for line in listing.splitlines() if line.startswith(f"{name} "))


def test_the_list_names_all_weights_their_licenses_and_what_is_here(home: Path) -> None:
    before = dg4d("weights", "list")
    assert before.exit_code == 0, before.output
    for name, weights in KNOWN.items():
        assert line_of(name, before.stdout).split()[1] == "no"
        folded = "".join(before.stdout.split())
        assert weights.hub_id in folded
        assert "".join(str(weights.license).split()) in folded  # conditions of commercial use, too
    file = pulled(home)
    listing = dg4d("weights", "list").stdout
    assert line_of("lgm", listing).split()[1:4] == ["yes", "0.00", "c0ffee0000"]
    of_the_file = [hashlib.sha256(file.read_bytes()).hexdigest(), "7000", f"lgm/{LGM}"]
    files = [line.split() for line in dg4d("weights", "list", "--files").stdout.splitlines()]
    assert of_the_file in files
    for name, weights in KNOWN.items():
        for path, digest in weights.published.items():
            assert ([digest, "-", f"{name}/{path}"] in files) == (name != "lgm")
    assert LGM not in listing
    file.write_bytes(b"cut")
    assert line_of("lgm", dg4d("weights", "list").stdout).split()[1] == "damaged"
    write_lock(home, "me/pictures", LockEntry(hub_id="me/pictures", revision="", license="cc-by-nc-4.0", files={}))
    assert "cc-by-nc-4.0" in dg4d("weights", "list").stdout.split("\nme/pictures ")[1].splitlines()[1]


def test_the_list_imports_no_torch() -> None:

    program = (
        "import sys; sys.argv = ['dg4d', 'weights', 'list']\nfrom flows.cli import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "print([m for m in ('torch', 'numpy', 'prefect', 'diffusers', 'transformers') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_check_reads_every_file_again(home: Path) -> None:
    assert "nothing" in dg4d("weights", "check").stdout
    file = pulled(home)
    good = dg4d("weights", "check", "lgm")
    assert good.exit_code == 0, good.output
    assert "lgm: intact, 1 file," in good.stdout
    times = file.stat().st_atime_ns, file.stat().st_mtime_ns
    file.write_bytes(b"tensorz" * 1000)
    os.utime(file, ns=times)  # as a disk that forgets does
    bad = dg4d("weights", "check")
    assert bad.exit_code == 69
    assert f"lgm: {LGM} differs from the pulled file" in bad.stdout
    assert "`dg4d weights pull lgm`" in bad.stderr


def test_check_names_what_is_missing(home: Path) -> None:
    missing = dg4d("weights", "check", "svd")
    assert missing.exit_code == 69
    assert "`dg4d weights pull svd`" in missing.stderr
    assert dg4d("weights", "check", "svt").exit_code == 65


def test_weights_that_were_copied_are_compared_with_what_was_published(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (home / "lgm").mkdir(parents=True)
    (home / "lgm" / LGM).write_bytes(b"tensors")
    other = dg4d("weights", "check")
    assert other.exit_code == 69
    assert f"lgm: {LGM} differs from the published file at revision 1c28a2fd3b" in other.stdout
    told = replace(KNOWN["lgm"], published={LGM: hashlib.sha256(b"tensors").hexdigest(), "more": "0" * 64})
    monkeypatch.setitem(KNOWN, "lgm", told)
    assert "lgm: complete, but not pulled by this command: 1 file as published" in check()
    monkeypatch.setitem(KNOWN, "lgm", replace(told, published={}))
    assert "there are no published digests to compare with" in check()


def check() -> str:
    result = dg4d("weights", "check")
    assert result.exit_code == 0, result.output
    return result.stdout


def test_pull_without_a_network_is_one_message(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def offline(*_: object, **__: object) -> None:
        raise OSError("Name or service not known")

    monkeypatch.setattr(huggingface_hub.HfApi, "model_info", offline)
    result = dg4d("weights", "pull", "svd")
    assert result.exit_code == 69
    assert len(result.stderr.strip().splitlines()) == 1
    assert "connect this machine to the network" in result.stderr
    assert not (home / "svd").exists()


class Downloads:
    """The hub with one large file per part of every repository; downloads are small, whatever it says."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, size_bytes: int) -> None:
        self.got: list[str] = []
        content = b"tensors"

        def model_info(api: object, repository: str, **_: object) -> SimpleNamespace:
            parts = next(one.parts for one in KNOWN.values() if one.hub_id == repository)
            files = [SimpleNamespace(rfilename=f"{part}/m.safetensors", size=size_bytes, lfs=None) for part in parts]
            return SimpleNamespace(sha="c" * 40, siblings=files, card_data=None)

        def snapshot_download(repository: str, local_dir: Path, allow_patterns: list[str], **_: object) -> None:
            self.got.append(repository)
            for name in allow_patterns:
                (local_dir / name).parent.mkdir(parents=True, exist_ok=True)
                (local_dir / name).write_bytes(content)

        monkeypatch.setattr(huggingface_hub.HfApi, "model_info", model_info)
        monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)


def test_a_profile_is_pulled_whole_and_its_sizes_are_told_first(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hub = Downloads(monkeypatch, 250_000_000)
    result = dg4d("weights", "pull", "paper", "svd")
    assert result.exit_code == 0, result.output
    assert hub.got == [KNOWN["svd"].hub_id, KNOWN["zero123-xl"].hub_id]
    assert result.stdout.splitlines()[:3] == [
        "svd: 1.00 of 1.00 GB to download",
        "zero123-xl: 1.25 of 1.25 GB to download",
        "all: 2.25 of 2.25 GB to download",
    ]
    assert set(read_lock(home)) == {"svd", "zero123-xl"}


def test_a_download_that_does_not_fit_is_refused_before_it_begins(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hub = Downloads(monkeypatch, 10**15)
    result = dg4d("weights", "pull", "reference")
    assert result.exit_code == 65
    assert "GB does not fit on the disk" in result.stderr and "$DG4D_WEIGHTS" in result.stderr
    assert hub.got == [] and not home.exists()


def test_a_profile_without_weights_has_nothing_to_pull() -> None:
    result = dg4d("weights", "pull", "preview")
    assert result.exit_code == 65
    assert "profile preview needs no weights" in result.stderr


def test_no_profile_has_the_name_of_weights() -> None:
    assert not set(PROFILES) & set(KNOWN)


def test_pull_wants_names() -> None:
    assert dg4d("weights", "pull").exit_code == 2
    Path("folder").mkdir()
    result = dg4d("weights", "pull", "./folder")
    assert result.exit_code == 65
    assert "is a folder on this machine" in result.stderr


def test_make_tells_the_conditions_of_commercial_use(home: Path) -> None:
    request = ConversionRequest(item="fox", picture=Path("fox.png"), settings=PROFILES["paper"])
    assert request.license_conditions() == [f"license of svd: {KNOWN['svd'].license}"]
    assert "one million US dollars" in request.license_conditions()[0]


def test_a_folder_of_weights_that_is_a_file_is_refused(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("file").touch()
    monkeypatch.setenv("DG4D_WEIGHTS", "file")
    done = dg4d("weights", "list")
    assert done.exit_code == 65 and f"$DG4D_WEIGHTS is not a folder: {Path('file').absolute()}" in done.stderr


def test_make_refuses_weights_that_forbid_commercial_use_before_it_looks_for_them(home: Path) -> None:
    Path("cat.png").write_text(picture("a cat"))
    arguments = ["make", "cat.png", "--set", "prior.kind=zero123", "-o", "out"]
    missing = dg4d(*arguments)
    assert missing.exit_code == 69
    assert "`dg4d weights pull zero123-xl`" in missing.stderr
    refused = dg4d(*arguments, "--commercial-only")
    assert refused.exit_code == 65
    assert "zero123-xl" in refused.stderr
    assert not Path("out").exists()


def test_a_batch_is_refused_as_a_whole_where_one_item_names_such_weights(home: Path) -> None:
    Path("cat.png").write_text(picture("a cat"))
    rows = [{"path": "cat.png"}, {"path": "cat.png", "prior.kind": "zero123"}]
    Path("items.json").write_text(json.dumps(rows))
    refused = dg4d("batch", "items.json", "-o", "out", "--commercial-only")
    assert refused.exit_code == 65
    assert "zero123-xl" in refused.stderr
    assert not Path("out").exists()


def test_words_and_a_picture_are_one_too_many_and_neither_is_one_too_few(home: Path) -> None:
    Path("cat.png").write_text(picture("a cat"))
    both = dg4d("make", "cat.png", "--text", "a cat", "--set", "text.weights=me/pictures")
    assert both.exit_code == 65
    assert "not both" in both.stderr
    assert dg4d("make").exit_code == 2
    nothing = dg4d("make", "--text", "a cat")
    assert nothing.exit_code == 65
    assert "--set text.weights" in nothing.stderr
