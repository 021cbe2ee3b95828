"""Network of the shape prior: a picture becomes occupancy, hidden colors and a mirror plane.

A U-Net whose coarsest level is a small transformer. Every pixel is a ray of the input camera; along it the network
gives the probability that a depth lies inside the subject. Probabilities near one half are its uncertainty.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn import functional

from dg4d_lib.errors import BadInput
from dg4d_lib.shape_prior.frustum import BINS, KNOTS, SIZE

FORMAT = "dg4d shape prior 1"  # of the weights file; another number: another network
GROUPS = 8  # of the group normalization
VISIBLE = 0.05  # alpha above which a pixel counts for the subject's extent
PLANE_NUMBERS = 6 + 3 + 1  # upper triangle of the normal's outer product, nearest point to the origin, logit


@dataclass(frozen=True)
class ShapePriorConfig:
    """Sizes of the network.

    Attributes:
        widths: channels at 64, 32 and 16 pixels, and of the tokens at 8 x 8.
        blocks: residual blocks at each of the first three levels, on the way down and on the way up.
        layers: transformer layers.
        head: hidden width of the network that every ray goes through.

    Raises:
        BadInput: the widths do not suit the normalization or the attention heads.
    """

    widths: tuple[int, int, int, int] = (32, 48, 96, 192)
    blocks: tuple[int, int, int] = (1, 1, 2)
    layers: int = 4
    head: int = 96

    def __post_init__(self) -> None:
        steps = (GROUPS, GROUPS, GROUPS, _Layer.HEAD)
        if any(width < 1 or width % step for width, step in zip(self.widths, steps, strict=True)):
            raise BadInput(
                f"widths {' '.join(map(str, self.widths))} do not fit the network; give three multiples of {GROUPS} "
                f"(groups of the normalization) and one of {_Layer.HEAD} (width of an attention head)"
            )


@dataclass(frozen=True)
class Features:
    """Encoded picture.

    Attributes:
        picture: premultiplied color, alpha and coordinates of every pixel.
        levels: features at 64, 32, 16 and 8 pixels.
        code: of the subject as a whole; frames of one subject may share its mean.
    """

    picture: Float[Tensor, "b p 128 128"]
    levels: tuple[Float[Tensor, "b _ _ _"], ...]
    code: Float[Tensor, "b c"]


class ShapePriorNetwork(nn.Module):
    """Picture to matter on the rays of the input camera."""

    def __init__(self, config: ShapePriorConfig | None = None) -> None:
        super().__init__()
        self.config = config or ShapePriorConfig()
        widths = self.config.widths
        self.stem = nn.Conv2d(16 + 4, widths[0], 3, padding=1)
        self.down = nn.ModuleList(nn.Conv2d(widths[i], widths[i + 1], 2, stride=2) for i in range(3))
        self.inward = nn.ModuleList(_stage(widths[i], self.config.blocks[i]) for i in range(3))
        self.places = nn.Parameter(0.02 * torch.randn(1 + (SIZE // 16) ** 2, widths[3]))
        self.layers = nn.ModuleList(_Layer(widths[3]) for _ in range(self.config.layers))
        self.code_norm = nn.LayerNorm(widths[3])
        self.up = nn.ModuleList(nn.Conv2d(widths[i + 1], widths[i], 1) for i in range(3))
        self.outward = nn.ModuleList(_stage(widths[i], self.config.blocks[i]) for i in range(3))
        self.modulate = nn.ModuleList(nn.Linear(widths[3], 2 * widths[i]) for i in range(3))
        self.refine = nn.Linear(widths[0] + 8, self.config.head)
        self.head = nn.Linear(self.config.head, BINS + 4 * KNOTS + 1)
        self.plane = nn.Linear(widths[3], PLANE_NUMBERS)
        with torch.no_grad():
            self.head.bias[:BINS] = -1.5  # about a fifth of the cells behind a subject's pixels are inside it
            self.head.bias[-KNOTS - 1 : -1] = 1.0  # hidden surfaces begin with the color of their pixel
            for value in self.modulate.parameters():
                value.zero_()

    def encode(self, picture: Float[Tensor, "b 4 128 128"]) -> Features:
        """Encode pictures with premultiplied color and alpha in [0, 1]."""
        planes = torch.cat([picture, coordinates(picture[:, 3])], 1)
        x = torch.cat([functional.pixel_unshuffle(picture, 2), planes[:, 4:, ::2, ::2]], 1)
        x = self.stem(x.contiguous(memory_format=torch.channels_last))
        levels = []
        for stage, down in zip(self.inward, self.down, strict=True):
            x = stage(x)
            levels.append(x)
            x = down(x)
        tokens = x.flatten(2).transpose(1, 2)
        tokens = torch.cat([tokens.mean(1, keepdim=True), tokens], 1) + self.places
        for layer in self.layers:
            tokens = layer(tokens)
        grid = tokens[:, 1:].transpose(1, 2).reshape(x.shape)
        return Features(planes, (*levels, grid), self.code_norm(tokens[:, 0]))

    def decode(self, features: Features, code: Float[Tensor, "b c"] | None = None) -> Float[Tensor, "b f 64 64"]:
        """Return the features that `rays` turns into its output.

        Args:
            features: of `encode`.
            code: instead of the pictures' own codes, such as the mean over the frames of a video.
        """
        code = features.code if code is None else code
        x = features.levels[3]
        for i in (2, 1, 0):
            x = functional.interpolate(self.up[i](x), scale_factor=2.0, mode="nearest") + features.levels[i]
            scale, shift = self.modulate[i](code)[..., None, None].chunk(2, 1)
            x = self.outward[i](x * (1 + scale) + shift)
        return functional.silu(x)

    def rays(
        self, decoded: Float[Tensor, "b f 64 64"], planes: Float[Tensor, "b p 128 128"], pixels: Int[Tensor, " n"]
    ) -> tuple[Float[Tensor, "n 64"], Float[Tensor, "n 8 3"], Float[Tensor, "n 1"]]:
        """Predict matter and colors on some rays.

        Args:
            decoded: of `decode`; linear between its pixels.
            planes: `Features.picture`.
            pixels: flat indices into batch, row and column.

        Returns:
            Occupancy logits at the middle of every cell of the frustum, the nearest first; colors in [0, 1] of surfaces
            that the picture does not show, at `KNOTS` depths from `NEAR` to `FAR`; and their expected absolute error.
        """
        batch, row, column = pixels // SIZE**2, pixels // SIZE % SIZE, pixels % SIZE
        cells = decoded.permute(0, 2, 3, 1).flatten(0, 2)
        found = torch.zeros((), device=decoded.device)
        for y, y_share in _neighbors(row):
            for x, x_share in _neighbors(column):
                share = (y_share * x_share)[:, None]
                found = found + share * cells[(batch * (SIZE // 2) + y) * (SIZE // 2) + x]
        own = planes[batch, :, row, column]
        numbers = self.head(functional.silu(self.refine(torch.cat([found, own], -1))))
        occupancy, other, keep, scale = numbers.split((BINS, 3 * KNOTS, KNOTS, 1), -1)
        pixel = (own[:, :3] / own[:, 3:4].clamp(min=VISIBLE)).clamp(0, 1)
        colors = torch.lerp(other.unflatten(-1, (KNOTS, 3)).sigmoid(), pixel[:, None], keep.sigmoid()[..., None])
        return occupancy, colors, functional.softplus(scale - 2) + 0.01

    def mirror(
        self, code: Float[Tensor, "b c"]
    ) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"], Float[Tensor, " b"]]:
        """Predict the mirror plane of a subject.

        Args:
            code: of `encode`, or another; see `decode`.

        Returns:
            Expected outer product of the plane's unit normal with itself (world axes): its largest eigenvector is the
            normal, and the eigenvalue, from 1/3 to 1, says how sure that is; the point of the plane nearest to the
            origin, world units; and the logit of the subject having a mirror plane.
        """
        numbers = self.plane(code)
        rows, columns = torch.triu_indices(3, 3)
        moment = numbers.new_zeros(len(numbers), 3, 3)
        moment[:, rows, columns] = numbers[:, :6]
        moment = moment + moment.triu(1).transpose(1, 2) + torch.eye(3, device=moment.device) / 3
        return moment, numbers[:, 6:9], numbers[:, 9]


def coordinates(alpha: Float[Tensor, "b h w"]) -> Float[Tensor, "b 4 h w"]:
    """Return x and y of every pixel in the frame, and in the subject's box, from -1 to 1 inside."""
    batch, height, width = alpha.shape
    rows = (torch.arange(height, device=alpha.device, dtype=alpha.dtype) + 0.5) / height * 2 - 1
    columns = (torch.arange(width, device=alpha.device, dtype=alpha.dtype) + 0.5) / width * 2 - 1
    seen = alpha > VISIBLE
    planes = []
    for places, used in ((columns, seen.any(1)), (rows, seen.any(2))):
        low = torch.where(used, places, 1.0).amin(1, keepdim=True)
        high = torch.where(used, places, -1.0).amax(1, keepdim=True)
        half = ((high - low) / 2).clamp(min=1 / width)
        planes += [places.expand(batch, -1), ((places - (low + high) / 2) / half).clamp(-2, 2)]
    x, x_inside, y, y_inside = planes
    across = [plane[:, None, :].expand(batch, height, width) for plane in (x, x_inside)]
    down = [plane[:, :, None].expand(batch, height, width) for plane in (y, y_inside)]
    return torch.stack([*across, *down], 1)


def _neighbors(place: Int[Tensor, " n"]) -> list[tuple[Int[Tensor, " n"], Float[Tensor, " n"]]]:
    """Return the two pixels of the half-size grid around a pixel, with their shares in linear interpolation."""
    own, odd = place // 2, place % 2
    other = (own + 2 * odd - 1).clamp(0, SIZE // 2 - 1)
    near = torch.full(place.shape, 0.75, device=place.device)
    return [(own, near), (other, 1 - near)]


def channels_last(network: ShapePriorNetwork) -> ShapePriorNetwork:
    """Return the network with its convolutions in the order that processors run fastest."""
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stub knows dtypes and devices only
    return network


def save_network(network: ShapePriorNetwork, path: Path) -> None:
    """Write the weights as float16 safetensors, with the sizes in the header."""
    tensors = {name: value.detach().half().contiguous() for name, value in network.state_dict().items()}
    sizes = {
        name: " ".join(map(str, value if isinstance(value, tuple) else (value,)))
        for name, value in asdict(network.config).items()
    }
    save_file(tensors, path, {"format": FORMAT, **sizes})


def load_network(path: Path) -> ShapePriorNetwork:
    """Read a network that `save_network` wrote, in float32, for inference.

    Raises:
        BadInput: the file cannot be read, is of another format, or holds numbers that are not finite.
    """
    try:
        network = _read_network(path)
    except (OSError, SafetensorError, KeyError, ValueError, RuntimeError) as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise BadInput(f"{path} cannot be read as weights of the shape prior: {reason}") from error
    if broken := not_finite(network.state_dict()):
        raise BadInput(f"{path} is damaged: {broken[0]} has values that are not finite; train or download it again")
    return network


def not_finite(tensors: Mapping[str, Tensor]) -> list[str]:
    """Return the names of tensors with values that are not finite."""
    return [name for name, tensor in tensors.items() if not tensor.isfinite().all()]


def _read_network(path: Path) -> ShapePriorNetwork:
    with safe_open(path, "pt") as file:
        header = file.metadata() or {}
        if header.get("format") != FORMAT:
            raise BadInput(f"{path}: format {header.get('format')!r} is not {FORMAT!r}; train again or update dg4d")
        widths = tuple(map(int, header["widths"].split()))
        blocks = tuple(map(int, header["blocks"].split()))
        config = ShapePriorConfig(widths, blocks, int(header["layers"]), int(header["head"]))  # type: ignore[arg-type]  # length checked by the state
        network = ShapePriorNetwork(config)
        network.load_state_dict({name: file.get_tensor(name).float() for name in file.keys()})  # noqa: SIM118
    return channels_last(network.eval())


def _stage(width: int, blocks: int) -> nn.Sequential:
    return nn.Sequential(*(_Block(width) for _ in range(blocks)))


class _Block(nn.Module):
    """Residual block of two convolutions."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(GROUPS, width)
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.second.weight)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        return x + self.second(functional.silu(self.first(functional.silu(self.norm(x)))))


class _Layer(nn.Module):
    """Transformer layer, normalized before."""

    HEAD = 32

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.mix = nn.Linear(width, 3 * width)
        self.merge = nn.Linear(width, width)
        self.feed = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 3 * width), nn.GELU(approximate="tanh"), nn.Linear(3 * width, width)
        )
        for layer in (self.merge, self.feed[-1]):
            nn.init.zeros_(layer.weight)  # type: ignore[arg-type]  # both are linear

    def forward(self, x: Float[Tensor, "b n c"]) -> Float[Tensor, "b n c"]:
        batch, count, width = x.shape
        parts = self.mix(self.norm(x)).view(batch, count, 3, width // self.HEAD, self.HEAD).permute(2, 0, 3, 1, 4)
        mixed = functional.scaled_dot_product_attention(parts[0], parts[1], parts[2])
        x = x + self.merge(mixed.transpose(1, 2).reshape(batch, count, width))
        return x + self.feed(x)
