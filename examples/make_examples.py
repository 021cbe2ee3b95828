"""Make every file of this folder again: `python -m examples.make_examples`. Equal code gives equal bytes."""

import argparse
from pathlib import Path

import av
import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.images import over_white
from examples.beetle import Beetle
from examples.drawing import draw
from examples.newt import Newt
from steps.artifacts.media import write_png

FOLDER = Path(__file__).parent
PICTURE_SIZE = 512  # pixels
VIDEO_SIZE = 384  # pixels
FRAMES = 24
FPS = 12


def main() -> None:
    """Draw the creatures: two cut-outs, and a video before plain white."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    newt = Newt()
    camera = OrbitCamera(width=PICTURE_SIZE, height=PICTURE_SIZE)
    write_png(FOLDER / "newt.png", draw(newt, 0.0, camera))
    write_png(FOLDER / "beetle.png", draw(Beetle(), 0.0, camera))
    small = OrbitCamera(width=VIDEO_SIZE, height=VIDEO_SIZE)
    cutouts = torch.stack([draw(newt, frame / FRAMES, small) for frame in range(FRAMES)])
    write_mp4(FOLDER / "newt.mp4", over_white(cutouts))


def write_mp4(path: Path, frames: Float[Tensor, "t h w 3"]) -> None:
    """H.264 without anything in the file that differs between runs."""
    pixels = (frames.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    with av.open(str(path), "w", container_options={"fflags": "+bitexact"}) as container:
        stream = container.add_stream("libx264", FPS, {"crf": "16", "preset": "slow", "threads": "1"})
        stream.width, stream.height, stream.pix_fmt = frames.shape[2], frames.shape[1], "yuv420p"
        for picture in pixels:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))


if __name__ == "__main__":
    main()
