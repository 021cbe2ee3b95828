"""ONNX files of one 1 x 1 convolution, written without the package onnx, in the layout of segmentation networks."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path

FLOAT = 1  # TensorProto.DataType
IR_VERSION, OPSET = 8, 13


def tiny_model(
    weights: Sequence[float] = (1.0, 1.0, 1.0),
    bias: float = 0.0,
    side: int = 16,
    sigmoid: bool = True,
    channels: int = 3,
) -> bytes:
    """Return a model whose output is `weights . input + bias`, through a sigmoid if asked for."""
    nodes = [_node("Conv", ["x", "w", "b"], "logits" if sigmoid else "y")]
    nodes += [_node("Sigmoid", ["logits"], "y")] if sigmoid else []
    graph = b"".join(_bytes(1, node) for node in nodes) + _bytes(2, b"tiny")
    graph += _bytes(5, _tensor("w", (1, channels, 1, 1), weights)) + _bytes(5, _tensor("b", (1,), [bias]))
    graph += _bytes(11, _value("x", (1, channels, side, side))) + _bytes(12, _value("y", (1, 1, side, side)))
    opset = _bytes(1, b"") + _number(2, OPSET)
    return _number(1, IR_VERSION) + _bytes(8, opset) + _bytes(7, graph)


def write_network(folder: Path, mean: float = 0.5, std: float = 1.0, **model: object) -> Path:
    """Write a folder as `dg4d weights pull isnet` leaves it."""
    (folder / "onnx").mkdir(parents=True)
    (folder / "onnx" / "model.onnx").write_bytes(tiny_model(**model))
    config = {"do_rescale": True, "rescale_factor": 1 / 255, "image_mean": [mean] * 3, "image_std": [std] * 3}
    (folder / "preprocessor_config.json").write_text(json.dumps(config))
    return folder


def _varint(value: int) -> bytes:
    found = b""
    while value > 127:
        found += bytes([value & 127 | 128])
        value >>= 7
    return found + bytes([value])


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _bytes(field: int, value: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(value)) + value


def _node(kind: str, inputs: Sequence[str], output: str) -> bytes:
    return b"".join(_bytes(1, name.encode()) for name in inputs) + _bytes(2, output.encode()) + _bytes(4, kind.encode())


def _tensor(name: str, shape: Sequence[int], values: Sequence[float]) -> bytes:
    dims = b"".join(_number(1, side) for side in shape)
    return dims + _number(2, FLOAT) + _bytes(8, name.encode()) + _bytes(9, struct.pack(f"<{len(values)}f", *values))


def _value(name: str, shape: Sequence[int]) -> bytes:
    dims = b"".join(_bytes(1, _number(1, side)) for side in shape)
    return _bytes(1, name.encode()) + _bytes(2, _bytes(1, _number(1, FLOAT) + _bytes(2, dims)))
