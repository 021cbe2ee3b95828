"""Refine the texture, and give the mesh the clock of the driving video."""

from dataclasses import replace

import torch

from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.texture.refine import refine_texture
from dg4d_lib.texture.refiner import Identity
from steps.job import Facts, Job
from steps.media import frame_rate
from steps.meshfiles import read_meshes, read_tracked, write_meshes, write_tracked


def run(job: Job) -> Facts:
    """Refine the mesh that moves, or every frame's own."""
    refiner = Identity()  # the only kind of RefinerSettings
    fps = frame_rate(job.inputs["driving_video"])
    if "tracked" in job.inputs:
        asset = read_tracked(job.inputs["tracked"])
        texture = refine_texture(asset.mesh, asset.offsets, refiner)
        refined = replace(asset.mesh, texture=texture)
        write_tracked(job.outputs["tracked"], Asset4D(refined, asset.offsets, fps, asset.extras))
    if "meshes" in job.inputs:
        still = [(mesh, torch.zeros(1, *mesh.vertices.shape)) for mesh in read_meshes(job.inputs["meshes"])]
        textures = [refine_texture(mesh, rest, refiner) for mesh, rest in still]
        meshes = [replace(mesh, texture=texture) for (mesh, _), texture in zip(still, textures, strict=True)]
        write_meshes(job.outputs["meshes"], dict(enumerate(meshes)))
    return Facts()
