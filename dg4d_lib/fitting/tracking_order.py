"""Order in which the frames of a video are tracked."""

from dg4d_lib.video.driving import DrivingVideo


def is_loop(video: DrivingVideo) -> bool:
    """Return True if the last frame differs from the first no more than two successive frames do somewhere."""
    pictures = video.over(video.frames.new_ones(3))
    steps = (pictures - pictures.roll(-1, 0)).abs().flatten(1).mean(1)
    return len(video) > 2 and float(steps[-1]) <= float(steps[:-1].max())


def tracking_orders(video: DrivingVideo, reference_frame: int) -> tuple[list[int], list[int]]:
    """Return the frames from the reference frame on, and back from it; half of a loop each, for errors add up."""
    count = len(video)
    if is_loop(video):
        forward = count // 2
        ahead = [(reference_frame + step) % count for step in range(forward + 1)]
        return ahead, [(reference_frame - step) % count for step in range(count - forward)]
    return list(range(reference_frame, count)), list(range(reference_frame, -1, -1))
