"""Detail of outlines: what it reaches, what it leaves alone."""

import numpy as np
import pytest
import torch
import trimesh

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh.folds import DefectFinder
from dg4d_lib.mesh.tracking import outline_detail
from dg4d_lib.mesh.tracking.outline_detail import fit_outline_detail
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh

SIZE = 256  # pixels of the video
FINE = OrbitCamera(width=4 * SIZE, height=4 * SIZE)


def ball() -> tuple[torch.Tensor, torch.Tensor]:
    mesh = trimesh.creation.icosphere(4, 0.4)
    return torch.from_numpy(mesh.vertices.astype(np.float32)), torch.from_numpy(mesh.faces.astype(np.int32))


def alpha_of(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Return the alpha of a mesh at the input view, with soft edges."""
    covered = (rasterize_mesh(vertices, faces, [FINE]).faces >= 0).float()
    return torch.nn.functional.avg_pool2d(covered[None], 4)[0]


def overlap(vertices: torch.Tensor, faces: torch.Tensor, alpha: torch.Tensor) -> float:
    ours, theirs = alpha_of(vertices, faces) > 0.5, alpha > 0.5
    return float((ours & theirs).sum() / (ours | theirs).sum())


def waved(vertices: torch.Tensor, height: float) -> torch.Tensor:
    """Return a ball whose outline has waves."""
    angle = torch.atan2(vertices[:, 1], vertices[:, 0])
    return vertices * torch.stack([1 + height * (10 * angle).sin()] * 2 + [torch.ones(len(vertices))], 1)


def test_the_outline_of_every_frame_becomes_that_of_the_video() -> None:
    vertices, faces = ball()
    alpha = torch.cat([alpha_of(waved(vertices, height), faces) for height in (0.02, -0.02)])
    fitted = fit_outline_detail(vertices, torch.zeros(2, *vertices.shape), faces, alpha)
    for frame in range(2):
        assert overlap(vertices, faces, alpha[frame, None]) < 0.98
        assert overlap(vertices + fitted[frame], faces, alpha[frame, None]) > 0.993
    assert fitted[..., 2].abs().max() < 1e-6  # parallel to the picture
    assert fitted[:, vertices[:, 2].abs() > 0.3].norm(dim=-1).max() < 0.002  # away from the outline


def test_an_outline_that_is_right_stays() -> None:
    vertices, faces = ball()
    fitted = fit_outline_detail(vertices, torch.zeros(1, *vertices.shape), faces, alpha_of(vertices, faces))
    assert fitted.norm(dim=-1).max() < 0.003  # 0.4 pixels of the video


def test_what_is_far_off_is_no_detail() -> None:
    vertices, faces = ball()
    fitted = fit_outline_detail(vertices, torch.zeros(1, *vertices.shape), faces, alpha_of(1.2 * vertices, faces))
    assert not fitted.any()


@pytest.mark.parametrize("alpha", [torch.zeros(1, SIZE, SIZE), torch.ones(1, SIZE, SIZE)], ids=["empty", "full"])
def test_videos_without_an_outline_change_nothing(alpha: torch.Tensor) -> None:
    vertices, faces = ball()
    assert not fit_outline_detail(vertices, torch.zeros(1, *vertices.shape), faces, alpha).any()


def test_no_new_defects() -> None:
    """Two sheets that touch at the outline would cross, because each is drawn to a border of noise."""
    vertices, faces = ball()
    thin = vertices * torch.tensor([1.0, 1.0, 0.01])
    noise = torch.rand(1, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    alpha = (alpha_of(thin, faces) + 0.8 * (noise - 0.5)).clamp(0, 1)
    fitted = fit_outline_detail(thin, torch.zeros(1, *thin.shape), faces, alpha)
    finder = DefectFinder(faces.numpy(), thin.double().numpy())
    before, after = (finder.defective(shape.double().numpy()) for shape in (thin, thin + fitted[0]))
    assert fitted.any()
    assert not (after & ~before).any()


def test_where_much_has_to_stay_the_rest_moves_again(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = ball()
    thin = vertices * torch.tensor([1.0, 1.0, 0.03])
    alpha = alpha_of(waved(thin, 0.02), faces)
    errors = []
    for passes in (1, outline_detail.PASSES):
        monkeypatch.setattr(outline_detail, "PASSES", passes)
        fitted = fit_outline_detail(thin, torch.zeros(1, *thin.shape), faces, alpha)
        errors.append(1 - overlap(thin + fitted[0], faces, alpha))
    assert errors[1] < 0.6 * errors[0]
