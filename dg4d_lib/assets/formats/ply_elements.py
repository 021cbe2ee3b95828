"""PLY container: elements of scalars and lists, ASCII or binary (Turk 1994)."""

import warnings
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
TYPES |= {"float": "f4", "double": "f8", "float16": "f2", "float32": "f4", "float64": "f8"}
TYPES |= {f"{sign}int{bits}": f"{sign or 'i'}{bits // 8}" for sign in ("", "u") for bits in (8, 16, 32, 64)}
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
MOST_UNEVEN = 2_000_000  # rows of an element whose lists differ in length: they are read one by one, and slowly


@dataclass(frozen=True)
class Property:
    """Property of an element.

    Attributes:
        name: as declared.
        kind: NumPy type of its values, without byte order.
        counted: type of the length of a list; empty for a scalar.
    """

    name: str
    kind: str
    counted: str = ""


@dataclass(frozen=True)
class List:
    """Values of a list property.

    Attributes:
        values: of one row after the other.
        counts: number of values per row.
    """

    values: NDArray[Any]
    counts: NDArray[np.int64]


@dataclass(frozen=True)
class Element:
    """Rows of an element.

    Attributes:
        scalars: a value per row, by the name of the property.
        lists: list properties by name.
    """

    scalars: dict[str, NDArray[Any]]
    lists: dict[str, List]


def read_elements(content: bytes, needed: Collection[str]) -> dict[str, Element]:
    """Read the elements of a PLY up to the last needed one.

    Raises:
        ValueError, IndexError, OverflowError: the file is not a PLY, it is broken or truncated, or an element has too
            many rows of different lengths.
    """
    end = content.index(b"end_header")
    start = content.index(b"\n", end) + 1
    lines = [line.split() for line in content[:end].decode("ascii", "replace").splitlines()]
    declared: list[tuple[str, int, list[Property]]] = []
    form = ""
    for words in lines:
        match words:
            case ["format", name, _]:
                form = name
            case ["element", name, count] if count.isdecimal():
                if any(name == other for other, _, _ in declared):
                    raise ValueError(f"the header declares the element {name[:80]!r} twice")
                declared.append((name, int(count), []))
            case ["property", "list", counted, kind, name]:
                declared[-1][2].append(Property(name, _kind(kind), _kind(counted)))
            case ["property", kind, name]:
                declared[-1][2].append(Property(name, _kind(kind)))
            case ["element" | "property", *_]:
                raise ValueError(f"the header has the line {' '.join(words)[:80]!r}")
    if form not in ("ascii", *ORDERS):
        raise ValueError(f"the format is {form!r}")
    rows = _Numbers(content[start:]) if form == "ascii" else _Bytes(content[start:], ORDERS[form])
    last = max((number for number, (name, _, _) in enumerate(declared) if name in needed), default=-1)
    return {name: _element(rows, name, count, properties) for name, count, properties in declared[: last + 1]}


def _kind(name: str) -> str:
    if name not in TYPES:
        raise ValueError(f"the type {name[:80]!r} of a property is unknown")
    return TYPES[name]


def _element(rows: "_Numbers | _Bytes", name: str, count: int, properties: list[Property]) -> Element:
    """Read the rows of an element: together if their lists have the lengths of the first one, else one by one."""
    if not count or not properties:
        return Element({}, {})
    start = rows.place
    try:
        with np.errstate(all="ignore"):  # numbers that do not fit their type become others: users check them
            lengths = [len(values) for values in rows.row(properties)]
            rows.place = start
            columns = rows.table(count, properties, lengths)
            if columns is None:
                if count > MOST_UNEVEN:
                    raise ValueError(
                        f"{name[:80]!r} has {count} rows of different lengths; at most {MOST_UNEVEN} are read"
                    )
                rows.place = start
                columns = _joined([rows.row(properties) for _ in range(count)])
    except IndexError as error:
        raise ValueError(f"the rows of {name[:80]!r} are truncated") from error
    scalars = {one.name: values for one, (values, _) in zip(properties, columns, strict=True) if not one.counted}
    lists = {one.name: List(*pair) for one, pair in zip(properties, columns, strict=True) if one.counted}
    return Element(scalars, lists)


Columns = list[tuple[NDArray[Any], NDArray[np.int64]]]  # values and their number per row, of every property


def _joined(rows: list[list[NDArray[Any]]]) -> Columns:
    """Return the columns of rows that were read one by one."""
    return [
        (np.concatenate(values), np.array([len(one) for one in values], np.int64)) for values in zip(*rows, strict=True)
    ]


class _Numbers:
    """Rows of an ASCII PLY."""

    def __init__(self, text: bytes) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # reports text that is not a number
            try:
                self.numbers = np.fromstring(text.decode("ascii", "replace"), np.float64, sep=" ")
            except DeprecationWarning as error:
                raise ValueError("a row has something that is not a number") from error
        self.place = 0

    def take(self, count: int) -> NDArray[np.float64]:
        """Return the next numbers."""
        found = self.numbers[self.place : self.place + count]
        if count < 0 or len(found) < count:
            raise IndexError(count)
        self.place += count
        return found

    def row(self, properties: list[Property]) -> list[NDArray[Any]]:
        """Return the values of all properties in the next row."""
        return [_cast(self.take(int(self.take(1)[0]) if one.counted else 1), one.kind) for one in properties]

    def table(self, count: int, properties: list[Property], lengths: list[int]) -> Columns | None:
        """Return the columns if all rows have these lengths, else None."""
        width = sum(length + bool(one.counted) for one, length in zip(properties, lengths, strict=True))
        if self.place + count * width > len(self.numbers):
            return None
        table, start, columns = self.take(count * width).reshape(count, width), 0, []
        for one, length in zip(properties, lengths, strict=True):
            if one.counted:
                if (table[:, start] != length).any():
                    return None
                start += 1
            values = _cast(table[:, start : start + length], one.kind).ravel()
            columns.append((values, np.full(count, length, np.int64)))
            start += length
        return columns


def _cast(values: NDArray[np.float64], kind: str) -> NDArray[Any]:
    if kind[0] != "f" and not np.isfinite(values).all():
        raise ValueError("a row has a whole number that is not finite")
    return values.astype(kind)


class _Bytes:
    """Rows of a binary PLY."""

    def __init__(self, content: bytes, order: str) -> None:
        self.content, self.order, self.place = content, order, 0

    def take(self, kind: str, count: int) -> NDArray[Any]:
        """Return the next numbers."""
        dtype = np.dtype(self.order + kind)
        if count < 0 or self.place + count * dtype.itemsize > len(self.content):
            raise IndexError(count)
        found = np.frombuffer(self.content, dtype, count, self.place)
        self.place += found.nbytes
        return found

    def row(self, properties: list[Property]) -> list[NDArray[Any]]:
        """Return the values of all properties in the next row."""
        return [self.take(one.kind, int(self.take(one.counted, 1)[0]) if one.counted else 1) for one in properties]

    def table(self, count: int, properties: list[Property], lengths: list[int]) -> Columns | None:
        """Return the columns if all rows have these lengths, else None."""
        fields: list[Any] = []
        for number, (one, length) in enumerate(zip(properties, lengths, strict=True)):
            if one.counted:
                fields.append((f"count {number}", self.order + one.counted))
            fields.append((f"values {number}", self.order + one.kind, (length,)))
        dtype = np.dtype(fields)
        if self.place + count * dtype.itemsize > len(self.content):
            return None
        table = np.frombuffer(self.content, dtype, count, self.place)
        if any((table[f"count {n}"] != lengths[n]).any() for n, one in enumerate(properties) if one.counted):
            return None
        self.place += table.nbytes
        return [
            (table[f"values {number}"].astype(one.kind).ravel(), np.full(count, length, np.int64))
            for number, (one, length) in enumerate(zip(properties, lengths, strict=True))
        ]
