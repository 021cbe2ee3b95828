"""Reference of all settings: names, defaults, allowed values and meanings, read from the pydantic models."""

import difflib
import json
from collections.abc import Iterable, Iterator
from functools import cache
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from dg4d_lib.asset_settings import ScoreSettings
from dg4d_lib.errors import BadInput
from flows.formatting.escaping import quoted
from steps.profiles import CHANGED_KNOBS, PipelineSettings

SIGNS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below", "multiple_of": "a multiple of"}
LENGTHS = {"min_length": "at least", "max_length": "at most"}
SECTIONS = ("rasterizer", *(name for name in PipelineSettings.model_fields if name != "rasterizer"), "score")


class Setting(NamedTuple):
    """One setting.

    Attributes:
        name: dotted name, as in `--set NAME=VALUE`.
        default: as JSON; empty where the field has none of its own.
        allowed: type and bounds, in words.
        meaning: description of the field.
        only_with: choice of a `kind` that the setting belongs to, such as "prior.kind=zero123"; empty: always there.
    """

    name: str
    default: str
    allowed: str
    meaning: str
    only_with: str = ""


@cache
def all_settings() -> tuple[Setting, ...]:
    """Return every setting of the pipeline and of scores, in the order of the stages."""
    return (*_of_model(PipelineSettings, "", ""), *_of_model(ScoreSettings, "score.", ""))


def find_settings(name: str) -> list[Setting]:
    """Return the setting of this name, or those of the section.

    Raises:
        BadInput: there is no such setting; names the nearest one.
    """
    found = [one for one in all_settings() if one.name == name or one.name.startswith(f"{name}.")]
    if not found:
        check_names([name])
        raise BadInput(f"{name} is an old name; it cannot be set any more")
    return found


def value_in(settings: PipelineSettings, setting: Setting) -> str:
    """Return the value of a setting as JSON; empty where another kind is chosen, or for settings of scores."""
    tree = settings.model_dump(mode="json")
    choice, _, kind = setting.only_with.partition("=")
    if choice and _look_up(tree, choice) != kind:
        return ""
    value = _look_up(tree, setting.name)
    return "" if value is None else as_json(value)


def check_names(names: Iterable[str]) -> None:
    """Refuse names that no setting has. Old names pass, because `revise` explains them.

    Raises:
        BadInput: names the nearest setting.
    """
    known = {one.name for one in all_settings()}
    sections = {name.rpartition(".")[0] for name in known} | {name.split(".")[0] for name in known}
    for name in names:
        if name in known or name in sections or name in CHANGED_KNOBS:
            continue
        raise BadInput(f"unknown setting {quoted(name)}; {_advice(name, sorted(known))}")


def _advice(name: str, known: list[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if not near:  # the last part may be right where the section is wrong or missing
        last = name.rpartition(".")[2]
        near = [one for one in known if one.rpartition(".")[2] == last][:1]
    section = name.partition(".")[0]
    listing = f"`dg4d settings {section}`" if section in SECTIONS else "`dg4d settings`"
    return f"did you mean {near[0]}? {listing} lists the names" if near else f"{listing} lists the names"


def _look_up(tree: Any, path: str) -> Any:
    for name in path.split("."):
        tree = tree.get(name) if isinstance(tree, dict) else None
    return tree


def _of_model(model: type[BaseModel], prefix: str, only_with: str) -> Iterator[Setting]:
    for name, field in model.model_fields.items():
        path = prefix + name
        models = _models(field.annotation)
        if not models:
            if name != "kind":
                yield Setting(path, _default(field), _allowed(field), field.description or "", only_with)
        elif len(models) == 1:
            yield from _of_model(models[0], f"{path}.", only_with)
        else:
            kinds = [str(one.model_fields["kind"].default) for one in models]
            chosen = json.dumps(getattr(field.default, "kind", kinds[0]))
            meaning = "; ".join(f"{kind}: {_summary(one)}" for kind, one in zip(kinds, models, strict=True))
            yield Setting(f"{path}.kind", chosen, ", ".join(kinds), meaning, only_with)
            for kind, one in zip(kinds, models, strict=True):
                yield from _of_model(one, f"{path}.", f"{path}.kind={kind}")


def _models(annotation: Any) -> list[type[BaseModel]]:
    """Return the models that an annotation chooses from; none for plain values and lists."""
    if get_origin(annotation) is Annotated:
        return _models(get_args(annotation)[0])
    if get_origin(annotation) in {Union, UnionType}:
        return [model for one in get_args(annotation) for model in _models(one)]
    return [annotation] if isinstance(annotation, type) and issubclass(annotation, BaseModel) else []


def _summary(model: type[BaseModel]) -> str:
    text = (model.__doc__ or "").strip().splitlines()[0].rstrip(".")
    return text if text[:2].isupper() else text[:1].lower() + text[1:]


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return ""
    value = field.get_default(call_default_factory=True)
    return as_json(value)


def as_json(value: Any) -> str:
    """Return a value as `--set` takes it: JSON on one line, without spaces."""
    return json.dumps(value, default=_plain, separators=(",", ":"))


def _plain(value: Any) -> Any:
    return value.model_dump(mode="json") if isinstance(value, BaseModel) else str(value)


def _allowed(field: FieldInfo) -> str:
    return _phrase(field.annotation, field.metadata)


def _phrase(annotation: Any, metadata: Iterable[Any]) -> str:
    origin = get_origin(annotation)
    if origin is Annotated:
        inner, *more = get_args(annotation)
        constraints = [bound for one in more for bound in (one.metadata if isinstance(one, FieldInfo) else [one])]
        return _phrase(inner, [*constraints, *metadata])
    if origin is Literal:
        return ", ".join(map(str, get_args(annotation)))
    if origin is tuple:
        item = get_args(annotation)[0]
        each = f"list of {{{', '.join(item.model_fields)}}}" if _models(item) else f"list: each {_phrase(item, [])}"
        return ", ".join([each, *_sizes(metadata)])
    kind = {int: "integer", float: "number", bool: "true or false", str: "text"}.get(annotation, str(annotation))
    return ", ".join([kind, *_sizes(metadata), *_bounds(metadata)])


def _sizes(metadata: Iterable[Any]) -> list[str]:
    return [
        f"{phrase} {getattr(bound, name)} long"
        for bound in metadata
        for name, phrase in LENGTHS.items()
        if getattr(bound, name, None) is not None
    ]


def _bounds(metadata: Iterable[Any]) -> list[str]:
    bounds = {name: getattr(one, name) for one in metadata for name in SIGNS if getattr(one, name, None) is not None}
    texts = {name: f"{bound:g}" if isinstance(bound, float) else str(bound) for name, bound in bounds.items()}
    if texts.keys() >= {"ge", "le"}:
        both = f"{texts.pop('ge')} to {texts.pop('le')}"
        return [both, *(f"{SIGNS[name]} {texts[name]}" for name in SIGNS if name in texts)]
    return [f"{SIGNS[name]} {texts[name]}" for name in SIGNS if name in texts]
