"""Blender imports an animated file and renders moments of it, unlit. Run by a Python that has `bpy`.

Usage: python blender.py JOB.json, where the job is
    {"file": "asset.glb" or ".usdz", "fps": frames per second of the scene, "size": pixels, "samples": per pixel,
     "shots": [{"frame": of the scene, may be fractional, "camera_to_world": rows, y up, the camera looks along its -z,
                "fov_y_deg": ..., "picture": "shot.png"}]}
Prints {"blender": version, "start": ..., "end": ..., "meshes": [[name, vertices], ...]} as its last line.
"""

import json
import math
import sys
from pathlib import Path
from typing import Any

import bpy
from mathutils import Matrix

Y_UP_TO_Z_UP = Matrix.Rotation(math.radians(90), 4, "X")  # what the importers do to both formats


def main(job: dict[str, Any]) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = math.ceil(job["fps"])
    scene.render.fps_base = scene.render.fps / job["fps"]
    if job["file"].endswith(".usdz"):
        bpy.ops.wm.usd_import(filepath=job["file"])
    else:
        bpy.ops.import_scene.gltf(filepath=job["file"])
    for material in bpy.data.materials:
        if material.node_tree:
            make_unlit(material.node_tree)
    prepare(scene, job["size"], job["samples"])
    for shot in job["shots"]:
        render(scene, shot)
    meshes = [[thing.name, len(thing.data.vertices)] for thing in bpy.data.objects if thing.type == "MESH"]
    result = {"blender": bpy.app.version_string, "start": scene.frame_start, "end": scene.frame_end, "meshes": meshes}
    sys.stdout.write(json.dumps(result) + "\n")


def make_unlit(tree: Any) -> None:
    """Show the base color of a material as it is."""
    surface = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
    output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
    light = tree.nodes.new("ShaderNodeEmission")
    color = surface.inputs["Base Color"]
    if color.links:
        tree.links.new(color.links[0].from_socket, light.inputs["Color"])
    else:
        light.inputs["Color"].default_value = color.default_value
    tree.links.new(light.outputs["Emission"], output.inputs["Surface"])


def prepare(scene: Any, size: int, samples: int) -> None:
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = samples
    scene.cycles.use_denoising = False
    scene.render.film_transparent = True
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "RGBA"
    scene.view_settings.view_transform = "Standard"  # colors of the texture come out as they went in
    scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(scene.camera)


def render(scene: Any, shot: dict[str, Any]) -> None:
    scene.frame_set(int(shot["frame"]), subframe=shot["frame"] % 1)
    camera = scene.camera
    camera.data.sensor_fit = "VERTICAL"
    camera.data.angle = math.radians(shot["fov_y_deg"])
    camera.data.clip_start = 0.01
    camera.matrix_world = Y_UP_TO_Z_UP @ Matrix(shot["camera_to_world"])
    scene.render.filepath = shot["picture"]
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[1]).read_text()))
