"""Every step by name; imports no step and no torch.

Artifacts between steps:
  frames      a stored zip of NNN.png (RGBA, straight alpha, square) and video.json {"fps": ...}
  pose        JSON {"turn_deg": ...}: turn of the subject's plane that its footage shows, 0 where it shows none
  gaussians   a standard 3DGS PLY (float32)
  motion      safetensors; metadata says the kind of deformation, its settings and the number of frames
  plan        JSON of steps/artifacts/mesh_plan.py: {"mode": "tracked" or "per_frame", "level": ..., ...}
  tracked     safetensors of a tracked mesh: vertices, faces, uvs, texture (uint8), offsets
  meshes      a stored zip of NNN.safetensors, a textured mesh per frame
  ranking     JSON {"weights": {...}, "candidates": [{"number": ..., "name": ..., "total": ..., ...}]}, best first
  films       a stored zip of N.mp4, one per candidate
  gates       JSON {"accepted": ..., "failing": [...], "gates": [{"name", "passed", "value", "least", "most", ...}]}
  truth       a stored zip of input/NNN.png, view_<azimuth>/NNN.png and, where it is known, mesh.npz
  scores      JSON {"frames": ..., "size": ..., "rows": {name: {"input", "views", "mean", "geometry"}}, "clips": ...,
              "missing": {metric: what gets it}, "notes": [...]}
  curves      JSON {"title": ..., "x": [...], "series": {name: [...]}, "notes": [...]}
"""

from steps.contract import Port, StepSpec

PNG = Port(media_type="image/png", suffix=".png")
FRAMES = Port(media_type="application/vnd.dg4d.frames+zip", suffix=".zip")
POSE = Port(media_type="application/vnd.dg4d.pose+json", suffix=".json")
PLY = Port(media_type="application/vnd.dg4d.gaussians+ply", suffix=".ply")
MOTION = Port(media_type="application/vnd.dg4d.motion+safetensors", suffix=".safetensors")
PLAN = Port(media_type="application/vnd.dg4d.mesh-plan+json", suffix=".json")
TRACKED = Port(media_type="application/vnd.dg4d.tracked+safetensors", suffix=".safetensors")
MESHES = Port(media_type="application/vnd.dg4d.meshes+zip", suffix=".zip")
CURVES = Port(media_type="application/vnd.dg4d.curves+json", suffix=".json")
RANKING = Port(media_type="application/vnd.dg4d.ranking+json", suffix=".json")
FILMS = Port(media_type="application/vnd.dg4d.films+zip", suffix=".zip")
TRUTH = Port(media_type="application/vnd.dg4d.truth+zip", suffix=".zip")
GATES = Port(media_type="application/vnd.dg4d.gates+json", suffix=".json")
SCORES = Port(media_type="application/vnd.dg4d.scores+json", suffix=".json")
PACKAGE = Port(media_type="application/vnd.dg4d.package+zip", suffix=".zip")
TEXT = Port(media_type="text/plain", suffix=".txt")
SOURCE = Port(media_type="application/octet-stream", suffix="")
BANK = Port(media_type="application/vnd.dg4d.bank+zip", suffix=".zip")


def _optional(port: Port) -> Port:
    return port.model_copy(update={"optional": True})


STEPS: dict[str, StepSpec] = {
    spec.name: spec
    for spec in (
        StepSpec(
            name="draw_picture",
            version="1",
            entry="steps.draw_picture:run",
            sections=("text",),
            inputs={"text": TEXT},
            outputs={"picture": PNG},
            resource="gpu",
        ),
        StepSpec(
            name="prepare_subject",
            version="1",
            entry="steps.prepare_subject:run",
            sections=("subject",),
            inputs={"source": SOURCE},
            outputs={"subject": PNG, "footage": _optional(FRAMES), "pose": _optional(POSE), "picture": PNG},
            timeout_s=2400,  # a decoder that hangs in one frame cannot be stopped from within
        ),
        StepSpec(
            name="drive_video",
            version="1",
            entry="steps.drive_video:run",
            sections=("driving", "subject.turn_deg"),
            inputs={"subject": PNG, "footage": _optional(FRAMES)},
            outputs={
                "driving_video": FRAMES,
                "picture": PNG,
                "candidates": _optional(PNG),
                "ranking": _optional(RANKING),
                "films": _optional(FILMS),
            },
            resource="gpu",
            late_imports=("dg4d_lib.kernels.compiling:load",),
        ),
        StepSpec(
            name="fit_gaussians",
            version="1",
            entry="steps.fit_gaussians:run",
            sections=("rasterizer", "subject.turn_deg", "prior", "static"),
            inputs={"subject": PNG, "pose": _optional(POSE), "bank": _optional(BANK)},
            outputs={"gaussians": PLY, "curves": CURVES, "picture": PNG},
            resource="gpu",
            late_imports=("dg4d_lib.rasterizer.cpu", "torch._dynamo"),  # the latter: of any optimizer
        ),
        StepSpec(
            name="fit_motion",
            version="1",
            entry="steps.fit_motion:run",
            sections=("rasterizer", "subject.turn_deg", "prior", "deformation", "motion"),
            inputs={"gaussians": PLY, "driving_video": FRAMES, "pose": _optional(POSE), "bank": _optional(BANK)},
            outputs={"motion": MOTION, "gaussians": _optional(PLY), "curves": CURVES, "picture": PNG},
            resource="gpu",
        ),
        StepSpec(
            name="plan_mesh",
            version="1",
            entry="steps.plan_mesh:run",
            sections=("rasterizer", "mesh"),
            inputs={"gaussians": PLY, "motion": MOTION},
            outputs={"plan": PLAN},
        ),
        StepSpec(
            name="extract_mesh",
            version="1",
            entry="steps.extract_mesh:run",
            settings="steps.profiles:FrameRange",
            sections=("rasterizer", "mesh"),
            inputs={"gaussians": PLY, "motion": MOTION, "plan": PLAN},
            outputs={"tracked": _optional(TRACKED), "meshes": _optional(MESHES), "picture": PNG},
        ),
        StepSpec(
            name="join_meshes",
            version="1",
            entry="steps.join_meshes:run",
            inputs={"meshes": MESHES.model_copy(update={"many": True})},
            outputs={"meshes": MESHES},
        ),
        StepSpec(
            name="refine_texture",
            version="1",
            entry="steps.refine_texture:run",
            sections=("refiner",),
            inputs={"tracked": _optional(TRACKED), "meshes": _optional(MESHES), "driving_video": FRAMES},
            outputs={"tracked": _optional(TRACKED), "meshes": _optional(MESHES)},
            resource="gpu",
        ),
        StepSpec(
            name="pack_asset",
            version="1",
            entry="steps.pack_asset:run",
            settings="steps.profiles:PackNotes",
            sections=("rasterizer", "pack"),
            inputs={
                "subject": PNG,
                "driving_video": FRAMES,
                "gaussians": PLY,
                "motion": MOTION,
                "tracked": _optional(TRACKED),
                "meshes": _optional(MESHES),
            },
            outputs={"package": PACKAGE, "sheet": PNG},
        ),
        StepSpec(
            name="check_asset",
            version="1",
            entry="steps.check_asset:run",
            sections=("rasterizer", "gates"),
            inputs={"package": PACKAGE, "driving_video": FRAMES, "subject": PNG},
            outputs={"gates": GATES, "picture": PNG},
        ),
        StepSpec(
            name="score_asset",
            version="1",
            entry="steps.score_asset:run",
            settings="steps.profiles:ScoreAssetSettings",
            inputs={"package": _optional(PACKAGE), "truth": TRUTH},
            outputs={"scores": SCORES, "films": FILMS},
            resource="gpu",
        ),
    )
}
