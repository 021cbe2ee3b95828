"""Steps that do next to nothing, under the names of the real ones; what happens is said in the source file.

The package holds the model in the file $FAKE_GLB, if there is one, and else text that no program plays.
The source is text after the signature of a picture (`picture`): words that name a step and what it should do there,
for example "fit_motion=sleep:5".
Every run of a step is noted in the file $FAKE_LOG.
"""

import json
import logging
import os
import re
import resource
import signal
import time
import zipfile
import zlib
from pathlib import Path

from dg4d_lib.errors import BackendUnavailable, BadInput, FitDiverged
from steps.artifacts.archives import add_entry
from steps.artifacts.mesh_plan import MeshPlan, read_plan, write_plan
from steps.catalog import STEPS as REAL
from steps.runtime.job import Job, StepReport


def _png() -> bytes:
    def chunk(name: bytes, body: bytes) -> bytes:
        return len(body).to_bytes(4, "big") + name + body + zlib.crc32(name + body).to_bytes(4, "big")

    rows = b"".join(b"\0" + bytes([40 * y, 200, 90] * 8) for y in range(6))
    head = b"\0\0\0\x08\0\0\0\x06\x08\x02\0\0\0"
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


PNG = _png()  # 8 x 6 pixels
STEPS = {
    name: spec.model_copy(update={"entry": f"fake_steps:{name}", "timeout_s": 60.0, "late_imports": ()})
    for name, spec in REAL.items()
}


def picture(words: object) -> str:
    """Return the content of a file that is admitted as a picture (HDR has a header of text), with these words."""
    return f"#?RADIANCE\n{words}"


def bank_json(*names: str) -> str:
    """Return a `bank.json` of two frames whose sheets are `PNG`."""
    views = [{"file": name, "azimuth": 0.0, "elevation": 0.0, "radius": 2.0} for name in names]
    return json.dumps({"frames": [0, 1], "tile": [3, 4], "tile_size": 2, "views": views})


def draw_picture(job: Job) -> StepReport:
    words = _begin("draw_picture", job, job.inputs["text"].read_bytes())
    job.outputs["picture"].write_bytes(PNG + words)
    weights = {"fake/unet.safetensors": "sha256:" + "e" * 64}
    return StepReport(weights=weights, licenses={"fake": "fake license: <free>"})


def cut_out(job: Job) -> StepReport:
    _begin("cut_out", job, job.inputs["source"].read_bytes())
    job.outputs["picture"].write_bytes(PNG)
    job.outputs["matte"].write_bytes(PNG)
    facts = {"width": 8, "height": 6, "kind": "picture", "frames": 1, "has_alpha": False, "notes": [], "problem": ""}
    job.outputs["facts"].write_text(json.dumps(facts))
    return StepReport()


def prepare_subject(job: Job) -> StepReport:
    words = _begin("prepare_subject", job, job.inputs["source"].read_bytes())
    job.outputs["subject"].write_bytes(PNG + words)  # what follows a picture is ignored by those who look at it
    job.outputs["picture"].write_bytes(PNG)
    if b"moving" in words:
        job.outputs["footage"].write_bytes(words)
    return StepReport(notes=("This asset is a fake.",))


def prepare_views(job: Job) -> StepReport:
    _begin("prepare_views", job, b"")
    job.outputs["known_views"].write_bytes(b"views of " + job.inputs["views"].read_bytes())
    job.outputs["picture"].write_bytes(PNG)
    return StepReport()


def generate_views(job: Job) -> StepReport:
    _begin("generate_views", job, b"")
    job.outputs["known_views"].write_bytes(b"views drawn of " + job.inputs["subject"].read_bytes())
    job.outputs["picture"].write_bytes(PNG)
    return StepReport()


def drive_video(job: Job) -> StepReport:
    words = _begin("drive_video", job, job.inputs["subject"].read_bytes()[len(PNG) :])
    with zipfile.ZipFile(job.outputs["driving_video"], "w") as archive:
        frames = re.search(rb"drive_video=frames:(\d+)", words)
        for i in range(int(frames[1]) if frames else 5):
            archive.writestr(zipfile.ZipInfo(f"{i:03d}.png"), words)
    job.outputs["picture"].write_bytes(PNG)
    driving = job.settings.driving
    if driving.candidates > 1 and not driving.pick:
        rows = [{"number": i, "total": 1 / i, "name": "still", "remarks": []} for i in range(1, driving.candidates + 1)]
        job.outputs["candidates"].write_bytes(PNG)
        job.outputs["ranking"].write_text(json.dumps({"taken": 1, "candidates": rows}))
        with zipfile.ZipFile(job.outputs["films"], "w") as archive:
            for row in rows:
                archive.writestr(zipfile.ZipInfo(f"{row['number']}.mp4"), b"film")
    return StepReport()


def fit_gaussians(job: Job) -> StepReport:
    words = _begin("fit_gaussians", job, job.inputs["subject"].read_bytes()[len(PNG) :])
    for i in range(10):
        job.progress(i + 1, 10, {"loss": 1 / (i + 1)})
    job.outputs["gaussians"].write_bytes(words)
    job.outputs["first_look"].write_bytes(b"D4WS" + words)
    _curves(job)
    return StepReport()


def prepare_asset(job: Job) -> StepReport:
    with zipfile.ZipFile(job.inputs["model"]) as archive:
        content = archive.read(archive.namelist()[0])
    words = _begin("prepare_asset", job, content)
    job.outputs["gaussians"].write_bytes(words)
    job.outputs["placement"].write_text("{}")
    job.outputs["picture"].write_bytes(PNG)
    if b"splats" not in words:
        job.outputs["glb"].write_bytes(content)
    if "subject" not in job.inputs:
        job.outputs["subject"].write_bytes(PNG + words)
    return StepReport()


def animate_asset(job: Job) -> StepReport:
    words = _begin("animate_asset", job, job.inputs["gaussians"].read_bytes())
    job.outputs["motion"].write_bytes(b"motion of " + words)
    job.outputs["picture"].write_bytes(PNG)
    if "glb" in job.inputs:
        job.outputs["tracked"].write_bytes(b"mesh of " + words)
        job.outputs["moving"].write_bytes(b"moving " + words)
    _curves(job)
    return StepReport()


def fit_motion(job: Job) -> StepReport:
    words = _begin("fit_motion", job, job.inputs["gaussians"].read_bytes())
    job.outputs["motion"].write_bytes(b"motion of " + words)
    if job.settings.motion.fine_tune:
        job.outputs["gaussians"].write_bytes(b"better " + words)
    _curves(job)
    return StepReport()


def plan_mesh(job: Job) -> StepReport:
    words = _begin("plan_mesh", job, job.inputs["motion"].read_bytes())
    mode = job.settings.mesh.mode
    if mode == "auto":
        mode = "per_frame" if b"flutters" in words else "tracked"
    write_plan(job.outputs["plan"], MeshPlan(mode=mode, level=0.5))
    return StepReport()


def extract_mesh(job: Job) -> StepReport:
    words = _begin("extract_mesh", job, job.inputs["motion"].read_bytes())
    settings = job.settings
    if read_plan(job.inputs["plan"]).mode == "per_frame":
        with zipfile.ZipFile(job.outputs["meshes"], "w") as archive:
            for i in range(settings.first_frame, settings.end_frame):
                add_entry(archive, f"{i:03d}.safetensors", f"frame {i}".encode())
    elif b"stumbles" in words and settings.mesh.mode == "auto":
        write_plan(job.outputs["plan"], MeshPlan(mode="per_frame", level=0.5))
    else:
        job.outputs["tracked"].write_bytes(words)
    job.outputs["picture"].write_bytes(PNG)
    return StepReport()


def join_meshes(job: Job) -> StepReport:
    from steps.join_meshes import run  # the real one; it imports torch, which nothing else here does

    _begin("join_meshes", job, b"")
    return run(job)


def refine_texture(job: Job) -> StepReport:
    name = "tracked" if "tracked" in job.inputs else "meshes"
    _begin("refine_texture", job, job.inputs["subject"].read_bytes()[len(PNG) :])
    job.outputs[name].write_bytes(job.inputs[name].read_bytes())
    return StepReport()


def pack_asset(job: Job) -> StepReport:
    words = _begin("pack_asset", job, job.inputs["subject"].read_bytes()[len(PNG) :])
    name = "tracked" if "tracked" in job.inputs else "meshes"
    with zipfile.ZipFile(job.outputs["package"], "w") as archive:
        model = os.environ.get("FAKE_GLB")
        archive.writestr(zipfile.ZipInfo("asset.glb"), Path(model or job.inputs[name]).read_bytes())
        archive.writestr(zipfile.ZipInfo("contact_sheet.png"), PNG + words)
        archive.writestr(zipfile.ZipInfo("splats/000.ply"), b"0")
        archive.writestr(zipfile.ZipInfo("splats/001.ply"), str(job.seed).encode())
    job.outputs["sheet"].write_bytes(PNG)
    return StepReport()


def check_asset(job: Job) -> StepReport:
    with zipfile.ZipFile(job.inputs["package"]) as archive:
        words = _begin("check_asset", job, archive.read("contact_sheet.png")[len(PNG) :])
    bad = b"torn" in words
    gate = {
        "name": "silhouette",
        "passed": not bad,
        "value": 0.5 if bad else 0.9,
        "unit": "",
        "least": 0.85,
        "most": None,
    }
    gate |= {"form": "mesh", "values": {"mesh": 0.9}, "meaning": "how <well> it fits", "advice": "fit it <again>"}
    verdict = {"accepted": not bad, "failing": ["silhouette"] if bad else [], "gates": [gate]}
    job.outputs["gates"].write_text(json.dumps(verdict))
    job.outputs["picture"].write_bytes(PNG)
    return StepReport()


def score_asset(job: Job) -> StepReport:
    with zipfile.ZipFile(job.inputs["truth"]) as archive:
        words = _begin("score_asset", job, archive.read("input/000.png"))
        views = sorted({name.split("/")[0] for name in archive.namelist() if name.startswith("view_")})
    ours = "package" in job.inputs
    figures = {"psnr": 20.0 if ours else 10.0, "terr": 0.5 if ours else 1.0}
    shown = {view.removeprefix("view_"): figures for view in views}
    row = {"views": shown, "mean": figures, **({"input": {"psnr": 30.0}} if ours else {})}
    clips = {view: [len(words) + (2.0 if ours else 0.0) + i] for i, view in enumerate(shown)}
    report = {"frames": 2, "size": 8, "clips": clips, "notes": [], "missing": {"lpips": "`pull x` <gets it>"}}
    rows = {"asset": row} if ours else {"input_frozen": row}
    job.outputs["scores"].write_text(json.dumps({**report, "rows": rows}))
    with zipfile.ZipFile(job.outputs["films"], "w") as archive:
        for view in ("input", *views):
            archive.writestr(zipfile.ZipInfo(f"{view}.mp4"), b"film")
    return StepReport()


def _begin(step: str, job: Job, words: bytes) -> bytes:
    """Note the run, then do what the words say for this step; with the word "named=X", note "step:X" at the end."""
    log = Path(os.environ["FAKE_LOG"])
    pairs = [word.partition("=")[::2] for word in words.decode(errors="replace").split()]
    item = dict(pairs).get("named")
    if item is None:
        _note(log, step)
    for name, command in pairs:
        if name == step:
            _obey(command, job, step)
    if item is not None:
        _note(log, f"{step}:{item}")
    return words


def _note(log: Path, line: str) -> None:
    with log.open("a") as file:
        file.write(f"{line}\n")


def _obey(command: str, job: Job, step: str) -> None:
    verb, _, value = command.partition(":")
    once = Path(os.environ["FAKE_LOG"]).with_suffix(f".{step}")
    match verb:
        case "log":
            logging.getLogger("dg4d_lib.fake").info(value)
        case "missing" | "full":
            raise {"missing": BackendUnavailable("no cuda here"), "full": OSError(28, "No space left on device")}[verb]
        case "bad":
            raise BadInput(f"the picture is {value}")
        case "diverge":
            (job.pictures / "last_good.png").write_bytes(PNG)
            raise FitDiverged(f"{step} diverged at iteration 7: the loss is nan")
        case "crash":
            raise ZeroDivisionError("division by zero")
        case "memory":
            raise MemoryError("not enough")
        case "die":
            os.kill(os.getpid(), signal.SIGKILL)
        case "kill":
            os.kill(int(value), signal.SIGKILL)
            time.sleep(20)
        case "sleep":
            time.sleep(float(value))
        case "die-once" | "memory-once" | "sleep-once" if not once.exists():
            once.touch()
            _obey(command.replace("-once", ""), job, step)
        case "hoard":
            used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (used + 2**26, resource.getrlimit(resource.RLIMIT_AS)[1]))
            bytearray(2**30)
        case "environment":
            lines = (f"{name}={value}\n" for name, value in os.environ.items())
            Path(os.environ["FAKE_LOG"]).with_suffix(".environment").write_text("".join(lines))


def _curves(job: Job) -> None:
    curves = {"title": "fake", "x": [0, 1, 2], "series": {"loss": [1.0, 0.1, 0.01]}, "notes": []}
    job.outputs["curves"].write_text(json.dumps(curves))
    job.outputs["picture"].write_bytes(PNG)
