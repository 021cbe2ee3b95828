"""GLB of a user's model in another format: a mesh, node and material per part, with their names."""

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dg4d_lib.assets.formats.gltf import INDEX_DATA, VERTEX_DATA, GltfDocument
from dg4d_lib.mesh.models.model import REPEATED, Model, ModelPart, Wraps


def write_model_glb(model: Model) -> bytes:
    """Encode a model at rest; textures as PNG, each stored once."""
    document = GltfDocument({})
    textures = _Textures(document)
    nodes = []
    for part in model.parts:
        attributes = {"POSITION": document.add_accessor(part.name, part.vertices.astype("<f4"), VERTEX_DATA)}
        shading: dict[str, object] = {
            "baseColorFactor": [*_colors(np.array(part.factor)).tolist(), 1.0],
            "metallicFactor": 0.0,
        }
        if part.uvs is not None:
            uvs = document.add_accessor(f"{part.name} uvs", _numbers(part.uvs), VERTEX_DATA)
            attributes["TEXCOORD_0"] = uvs
        if part.texture is not None and part.uvs is not None:
            shading["baseColorTexture"] = {"index": textures.add(part, part.texture)}
        if part.colors is not None:
            colors = document.add_accessor(f"{part.name} colors", _colors(part.colors), VERTEX_DATA)
            attributes["COLOR_0"] = colors
        mode = "MASK" if part.masked else None
        material = document.add(
            "materials", name=part.name, pbrMetallicRoughness=shading, alphaMode=mode, doubleSided=True
        )
        indices = document.add_accessor(f"{part.name} triangles", part.faces.ravel().astype("<u4"), INDEX_DATA)
        primitive = {"attributes": attributes, "indices": indices, "material": material}
        mesh = document.add("meshes", name=part.name, primitives=[primitive])
        nodes.append(document.add("nodes", name=part.name, mesh=mesh))
    document.tree["scene"] = document.add("scenes", name="model", nodes=nodes)
    return document.to_bytes()


def _numbers(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """Convert to float32; NaN becomes 0 and values out of range are clamped."""
    with np.errstate(over="ignore"):
        return np.nan_to_num(values.astype("<f4"))


def _colors(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return float32 in [0, 1], as glTF demands of colors."""
    return _numbers(values).clip(0, 1)


class _Textures:
    """Textures of a document: pictures, samplers and their pairs, each stored once."""

    def __init__(self, document: GltfDocument) -> None:
        self.document = document
        self.images: dict[int, int] = {}
        self.samplers: dict[Wraps, int] = {}
        self.pairs: dict[tuple[int, int | None], int] = {}

    def add(self, part: ModelPart, pixels: NDArray[np.uint8]) -> int:
        """Return the number of the texture of a part."""
        if id(pixels) not in self.images:
            buffer = io.BytesIO()
            Image.fromarray(pixels).save(buffer, "PNG")
            view = self.document.add_view(part.name, buffer.getvalue())
            self.images[id(pixels)] = self.document.add("images", name=part.name, mimeType="image/png", bufferView=view)
        if part.wrap != REPEATED and part.wrap not in self.samplers:
            along_u, along_v = map(int, part.wrap)
            self.samplers[part.wrap] = self.document.add("samplers", wrapS=along_u, wrapT=along_v)
        pair = self.images[id(pixels)], self.samplers.get(part.wrap)
        if pair not in self.pairs:
            self.pairs[pair] = self.document.add("textures", name=part.name, source=pair[0], sampler=pair[1])
        return self.pairs[pair]
