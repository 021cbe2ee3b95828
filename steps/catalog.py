"""Catalog of all steps with their inputs and outputs; imports no step and no torch.

Artifacts:
  frames      uncompressed zip of NNN.png (RGBA, straight alpha, square) and video.json {"fps": ...}
  views       uncompressed zip of views.json (steps/sources/views.py) and the files that it names
  bank        zip of bank.json (steps/sources/banks.py) and a sheet per view
  matte       PNG with one channel: alpha in the pixels of a picture
  facts       JSON {"width": ..., "height": ..., "kind": ..., "frames": ..., "notes": [...], "problem": ...} of a source
  pose        JSON {"turn_deg": ...}: turn of the subject's plane that its footage shows, null where it shows none
  depth-field safetensors of steps/artifacts/depth_fields.py: depth of the middle of the subject behind every pixel
  model       uncompressed zip of model.SUFFIX (.glb, .gltf, .obj, .usdz, .ply, .spz) and the files that it refers to
  glb         GLB of the model; `moving` has a morph target per frame
  placement   JSON of steps/artifacts/placements.py: similarity from the model to the world
  gaussians   standard 3DGS PLY (float32)
  splats      web splats of one frame, to be looked at while the motion is fitted
  motion      safetensors; metadata: kind of deformation, its settings and the number of frames
  plan        JSON of steps/artifacts/mesh_plan.py: {"mode": "tracked" or "per_frame", "level": ..., ...}
  tracked     safetensors of a tracked mesh: vertices, faces, uvs, texture (uint8), offsets
  meshes      uncompressed zip of NNN.safetensors, a textured mesh per frame
  ranking     JSON {"weights": {...}, "candidates": [{"number": ..., "name": ..., "total": ..., ...}]}, best first
  films       uncompressed zip of N.mp4, one per candidate or view
  gates       JSON {"accepted": ..., "failing": [...], "gates": [{"name", "passed", "value", "least", "most", ...}]}
  truth       uncompressed zip of input/NNN.png, view_<azimuth>/NNN.png and optionally mesh.npz
  scores      JSON {"frames": ..., "size": ..., "rows": {name: {"input", "views", "mean", "geometry"}}, "clips": ...,
              "missing": {metric: remedy}, "notes": [...]}
  curves      JSON {"title": ..., "x": [...], "series": {name: [...]}, "notes": [...]}
"""

from typing import Any

from steps.contract import Port, StepSpec


def _port(kind: str, form: str) -> Port:
    return Port(media_type=f"application/vnd.dg4d.{kind}+{form}", suffix=f".{form}")


def _optional(port: Port) -> Port:
    return port.model_copy(update={"optional": True})


def _step(name: str, inputs: dict[str, Port], outputs: dict[str, Port], **fields: Any) -> StepSpec:
    return StepSpec(name=name, entry=f"steps.{name}:run", inputs=inputs, outputs=outputs, **fields)


PNG = Port(media_type="image/png", suffix=".png")
TEXT = Port(media_type="text/plain", suffix=".txt")
SOURCE = Port(media_type="application/octet-stream", suffix="")
FRAMES = _port("frames", "zip")
POSE = _port("pose", "json")
DEPTH_FIELD = _port("depth-field", "safetensors")
ASSET = _port("model", "zip")
GLB = Port(media_type="model/gltf-binary", suffix=".glb")
PLACEMENT = _port("placement", "json")
PLY = _port("gaussians", "ply")
MOTION = _port("motion", "safetensors")
PLAN = _port("mesh-plan", "json")
TRACKED = _port("tracked", "safetensors")
MESHES = _port("meshes", "zip")
CURVES = _port("curves", "json")
RANKING = _port("ranking", "json")
VIDEOS = _port("films", "zip")
GROUND_TRUTH = _port("truth", "zip")
GATES = _port("gates", "json")
SCORES = _port("scores", "json")
PACKAGE = _port("package", "zip")
BANK = _port("bank", "zip")
VIEWS = _port("views", "zip")
WEB_SPLATS = _port("splats", "websplats")
FACTS = _port("facts", "json")
EITHER_MESH = {"tracked": _optional(TRACKED), "meshes": _optional(MESHES)}

STEPS: dict[str, StepSpec] = {
    spec.name: spec
    for spec in (
        _step("draw_picture", {"text": TEXT}, {"picture": PNG}, sections=("text",), resource="gpu"),
        _step(
            "cut_out",
            inputs={"source": SOURCE},
            outputs={"picture": PNG, "matte": PNG, "facts": FACTS},
            sections=("subject",),
            timeout_s=60,  # somebody waits for it
        ),
        _step(
            "prepare_subject",
            inputs={
                "source": SOURCE,
                "mask": _optional(SOURCE),
                "depth": _optional(SOURCE),
                "layers": _optional(SOURCE),
            },
            outputs={
                "subject": PNG,
                "footage": _optional(FRAMES),
                "pose": _optional(POSE),
                "depth_field": _optional(DEPTH_FIELD),
                "cutout_gates": _optional(GATES),
                "picture": PNG,
            },
            sections=("subject", "gates.cutout"),
            timeout_s=2400,  # bounds decoders that hang in native code
        ),
        _step(
            "prepare_views",
            inputs={
                "views": VIEWS,
                "source": SOURCE,
                "mask": _optional(SOURCE),
                "subject": PNG,
                "footage": _optional(FRAMES),
            },
            outputs={"known_views": BANK, "picture": PNG},
            sections=("subject",),
            timeout_s=2400,  # as prepare_subject
        ),
        _step(
            "generate_views",
            inputs={"subject": PNG},
            outputs={"known_views": BANK, "picture": PNG},
            sections=("views", "subject.matting"),
            resource="gpu",
            timeout_s=14400,  # 15 views layer by layer
        ),
        _step(
            "drive_video",
            inputs={"subject": PNG, "depth_field": _optional(DEPTH_FIELD), "footage": _optional(FRAMES)},
            outputs={
                "driving_video": FRAMES,
                "picture": PNG,
                "candidates": _optional(PNG),
                "ranking": _optional(RANKING),
                "films": _optional(VIDEOS),
            },
            sections=("driving", "subject.turn_deg"),
            resource="gpu",
            late_imports=("dg4d_lib.kernels.compiling:preload_numba",),
        ),
        _step(
            "fit_gaussians",
            inputs={
                "subject": PNG,
                "pose": _optional(POSE),
                "depth_field": _optional(DEPTH_FIELD),
                "bank": _optional(BANK),
                "known_views": _optional(BANK),
            },
            outputs={"gaussians": PLY, "first_look": WEB_SPLATS, "curves": CURVES, "picture": PNG},
            sections=("rasterizer", "subject.turn_deg", "prior", "static"),
            resource="gpu",
            late_imports=("dg4d_lib.rasterizer.cpu",),
        ),
        _step(
            "fit_motion",
            inputs={
                "gaussians": PLY,
                "driving_video": FRAMES,
                "pose": _optional(POSE),
                "depth_field": _optional(DEPTH_FIELD),
                "bank": _optional(BANK),
                "known_views": _optional(BANK),
            },
            outputs={"motion": MOTION, "gaussians": _optional(PLY), "curves": CURVES, "picture": PNG},
            sections=("rasterizer", "subject.turn_deg", "prior", "deformation", "motion"),
            resource="gpu",
        ),
        _step(
            "prepare_asset",
            inputs={"model": ASSET, "subject": _optional(PNG)},
            outputs={
                "glb": _optional(GLB),
                "gaussians": PLY,
                "placement": PLACEMENT,
                "subject": _optional(PNG),
                "picture": PNG,
            },
            sections=("rasterizer", "asset", "subject.size", "subject.max_decode_gb"),
            timeout_s=2400,  # bounds decoders that hang in native code
        ),
        _step(
            "animate_asset",
            inputs={"gaussians": PLY, "glb": _optional(GLB), "placement": PLACEMENT, "driving_video": FRAMES},
            outputs={
                "motion": MOTION,
                "tracked": _optional(TRACKED),
                "moving": _optional(GLB),
                "curves": CURVES,
                "picture": PNG,
            },
            sections=(
                "rasterizer",
                "asset",
                "pack.gltf.interpolation",
                "pack.gltf.moving_normals",
                "mesh.texture_size",
            ),
            resource="gpu",
        ),
        _step(
            "plan_mesh",
            inputs={
                "gaussians": PLY,
                "motion": MOTION,
                "driving_video": _optional(FRAMES),
                "subject": _optional(PNG),
                "pose": _optional(POSE),
                "depth_field": _optional(DEPTH_FIELD),
            },
            outputs={"plan": PLAN},
            sections=("rasterizer", "subject.turn_deg", "mesh"),
        ),
        _step(
            "extract_mesh",
            inputs={
                "gaussians": PLY,
                "motion": MOTION,
                "plan": PLAN,
                "driving_video": _optional(FRAMES),
                "subject": _optional(PNG),
                "pose": _optional(POSE),
                "depth_field": _optional(DEPTH_FIELD),
            },
            outputs={**EITHER_MESH, "plan": _optional(PLAN), "picture": PNG},
            settings="steps.profiles:FrameRange",
            sections=("rasterizer", "subject.turn_deg", "mesh"),
        ),
        _step("join_meshes", {"meshes": MESHES.model_copy(update={"many": True})}, {"meshes": MESHES}),
        _step(
            "refine_texture",
            inputs={**EITHER_MESH, "subject": PNG, "driving_video": FRAMES},
            outputs=EITHER_MESH,
            sections=("refiner",),
            resource="gpu",
        ),
        _step(
            "pack_asset",
            inputs={"subject": PNG, "driving_video": FRAMES, "gaussians": PLY, "motion": MOTION, **EITHER_MESH}
            | {"moving": _optional(GLB)},
            outputs={"package": PACKAGE, "sheet": PNG},
            settings="steps.profiles:PackNotes",
            sections=("rasterizer", "pack"),
        ),
        _step(
            "check_asset",
            inputs={
                "package": PACKAGE,
                "driving_video": FRAMES,
                "subject": PNG,
                "cutout_gates": _optional(GATES),
            },
            outputs={"gates": GATES, "picture": PNG},
            sections=("rasterizer", "gates"),
        ),
        _step(
            "score_asset",
            inputs={"package": _optional(PACKAGE), "truth": GROUND_TRUTH},
            outputs={"scores": SCORES, "films": VIDEOS},
            settings="steps.profiles:ScoreAssetSettings",
            resource="gpu",
        ),
    )
}
