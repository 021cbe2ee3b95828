import json

import pytest

from flows.inputs.json_text import DEEPEST, UnfitJSON, loads


def nested(depth: int) -> str:
    return "[" * depth + "]" * depth


def test_what_is_fit_is_what_json_says() -> None:
    text = '{"a": [1, 2.5, null, true, "\\u00e9 \\ud83e\\udd8e"], "b": {"a": -3}}'
    assert loads(text) == json.loads(text)
    assert loads(nested(DEEPEST)) == json.loads(nested(DEEPEST))


@pytest.mark.parametrize(
    "text",
    [
        nested(DEEPEST + 1), nested(100_000), '{"a":' * 50_000, "NaN", "[-Infinity]", "1e999", "9" * 101, "9" * 5000,
        '"\\ud800"', '{"\\udfff": 1}', '{"a": 1, "a": 2}', '{"a": {"b": 1, "b": 1}}',
    ],
)  # fmt: skip
def test_what_no_file_can_hold_is_unfit(text: str) -> None:
    with pytest.raises(UnfitJSON) as refused:
        loads(text)
    assert len(str(refused.value)) < 100


@pytest.mark.parametrize("text", ["", "{", "[1,]", "fox", "\ufeff1"])
def test_what_is_no_json_is_another_error(text: str) -> None:
    with pytest.raises(json.JSONDecodeError) as refused:
        loads(text)
    assert not isinstance(refused.value, UnfitJSON)
