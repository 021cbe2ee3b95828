"""CPU rasterizer against itself; test_rasterizers.py compares it with the reference."""

from dataclasses import replace

import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.rasterizer.interface import get_rasterizer

WHITE = torch.ones(3)


@pytest.fixture(autouse=True)
def keep_the_number_of_threads():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def test_neither_the_number_of_threads_nor_of_views_changes_a_byte(random_cloud, forward_and_backward):
    cpu = get_rasterizer("cpu")
    cloud = random_cloud(5000, scale=0.03)
    cameras = [OrbitCamera(10, 40 * i, width=200, height=140) for i in range(3)]
    results = []
    for threads in (1, 2, 3, 5):  # 5 threads share the tiles of 3 views, the others take views
        torch.set_num_threads(threads)
        results.append(forward_and_backward(cpu, cloud, cameras, torch.float32))
    for rendering, gradients in results[1:]:
        assert rendering.color.equal(results[0][0].color)
        assert rendering.depth.equal(results[0][0].depth)
        for name, gradient in gradients.items():
            assert gradient.equal(results[0][1][name]), name


def test_a_second_run_gives_the_same_bytes(random_cloud, forward_and_backward):
    cpu = get_rasterizer("cpu")
    first, second = (
        forward_and_backward(cpu, random_cloud(500), [OrbitCamera(width=90, height=70)], torch.float32)
        for _ in range(2)
    )
    assert first[0].color.equal(second[0].color)
    assert all(first[1][name].equal(second[1][name]) for name in first[1])


def test_memory_of_a_picture_in_use_is_not_drawn_over(random_cloud):
    """Two graphs alive at once, gone through in either order and twice, give the same gradients."""
    cpu = get_rasterizer("cpu")
    camera, cloud = OrbitCamera(width=70, height=70), random_cloud(200).to(torch.float32)
    means = [(cloud.means + shift).requires_grad_() for shift in (0.0, 0.1)]
    losses = [cpu(replace(cloud, means=leaf), [camera], WHITE).color.square().sum() for leaf in means]
    first = [torch.autograd.grad(losses[i], means[i], retain_graph=True)[0] for i in (0, 1)]
    again = [torch.autograd.grad(losses[i], means[i], retain_graph=True)[0] for i in (1, 0)]
    assert first[0].equal(again[1])
    assert first[1].equal(again[0])
    assert not first[0].equal(first[1])


def test_layout_of_the_inputs_and_of_the_cotangent_does_not_matter(random_cloud):
    cpu = get_rasterizer("cpu")
    camera, cloud = OrbitCamera(width=40, height=30), random_cloud(100).to(torch.float32)
    strided = Gaussians(
        **{name: value.transpose(0, -1).contiguous().transpose(0, -1) for name, value in vars(cloud).items()}
    )
    assert not strided.means.is_contiguous()
    gradients = []
    for gaussians in (cloud, strided):
        means = gaussians.means.requires_grad_()
        picture = cpu(gaussians, [camera], WHITE).color
        gradients.append(torch.autograd.grad(picture.sum(), means)[0])
    assert gradients[0].equal(gradients[1])


def test_a_gaussian_whose_size_overflows_is_not_drawn_and_changes_nothing(blobs):
    cpu, camera = get_rasterizer("cpu"), OrbitCamera(width=40, height=30)
    cloud = blobs([(0, 0, 0), (0.2, 0, 0.1)]).to(torch.float32)
    alone = cpu(replace(cloud, opacity_logits=cloud.opacity_logits - torch.tensor([0.0, 1e9])), [camera], WHITE)
    cloud.log_scales[1] = 100
    both = cpu(cloud, [camera], WHITE)
    assert both.visible.tolist() == [[True, False]]
    assert both.color.equal(alone.color)


def test_colors_at_the_bounds_of_the_clamp_can_be_learned_and_those_beyond_cannot(blobs):
    cpu, camera = get_rasterizer("cpu"), OrbitCamera(width=40, height=30)
    cloud = blobs([(0, 0, 0)], colors=[(0, 1, 0.5)]).to(torch.float32)
    harmonics = cloud.harmonics.requires_grad_()
    gradients = [
        torch.autograd.grad(cpu(replace(cloud, harmonics=harmonics + shift), [camera], WHITE).color.sum(), harmonics)[0]
        for shift in torch.tensor([[0.0, 0.0, 0.0], [-0.01, 0.01, 0.0]])
    ]
    red, green, blue = gradients[0].flatten()
    assert red == green == blue > 0
    assert gradients[1].flatten().tolist() == [0, 0, blue]
