"""Names of the files in a package, with a line on each; imports no torch."""

from pathlib import PurePosixPath

MANIFEST = "asset.json"
ASSET = "asset.glb"
MERGED = "asset_merged.glb"
RIGGED = "asset_rigged.glb"
PLAYBACK = "asset_playback.glb"
USD = "asset.usdz"
USD_SPLATS = "asset_splats.usdz"
SPLATS = "splats"
WEB_SPLATS = "splats/moving.websplats"
MESHES = "meshes"
LEVELS = "lod"
GAUSSIANS = "canonical/gaussians.ply"
COMPACT = "canonical/asset4d.safetensors"
SUBJECT = "input/subject.png"
DRIVING = "input/driving.mp4"
PREVIEW = "preview.mp4"
TURNTABLE = "turntable.mp4"
MOVING_PICTURE = "preview.webp"
SHEET = "contact_sheet.png"

ABOUT = {
    ASSET: "animated textured mesh, glTF 2.0",
    MERGED: "the user's model, animated, as one mesh with one texture, glTF 2.0",
    RIGGED: "the same mesh on a skeleton, glTF 2.0",
    PLAYBACK: "the same mesh on a skeleton that follows the motion roughly, glTF 2.0",
    USD: "animated mesh, on a skeleton if one follows the motion, USDZ",
    USD_SPLATS: "moving splats, and as a variant point samples of the mesh, USDZ",
    WEB_SPLATS: "splats of all frames, format of the viewer",
    GAUSSIANS: "Gaussians in the canonical pose, 3DGS PLY",
    COMPACT: "Gaussians and their deformation over time, safetensors",
    SUBJECT: "input picture, cut out",
    DRIVING: "driving video, MP4",
    PREVIEW: "preview of the animation with an orbiting camera, MP4",
    TURNTABLE: "first frame on a turntable, MP4",
    MOVING_PICTURE: "preview of the animation, animated WebP",
    SHEET: "contact sheet: columns are frames, rows are azimuths",
}
ABOUT_FOLDERS = {
    (SPLATS, ".ply"): "Gaussians of one frame, 3DGS PLY in OpenCV axes (y down)",
    (SPLATS, ".spz"): "Gaussians of one frame, SPZ (y up)",
    (SPLATS, ".glb"): "Gaussians of one frame, glTF with KHR_gaussian_splatting",
    (MESHES, ".glb"): "textured mesh of one frame, glTF 2.0",
    (LEVELS, ".glb"): "the animated mesh with fewer triangles, glTF 2.0",
}


def about(name: str) -> str:
    """Return one line on a file of a package, by its name there."""
    path = PurePosixPath(name)
    return ABOUT.get(name) or ABOUT_FOLDERS[path.parts[0], path.suffix]
