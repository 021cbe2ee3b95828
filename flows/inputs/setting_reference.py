"""Reference of all settings: names, defaults, allowed values and meanings, from the JSON schemas of the models."""

import difflib
import json
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from typing import Any, NamedTuple

from pydantic import BaseModel

from dg4d_lib.asset_settings import ScoreSettings
from dg4d_lib.errors import BadInput, quoted
from steps.profiles import RENAMED_SETTINGS, PipelineSettings

TYPES = {"integer": "integer", "number": "number", "boolean": "true or false", "string": "text"}
BOUNDS = {
    "minimum": "at least",
    "exclusiveMinimum": "above",
    "maximum": "at most",
    "exclusiveMaximum": "below",
    "multipleOf": "a multiple of",
}
LENGTHS = {"minLength": "at least", "minItems": "at least", "maxLength": "at most", "maxItems": "at most"}
SECTIONS = ("rasterizer", *(name for name in PipelineSettings.model_fields if name != "rasterizer"), "score")

Schema = Mapping[str, Any]


class Setting(NamedTuple):
    """Setting of the pipeline or of scores.

    Attributes:
        name: dotted name, as in `--set NAME=VALUE`.
        default: as JSON; empty if the field is required.
        allowed: type and bounds.
        meaning: description of the field.
        only_with: choice of a `kind` that the setting belongs to, such as "prior.kind=zero123"; empty: none.
    """

    name: str
    default: str
    allowed: str
    meaning: str
    only_with: str = ""


@cache
def all_settings() -> tuple[Setting, ...]:
    """Return every setting of the pipeline and of scores, in the order of the stages."""
    return (*_of_model(PipelineSettings, ""), *_of_model(ScoreSettings, "score."))


def find_settings(name: str) -> list[Setting]:
    """Return the setting of this name, or those of the section.

    Raises:
        BadInput: the name is unknown; suggests the nearest one.
    """
    found = [one for one in all_settings() if one.name == name or one.name.startswith(f"{name}.")]
    if not found:
        check_names([name])
        raise BadInput(f"{name} is an old name; it cannot be set any more")
    return found


def value_in(settings: PipelineSettings, setting: Setting) -> str:
    """Return the value of a setting as JSON; "" if another kind is chosen, or for settings of scores."""
    tree = settings.model_dump(mode="json")
    choice, _, kind = setting.only_with.partition("=")
    if choice and _look_up(tree, choice) != kind:
        return ""
    value = _look_up(tree, setting.name)
    return "" if value is None else as_json(value)


def check_names(names: Iterable[str]) -> None:
    """Refuse unknown names. Old names pass, because `revise` explains them.

    Raises:
        BadInput: suggests the nearest name.
    """
    for name in names:
        if name not in _names() and name not in _sections() and name not in RENAMED_SETTINGS:
            raise BadInput(f"unknown setting {quoted(name)}; {_advice(name, sorted(_names()))}")


def check_changes(changes: Mapping[str, Any]) -> None:
    """Refuse unknown names, and groups of settings that get a single value.

    Raises:
        BadInput: suggests the nearest name, or a setting of the group.
    """
    check_names(changes)
    for name, value in changes.items():
        if name in _names() or isinstance(value, dict):
            continue
        members = [one for one in all_settings() if one.name.startswith(f"{name}.")]
        if not members:
            continue
        takers = [one.name for one in (*members, *all_settings()) if value in one.allowed.split(", ")]
        example = f"{takers[0]}={value}" if takers else f"{members[-1].name}={members[-1].default}"
        raise BadInput(
            f"{name} is a group of settings; name one, for example {example}; `dg4d settings {name}` lists them"
        )


def as_json(value: Any) -> str:
    """Return a value as `--set` takes it: JSON on one line, without spaces."""
    return json.dumps(value, separators=(",", ":"))


@cache
def _names() -> frozenset[str]:
    return frozenset(one.name for one in all_settings())


@cache
def _sections() -> frozenset[str]:
    return frozenset(part for name in _names() for part in (name.rpartition(".")[0], name.split(".")[0]))


def _advice(name: str, known: list[str]) -> str:
    last = name.rpartition(".")[2]
    same = [one for one in known if one.rpartition(".")[2] == last]  # the section may be wrong or missing
    near = difflib.get_close_matches(name, same or known, n=1, cutoff=0.0 if same else 0.6)
    section = name.partition(".")[0]
    listing = f"`dg4d settings {section}`" if section in SECTIONS else "`dg4d settings`"
    return f"did you mean {near[0]}? {listing} lists the names" if near else f"{listing} lists the names"


def _look_up(tree: Any, path: str) -> Any:
    for name in path.split("."):
        tree = tree.get(name) if isinstance(tree, dict) else None
    return tree


def _of_model(model: type[BaseModel], prefix: str) -> Iterator[Setting]:
    schema = model.model_json_schema()
    definitions = schema.get("$defs", {})

    def resolve(field: Schema) -> Schema:
        return definitions[field["$ref"].rpartition("/")[2]] if "$ref" in field else field

    def walk(properties: Schema, prefix: str, only_with: str) -> Iterator[Setting]:
        for name, field in properties.items():
            path = prefix + name
            if "oneOf" in field:
                kinds = {one["properties"]["kind"]["const"]: one for one in map(resolve, field["oneOf"])}
                meaning = "; ".join(f"{kind}: {_summary(one)}" for kind, one in kinds.items())
                yield Setting(f"{path}.kind", as_json(field["default"]["kind"]), ", ".join(kinds), meaning, only_with)
                for kind, one in kinds.items():
                    yield from walk(one["properties"], f"{path}.", f"{path}.kind={kind}")
            elif nested := resolve(field).get("properties"):
                yield from walk(nested, f"{path}.", only_with)
            elif name != "kind":
                default = as_json(field["default"]) if "default" in field else ""
                items = resolve(field["items"]) if "items" in field else None
                yield Setting(path, default, _allowed(field, items), field.get("description", ""), only_with)

    return walk(schema["properties"], prefix, "")


def _summary(schema: Schema) -> str:
    text: str = schema["description"].splitlines()[0].rstrip(".")
    first = text.split(maxsplit=1)[0]
    is_name = first[1:] != first[1:].lower() or any(map(str.isdigit, first))
    return text if is_name else text[:1].lower() + text[1:]


def _allowed(field: Schema, items: Schema | None) -> str:
    if "enum" in field:
        return ", ".join(map(str, field["enum"]))
    if items is None:
        kind = TYPES[field["type"]]
    elif "properties" in items:
        kind = f"list of {{{', '.join(items['properties'])}}}"
    else:
        kind = f"list: each {_allowed(items, None)}"
    bounds = {name: _number(field[name]) for name in BOUNDS if name in field}
    between = [f"{bounds.pop('minimum')} to {bounds.pop('maximum')}"] if {"minimum", "maximum"} <= bounds.keys() else []
    lengths = [f"{phrase} {field[name]} long" for name, phrase in LENGTHS.items() if name in field]
    return ", ".join([kind, *lengths, *between, *(f"{BOUNDS[name]} {bound}" for name, bound in bounds.items())])


def _number(value: float) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
