"""Composition of several animated GLBs into one, with placement, rotation, scale and timing.

Vertices, images, materials and extensions are copied unchanged; data of a file that is used twice is stored once. Every
asset is the child of a node with its name. A single animation of the scene's duration moves all assets, because players
play one animation at a time. An asset shows its first frame until it starts. One that does not loop plays once, without
the return to the first frame that ends its animation, and stands in its last pose from then on.
"""

import math
import re
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dg4d_lib.assets.formats.foreign_nodes import global_matrices
from dg4d_lib.assets.formats.gltf import GlbReader, GltfDocument
from dg4d_lib.assets.formats.tracks import POINTER
from dg4d_lib.assets.scenes.scene import SceneItem
from dg4d_lib.errors import BadInput

ANIMATION = "scene"
SHORTEST_S = 1e-4  # minimum distance of keys, seconds; closer keys are merged
MAX_LOOPS = 10_000  # of an animation; each loop repeats its keys in the file
Vector = Float[np.ndarray, " 3"]
# Raised by files of other layouts.
_FOREIGN = (KeyError, IndexError, TypeError, ValueError, ArithmeticError, RecursionError)


class AnimatedGlb:
    """Animated GLB with its bounding box and duration.

    Attributes:
        file: the parsed GLB.
        box_min: lower corner of the bounding box over all frames, meters.
        box_max: upper corner of the bounding box over all frames, meters.
        foot: standing point: below the center of the box, at the lowest point of the first frame.
        duration_s: duration of the animation, seconds; 0 if there is none.
        last_pose_s: time of the last key before the return to the first frame, seconds.
    """

    def __init__(self, content: bytes, return_s: float = 0.0) -> None:
        """Parse a GLB.

        Args:
            content: the file.
            return_s: duration of the return to the first frame at the end of the animation, seconds; it takes at least
                the time between the last two keys.

        Raises:
            BadInput: the file is not a GLB, has no mesh, or has a layout that dg4d does not write.
            BackendUnavailable: the file is compressed and meshoptimizer is missing.
        """
        self.file = GlbReader(content)
        try:
            matrices = global_matrices(self.file.tree, unscaled=self._toggled)
            # Backwards, the meshes are in the order of the file, so that the first pose is that of frame 0.
            poses = [pose for node in reversed(matrices) for pose in self._poses(node, matrices[node])]
            if not poses:
                raise BadInput("this GLB has no mesh; give an asset that `dg4d make` wrote")
            self.box_min: Vector = np.min([pose.min(0) for pose in poses], axis=0)
            self.box_max: Vector = np.max([pose.max(0) for pose in poses], axis=0)
            middle = (self.box_min + self.box_max) / 2
            self.foot: Vector = np.array((middle[0], poses[0][:, 1].min(), middle[2]))
            keys = np.concatenate([np.zeros(1), *(self.file.accessor(s["input"])[:, 0] for s in self._samplers)])
            self.duration_s = float(keys.max())
            before = keys <= self.duration_s - max(return_s - SHORTEST_S, SHORTEST_S)
            self.last_pose_s = float(keys[before].max(initial=0.0))
        except _FOREIGN as error:
            raise BadInput(
                f"this GLB is not an animated asset ({error!r}); give an asset that `dg4d make` wrote"
            ) from error

    @property
    def roots(self) -> list[int]:
        """Root nodes of its scene."""
        tree = self.file.tree
        return list(tree["scenes"][tree.get("scene", 0)]["nodes"])

    @property
    def animation(self) -> dict[str, Any]:
        """Its only animation; an empty one if there is none.

        Raises:
            BadInput: the file has several animations.
        """
        animations = self.file.tree.get("animations", [])
        if len(animations) > 1:
            raise BadInput(f"this GLB has {len(animations)} animations, at most one is allowed; export it with one")
        return animations[0] if animations else {"samplers": [], "channels": []}

    @property
    def _samplers(self) -> list[dict[str, Any]]:
        return list(self.animation["samplers"])

    @property
    def _toggled(self) -> set[int]:
        """Nodes that an animated scale shows and hides; they count as shown."""
        targets = (channel["target"] for channel in self.animation["channels"])
        return {target["node"] for target in targets if target["path"] == "scale"}

    def _poses(self, number: int, matrix: Float[np.ndarray, "4 4"]) -> list[Float[np.ndarray, "v 3"]]:
        """Return the world positions of all vertices of a node with this global matrix, in all poses."""
        node = self.file.tree["nodes"][number]
        poses = []
        if "mesh" in node:
            for primitive in self.file.tree["meshes"][node["mesh"]]["primitives"]:
                rest = self.file.accessor(primitive["attributes"]["POSITION"]).astype(np.float64)
                poses += [
                    (rest + offsets) @ matrix[:3, :3].T + matrix[:3, 3] for offsets in self._offsets(number, primitive)
                ]
        return poses

    def _offsets(self, number: int, primitive: dict[str, Any]) -> list[NDArray[np.float64]]:
        """Return the offsets of a node's vertices at every key of its weights."""
        targets = [self.file.accessor(target["POSITION"]) for target in primitive.get("targets", ())]
        tracks = [
            self._samplers[channel["sampler"]]
            for channel in self.animation["channels"]
            if channel["target"].get("node") == number and channel["target"]["path"] == "weights"
        ]
        if not targets or not tracks:
            return [np.zeros(3)]
        rows = self.file.accessor(tracks[0]["output"]).reshape(-1, len(targets)).astype(np.float64)
        unique = dict.fromkeys(map(tuple, rows.tolist()))  # the first key first
        return [
            np.sum(
                [weight * target.astype(np.float64) for weight, target in zip(row, targets, strict=True) if weight]
                or [np.zeros(3)],
                0,
            )
            for row in unique
        ]


@dataclass(frozen=True)
class Actor:
    """Asset placed in a scene.

    Attributes:
        name: unique name of its node.
        glb: the animated mesh.
        item: placement and timing.
    """

    name: str
    glb: AnimatedGlb
    item: SceneItem

    @property
    def rotation(self) -> Rotation:
        """Rotation in the scene."""
        return Rotation.from_euler("xyz", self.item.rotation_deg, degrees=True)

    @property
    def origin(self) -> Vector:
        """Position of the asset's origin in the scene, meters."""
        return np.array(self.item.position) - self.rotation.apply(self.glb.foot) * self.item.scale

    @property
    def transform(self) -> Float[np.ndarray, "4 4"]:
        """Matrix from asset to scene; acts on column vectors."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation.as_matrix() * self.item.scale
        matrix[:3, 3] = self.origin
        return matrix

    @property
    def end_s(self) -> float:
        """Time at which the animation has played once, seconds."""
        return self.item.start_s + self.glb.duration_s / self.item.speed

    def animation_times(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert times of the scene to times of the asset's animation."""
        played = (times_s - self.item.start_s).clip(0) * self.item.speed
        if self.item.loop and self.glb.duration_s > 0:
            return played % self.glb.duration_s
        return played.clip(max=self.glb.duration_s if self.item.loop else self.glb.last_pose_s)


def line_up(glbs: Sequence[AnimatedGlb], spacing: float) -> list[tuple[float, float, float]]:
    """Return foot positions of assets side by side along x, centered at 0, with a spacing between their boxes."""
    widths = [float(glb.box_max[0] - glb.box_min[0]) for glb in glbs]
    starts = np.cumsum([0.0, *(width + spacing for width in widths)])
    center = (starts[-1] - spacing) / 2
    return [(float(start + width / 2 - center), 0.0, 0.0) for start, width in zip(starts, widths, strict=False)]


def scene_duration(actors: Sequence[Actor], duration_s: float | None) -> float:
    """Return the duration of a scene in seconds: as given, or until every asset has played once.

    Raises:
        BadInput: an asset would start after the end.
    """
    length = max(actor.end_s for actor in actors) if duration_s is None else duration_s
    for actor in actors:
        if actor.glb.duration_s > 0 and actor.item.start_s + SHORTEST_S >= length:
            raise BadInput(
                f"{actor.name} starts at {actor.item.start_s} s, after the end of the scene at {length} s; lower its "
                "start_s or raise duration_s"
            )
    return length


def compose_glb(actors: Sequence[Actor], duration_s: float | None = None) -> bytes:
    """Encode a scene as GLB.

    Args:
        actors: assets with unique names.
        duration_s: duration of the animation; None: until every asset has played once.

    Raises:
        BadInput: no actors, one that starts after the end, or one with a layout that dg4d does not write.
    """
    if not actors:
        raise BadInput("a scene needs at least one asset; given none")
    length = scene_duration(actors, duration_s)
    document = GltfDocument({})
    shared: dict[int, dict[tuple[str, int], int]] = {}
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    nodes = []
    for actor in actors:
        transfer = _Transfer(document, actor, shared.setdefault(id(actor.glb), {}))
        try:
            nodes.append(transfer.add_node())
            _add_tracks(transfer, length, samplers, channels)
        except _FOREIGN as error:
            raise BadInput(
                f"{actor.name} is not an animated asset ({error!r}); give an asset that `dg4d make` wrote"
            ) from error
    if channels:
        document.add("animations", name=ANIMATION, samplers=samplers, channels=channels)
    document.tree["scene"] = document.add("scenes", name=ANIMATION, nodes=nodes)
    return document.to_bytes()


class _Transfer:
    """Copier of an actor's glTF items into a document: each item once, data once for all actors with the same GLB."""

    def __init__(self, document: GltfDocument, actor: Actor, shared: dict[tuple[str, int], int]) -> None:
        self.document, self.actor = document, actor
        self._file, self._shared = actor.glb.file, shared
        self._own: dict[tuple[str, int], int] = {}
        required = self._file.tree.get("extensionsRequired", [])
        for extension in self._file.tree.get("extensionsUsed", []):
            document.use_extension(extension, required=extension in required)

    def add_node(self) -> int:
        """Add the actor's node with all its descendants; return its index."""
        return self.document.add(
            "nodes",
            name=self.actor.name,
            translation=self.actor.origin.tolist(),
            rotation=self.actor.rotation.as_quat(canonical=True).tolist(),
            scale=[self.actor.item.scale] * 3,
            children=[self.node(root) for root in self.actor.glb.roots],
            extras=self._file.tree["asset"].get("extras"),
        )

    def node(self, number: int) -> int:
        """Copy a node with its children, if not done before; return its index in the document."""

        def change(node: dict[str, Any]) -> None:
            if "mesh" in node:
                node["mesh"] = self._copy("meshes", node["mesh"], self._change_mesh)
            if "children" in node:
                node["children"] = [self.node(child) for child in node["children"]]
            if {"skin", "camera"} & node.keys():
                raise BadInput(f"{self.actor.name} has a skin or a camera, which scenes do not support; use asset.glb")

        return self._copy("nodes", number, change)

    def pointer(self, text: str) -> str:
        """Translate a path of KHR_animation_pointer to the indices of the document."""
        _, collection, number, rest = re.split(r"^/(\w+)/(\d+)", text)
        return f"/{collection}/{self._own[collection, int(number)]}{rest}"

    def _copy(self, collection: str, number: int, change: Callable[[dict[str, Any]], None]) -> int:
        """Copy an item that the actor does not share, if not done before; return its index in the document."""
        key = (collection, number)
        if key not in self._own:
            item = deepcopy(self._file.tree[collection][number])
            change(item)
            item["name"] = f"{self.actor.name} {item.get('name', number)}"
            self._own[key] = self.document.add(collection, **item)
        return self._own[key]

    def _change_mesh(self, mesh: dict[str, Any]) -> None:
        for primitive in mesh["primitives"]:
            primitive["indices"] = self._data("accessors", primitive["indices"])
            for attributes in (primitive["attributes"], *primitive.get("targets", ())):
                attributes.update({name: self._data("accessors", number) for name, number in attributes.items()})
            primitive["material"] = self._copy("materials", primitive["material"], self._change_material)

    def _change_material(self, material: dict[str, Any]) -> None:
        texture = material["pbrMetallicRoughness"]["baseColorTexture"]
        texture["index"] = self._copy("textures", texture["index"], self._change_texture)

    def _change_texture(self, texture: dict[str, Any]) -> None:
        texture["sampler"] = self._data("samplers", texture["sampler"])
        for holder in (texture, *texture.get("extensions", {}).values()):
            holder["source"] = self._data("images", holder["source"])

    def _data(self, collection: str, number: int) -> int:
        """Copy an item that all actors of this GLB share, if not done before; return its index in the document."""
        key = (collection, number)
        if key not in self._shared:
            item = {**self._file.tree[collection][number]}
            if "bufferView" in item:
                item["bufferView"] = self._view(item["bufferView"])
            self._shared[key] = self.document.add(collection, **item)
        return self._shared[key]

    def _view(self, number: int) -> int:
        key = ("bufferViews", number)
        if key not in self._shared:
            self._shared[key] = self.document.add_view_of(self._file, number)
        return self._shared[key]


def _add_tracks(
    transfer: _Transfer, length: float, samplers: list[dict[str, Any]], channels: list[dict[str, Any]]
) -> None:
    """Append an actor's animation, shifted and scaled in time, to the samplers and channels of the scene."""
    actor, document, animation = transfer.actor, transfer.document, transfer.actor.glb.animation
    inputs: dict[bytes, int] = {}
    for channel in animation["channels"]:
        sampler, target = animation["samplers"][channel["sampler"]], deepcopy(channel["target"])
        if target["path"] == "pointer":
            pointer = target["extensions"][POINTER]
            pointer["pointer"] = transfer.pointer(pointer["pointer"])
        else:
            target["node"] = transfer.node(target["node"])
        keys = actor.glb.file.accessor(sampler["input"])[:, 0].astype(np.float64)
        output = actor.glb.file.accessor(sampler["output"])
        rows = output.reshape(len(keys), -1)
        times, values = _retime(actor, keys, rows, length, sampler.get("interpolation", "LINEAR"))
        content = times.tobytes()
        if content not in inputs:
            inputs[content] = document.add_accessor(f"{actor.name} times", times)
        name = actor.glb.file.tree["accessors"][sampler["output"]].get("name", target["path"])
        number = document.add_accessor(f"{actor.name} {name}", values.reshape(-1, output.shape[1]))
        channels.append({"sampler": len(samplers), "target": target})
        samplers.append({**sampler, "input": inputs[content], "output": number})


def _retime(
    actor: Actor, keys: NDArray[np.float64], rows: NDArray[Any], length: float, interpolation: str
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return keys and values of a track at the actor's times, from its start to the end of the scene."""
    if interpolation == "CUBICSPLINE":
        raise BadInput(f"{actor.name} is animated by cubic splines, which scenes do not support; use asset.glb")
    period, speed = actor.glb.duration_s, actor.item.speed
    if not actor.item.loop:
        played = keys <= max(actor.glb.last_pose_s + SHORTEST_S, keys[0])
        keys, rows = keys[played], rows[played]
    keys, rows = _cover_period(keys, rows, period)
    loops = math.ceil((length - actor.item.start_s) * speed / period) if actor.item.loop else 1
    if loops > MAX_LOOPS:
        raise BadInput(f"{actor.name} would play {loops} times, at most {MAX_LOOPS} are allowed; lower its speed")
    times = np.concatenate([actor.item.start_s + (keys + period * loop) / speed for loop in range(loops)])
    values = np.concatenate([rows] * loops).astype(np.float64)
    kept = _apart(times)
    times, values = times[kept], values[kept]
    inside = times < length - SHORTEST_S
    after = int(inside.sum())
    last = values[after - 1]
    if interpolation == "LINEAR" and after < len(times):
        share = (length - times[after - 1]) / (times[after] - times[after - 1])
        last = last + min(share, 1.0) * (values[after] - last)
    times, values = np.append(times[inside], length), np.append(values[inside], last[None], axis=0)
    return times.astype("<f4"), values.astype("<f4")


def _apart(times: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which keys to keep so that all are more than `SHORTEST_S` apart.

    Of two keys at one time, as the end of a loop and the start of the next, the second is kept; of all, the first and
    the last, which the asset shows before its start and after its end.
    """
    kept, following = np.zeros(len(times), bool), math.inf
    for index in reversed(range(len(times))):
        if following - times[index] > SHORTEST_S:
            kept[index], following = True, times[index]
    if kept.sum() > 1:
        kept[kept.argmax()] = False
        kept[0] = True
    return kept


def _cover_period(
    keys: NDArray[np.float64], rows: NDArray[Any], period: float
) -> tuple[NDArray[np.float64], NDArray[Any]]:
    """Add keys at both ends of the animation, because players hold the first and the last value."""
    if keys[0] > SHORTEST_S:
        keys, rows = np.append(0.0, keys), np.append(rows[:1], rows, axis=0)
    if keys[-1] < period - SHORTEST_S:
        keys, rows = np.append(keys, period), np.append(rows, rows[-1:], axis=0)
    return keys, rows
