"""Dynamic stage: optimization of the deformation on the driving video and a guidance prior (paper section 3.2)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from dg4d_lib.adam import Adam
from dg4d_lib.cameras.orbit import RADIUS, OrbitCamera
from dg4d_lib.cameras.viewpoints import random_orbit
from dg4d_lib.deformation.interface import Deformation
from dg4d_lib.deformation.rigidity_loss import neighborhoods, rigidity_loss
from dg4d_lib.devices import to_device_async
from dg4d_lib.fitting.losses import WHITE, check_finite, reference_loss, resize_cutouts
from dg4d_lib.fitting.schedules import late_decay, log_linear, reference_size_at, resolution_at
from dg4d_lib.fitting.static import draw_view, learning_rates
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.guidance.interface import GuidancePrior, GuidanceView, ring_size
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.settings import MotionSettings
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.visual_hull.known import KnownView

MARGIN = 0.1  # around the means, share of the longest side of their bounding box
ADVICE = "lower the learning rates (motion.*_lr) or the weights"
Report = Callable[[int, dict[str, float]], None]


def fit_motion(
    gaussians: Gaussians,
    deformation: Deformation,
    video: DrivingVideo,
    prior: GuidancePrior,
    rasterize: Rasterizer,
    settings: MotionSettings,
    generator: torch.Generator,
    report: Report = lambda iteration, values: None,
    known: Mapping[int, Sequence[KnownView]] | None = None,
) -> Gaussians:
    """Fit `deformation` in place, and with `settings.fine_tune` the canonical Gaussians too.

    Args:
        gaussians: the canonical cloud, which is not modified; the fit runs on its device.
        deformation: the model to fit, on the same device; the identity at the start.
        video: driving video, seen at azimuth and elevation 0.
        prior: scores random views of every frame.
        rasterize: rasterizer.
        settings: of the stage.
        generator: source of all randomness.
        report: called after every iteration with (iterations done, named losses).
        known: further images by frame; an iteration compares one of them, drawn by their weights, with the weight of
            the video.

    Returns:
        The canonical cloud of `deformation`: the given one, or with `settings.fine_tune` its optimized copy.

    Raises:
        FitDiverged: the loss became non-finite.
    """
    device = gaussians.means.device
    cutouts = torch.cat([video.frames, video.alpha], -1).to(device)

    @cache
    def references(size: int) -> tuple[OrbitCamera, Tensor, Tensor]:
        """Return camera, color and alpha of the reference view; indexing keeps channels first in memory."""
        color, alpha = (images.permute(0, 3, 1, 2) for images in resize_cutouts(cutouts, size))
        return OrbitCamera(width=size, height=size), color, alpha

    times = video.times.to(device)
    white = torch.tensor(WHITE, device=device)
    known_frames, known_images = known_pairs(known or {}, device)
    gaussians, groups = trainable_cloud(gaussians.detach(), deformation, settings)
    adam = Adam(groups, eps=1e-15)
    rates = [float(group["lr"]) for group in adam.param_groups]
    neighbors = neighborhoods(gaussians.means) if settings.rigidity_weight else None
    for step in range(1, settings.iterations + 1):
        progress = step / settings.iterations
        for group, rate in zip(adam.param_groups, rates, strict=True):
            group["lr"] = rate * late_decay(settings.lr_end, progress)
        if settings.fine_tune:
            means_lr = log_linear(settings.means_lr, settings.means_lr_end, progress)
            adam.param_groups[0]["lr"] = settings.length_scale * means_lr
        frames = sample_frames(len(video), settings.frames_per_iteration, generator)
        selected = to_device_async(frames, device)
        moved = deformation.displace(gaussians.means, times[selected]).apply(gaussians)

        side = reference_size_at(settings, progress)
        camera, color, alpha = references(side)
        rendering = rasterize(moved, [camera] * len(frames), white)
        reference = reference_loss(
            rendering,
            color[selected].permute(0, 2, 3, 1),
            alpha[selected].permute(0, 2, 3, 1),
            settings.color_weight,
            settings.alpha_weight,
            settings.ssim_weight,
        )
        if known_images:
            row = draw_view(known_images, generator)
            state = deformation.displace(gaussians.means, times[known_frames[row], None]).apply(gaussians)
            reference = reference + known_loss(state, known_images[row], side, rasterize, white, settings)
        loss = progress * reference + deformation.regularization_loss()
        guidance = torch.zeros((), device=device)
        if settings.views and settings.guidance_weight:
            views, rows = sample_views(
                prior, frames, settings, resolution_at(settings.resolution_schedule, progress), generator
            )
            if views:
                states = moved.states(rows)
                rendering = rasterize(states, [view.camera for view in views], white)
                guidance = prior.loss(rendering.color, rendering.alpha, views, progress, generator)
                loss = loss + settings.guidance_weight * guidance
        if neighbors is not None:
            loss = loss + settings.rigidity_weight * rigidity_loss(moved, *neighbors)
        adam.zero_grad()
        loss.backward()
        losses = {"loss": loss, "reference": reference, "guidance": guidance}
        gradients = [parameter.grad for group in adam.param_groups for parameter in group["params"]]
        iteration = f"iteration {step} of {settings.iterations}"
        numbers = check_finite("fit_motion", losses, gradients, iteration, ADVICE, gaussians)
        adam.step()
        report(step, numbers)
    return gaussians.detach()


def known_pairs(known: Mapping[int, Sequence[KnownView]], device: torch.device) -> tuple[list[int], list[KnownView]]:
    """Return frame and view of every known image, on the device of the fit."""
    pairs = [(frame, replace(view, cutout=view.cutout.to(device))) for frame, views in known.items() for view in views]
    return [frame for frame, _ in pairs], [view for _, view in pairs]


def known_loss(
    state: Gaussians,
    view: KnownView,
    size: int,
    rasterize: Rasterizer,
    white: Float[Tensor, " 3"],
    settings: MotionSettings,
) -> Float[Tensor, ""]:
    """Compare a batch of one state with a known image, at `size` pixels or its own if it is smaller."""
    size = min(size, len(view.cutout))
    color, alpha = resize_cutouts(view.cutout[None], size)
    rendering = rasterize(state, [replace(view.camera, width=size, height=size)], white)
    return reference_loss(rendering, color, alpha, settings.color_weight, settings.alpha_weight, settings.ssim_weight)


def sample_frames(total: int, count: int, generator: torch.Generator) -> Int[Tensor, " k"]:
    """Draw the frames of one iteration, in order: all, or one from each of `count` equal intervals of time."""
    if not count or count >= total:
        return torch.arange(total)
    edges = torch.linspace(0, total, count + 1, dtype=torch.float64)
    inside = torch.rand(count, generator=generator, dtype=torch.float64)
    return (edges[:-1] + inside * edges.diff()).floor().long().clamp(max=total - 1).unique()


def sample_views(
    prior: GuidancePrior, frames: Int[Tensor, " k"], settings: MotionSettings, size: int, generator: torch.Generator
) -> tuple[list[GuidanceView], Int[Tensor, " m"]]:
    """Draw random views of the guided frames that the prior supports; return them and their rows in `frames`."""
    rows = [row for row, f in enumerate(frames.tolist()) if prior.frames is None or f in prior.frames]
    guided = sample_frames(len(rows), settings.guided_frames, generator).tolist()
    rows = [rows[place] for place in guided for _ in range(settings.views)]
    if prior.viewpoints is None:
        elevation = (-settings.elevation_deg, settings.elevation_deg)
        cameras = random_orbit(
            len(rows),
            size,
            elevation_deg=elevation,
            radius=(RADIUS, RADIUS),
            generator=generator,
            ring=ring_size(prior),
        )
    else:
        choice = torch.randint(len(prior.viewpoints), (len(rows),), generator=generator).tolist()
        cameras = [replace(prior.viewpoints[i], width=size, height=size) for i in choice]
    views = [GuidanceView(camera, int(frames[row])) for camera, row in zip(cameras, rows, strict=True)]
    return views, torch.tensor(rows, dtype=torch.long)


def trainable_cloud(
    gaussians: Gaussians, deformation: Deformation, settings: MotionSettings
) -> tuple[Gaussians, list[dict[str, object]]]:
    """Return the canonical cloud, with `settings.fine_tune` a trainable copy of it, and Adam's parameter groups."""
    groups = parameter_groups(deformation, settings)
    if not settings.fine_tune:
        return gaussians, groups
    copy = Gaussians(**{name: nn.Parameter(value.clone()) for name, value in vars(gaussians).items()})
    rates = learning_rates(settings).items()
    return copy, [*({"params": getattr(copy, name), "lr": rate} for name, rate in rates), *groups]


def bounds_of(gaussians: Gaussians) -> Float[Tensor, "2 3"]:
    """Return the bounding box of the means, widened by `MARGIN`: the box of a deformation."""
    low, high = gaussians.means.detach().amin(0), gaussians.means.detach().amax(0)
    slack = MARGIN * (high - low).max().clamp(min=1e-3)
    return torch.stack([low - slack, high + slack])


def parameter_groups(deformation: Deformation, settings: MotionSettings) -> list[dict[str, object]]:
    """Return Adam's parameter groups of a deformation: planes, networks, and layers that predict lengths."""
    planes = deformation.grid_parameters()
    fast = {id(parameter) for parameter in planes}
    lengths = deformation.length_parameters() if settings.length_scale != 1 else []
    apart = fast | {id(parameter) for parameter in lengths}
    network = [parameter for parameter in deformation.parameters() if id(parameter) not in apart]
    groups = [
        {"params": planes, "lr": settings.plane_lr},
        {"params": network, "lr": settings.network_lr},
        {"params": lengths, "lr": settings.length_scale * settings.network_lr},
    ]
    return [group for group in groups if group["params"]]
