import torch
from PIL import Image

from dg4d_lib.images import color_over_white, over_background, over_white, resize, resize_planes, to_bytes


def test_a_shrunken_image_is_the_mean_of_its_pixels_and_not_some_of_them() -> None:
    checkers = ((torch.arange(64)[:, None] + torch.arange(64)) % 2).float()[None, :, :, None]
    torch.testing.assert_close(resize(checkers, (4, 4)), torch.full((1, 4, 4, 1), 0.5), atol=0.01, rtol=0)


def test_resizing_agrees_with_pillow() -> None:
    image = torch.rand(31, 47, generator=torch.Generator().manual_seed(0))
    expected = {
        mode: torch.tensor(Image.fromarray(image.numpy()).resize((13, 17), resample).get_flattened_data()).view(17, 13)
        for mode, resample in (("bilinear", Image.Resampling.BILINEAR), ("bicubic", Image.Resampling.BICUBIC))
    }
    for mode, truth in expected.items():
        torch.testing.assert_close(resize(image[None, ..., None], (17, 13), mode)[0, ..., 0], truth, atol=1e-5, rtol=0)


def test_both_orders_of_channels_give_the_same_image() -> None:
    images = torch.rand(2, 20, 30, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(resize(images, (7, 9)), resize_planes(images.movedim(-1, 1), (7, 9)).movedim(1, -1))


def test_an_opaque_pixel_hides_the_background_and_a_clear_one_shows_it() -> None:
    cutout = torch.tensor([[[0.2, 0.4, 0.6, 1.0], [0.2, 0.4, 0.6, 0.0], [0.2, 0.4, 0.6, 0.5]]])
    color, alpha, blue = cutout[..., :3], cutout[..., 3:], torch.tensor([0.0, 0.0, 1.0])
    expected = torch.tensor([[[0.2, 0.4, 0.6], [0.0, 0.0, 1.0], [0.1, 0.2, 0.8]]])
    torch.testing.assert_close(over_background(color, alpha, blue), expected)
    torch.testing.assert_close(over_white(cutout)[0, 2], torch.tensor([0.6, 0.7, 0.8]))
    assert torch.equal(over_white(cutout), color_over_white(color, alpha))
    torch.testing.assert_close(over_background(color, alpha, 1.0), over_white(cutout))


def test_levels_are_the_nearest_of_256_and_stay_in_range() -> None:
    values = torch.tensor([-0.2, 0.0, 0.5 / 255 + 1e-4, 0.999, 1.0, 1.1], requires_grad=True)
    assert to_bytes(values).tolist() == [0, 0, 1, 255, 255, 255]
