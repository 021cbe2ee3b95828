"""Segmentation networks by the name in `subject.matting`."""

from dataclasses import dataclass, field
from functools import partial

from dg4d_lib.input_settings import MATTING_METHODS
from dg4d_lib.video import u2netp
from dg4d_lib.video.segmentation_network import load_folder
from dg4d_lib.video.subject import U2NETP, Segmenter
from steps.runtime.weights import open_weights


@dataclass(frozen=True)
class LoadedNetwork:
    """Segmentation network with the digests and licenses of its weights."""

    segmenter: Segmenter = U2NETP
    digests: dict[str, str] = field(default_factory=dict)
    licenses: dict[str, str] = field(default_factory=dict)


def open_network(matting: str) -> LoadedNetwork:
    """Return the network of `subject.matting`: U2-Netp unless the setting names other weights; it is loaded later.

    Raises:
        BadInput: the name is unknown.
        BackendUnavailable: the weights are not installed.
    """
    if matting in MATTING_METHODS:
        return LoadedNetwork(U2NETP, u2netp.digests(), {u2netp.NAME: u2netp.LICENSE})
    opened = open_weights(matting)
    return LoadedNetwork(Segmenter(matting, partial(load_folder, opened.folder)), opened.digests, opened.licenses)
