"""The `gates` artifact: results of quality gates as JSON."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dg4d_lib.metrics.gates import Gate

DIGITS = 4  # decimals of every number
GATE_FIELDS = ("name", "passed", "value", "unit", "least", "most", "form", "values", "meaning", "advice")


def gates_as_json(gates: Sequence[Gate], earlier: Sequence[dict[str, Any]] = ()) -> dict[str, Any]:
    """Return gates as JSON, with rounded values.

    Args:
        gates: results.
        earlier: rows of an earlier step, which come first.
    """
    rows = list(earlier)
    for gate in gates:
        values = {form: round(value, DIGITS) for form, value in gate.values.items()}
        rows.append({name: getattr(gate, name) for name in GATE_FIELDS})
        rows[-1] |= {"value": round(gate.value, DIGITS), "values": values}
    failing = [row["name"] for row in rows if not row["passed"]]
    return {"accepted": not failing, "failing": failing, "gates": rows}


def write_gates(path: Path, answer: dict[str, Any]) -> None:
    """Write the result of `gates_as_json`."""
    path.write_text(json.dumps(answer, ensure_ascii=False, allow_nan=False), encoding="utf-8")


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Read the rows of an earlier step."""
    rows: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["gates"]
    return rows
