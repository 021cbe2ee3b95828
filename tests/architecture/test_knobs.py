"""Every knob is read by somebody, bounded, finite, documented, and every profile is made of values that are allowed."""

import ast
import inspect
import math
import typing
from collections.abc import Iterator, Mapping
from typing import Any, Literal, get_args, get_origin

import annotated_types
import pytest
import repository
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

import dg4d_lib.asset_settings
import dg4d_lib.input_settings
import dg4d_lib.refiner_settings
import dg4d_lib.settings
import steps.profiles
from dg4d_lib.errors import BadInput
from dg4d_lib.settings import MotionSettings, Settings, StaticSettings
from steps.catalog import STEPS
from steps.profiles import PROFILES, PipelineSettings, profile, revise

MODULES = (
    dg4d_lib.settings,
    dg4d_lib.input_settings,
    dg4d_lib.asset_settings,
    dg4d_lib.refiner_settings,
    steps.profiles,
)
DEFINITIONS = {f"{module.__name__.replace('.', '/')}.py" for module in MODULES}
EVIDENT = {  # numbers whose names say everything
    "iterations", "features", "hidden", "frequencies", "max_faces", "prune_opacity",
    "guidance_weight", "color_lr", "opacity_lr", "scale_lr", "rotation_lr",
}  # fmt: skip
BOUNDS = (annotated_types.Gt, annotated_types.Ge, annotated_types.Lt, annotated_types.Le, annotated_types.Interval)

Classes = Mapping[str, tuple[type[BaseModel], ...]]


def settings_classes() -> list[type[Settings]]:
    found = [value for module in MODULES for _, value in inspect.getmembers(module, inspect.isclass)]
    own = {c for c in found if issubclass(c, Settings) and c is not Settings}
    return sorted(own - {base for c in own for base in c.__bases__}, key=lambda c: c.__name__)


def classes_by_name() -> Classes:
    """What the names in annotations stand for: a class, or the members of a union."""
    names = {c.__name__: (c,) for c in settings_classes()}
    unions = {
        name: classes_in(value)
        for module in MODULES
        for name, value in vars(module).items()
        if name.endswith("Settings")
    }
    bases = {"FitSettings": (StaticSettings, MotionSettings)}
    return {**{name: members for name, members in unions.items() if members}, **names, **bases}


def classes_in(annotation: object) -> tuple[type[BaseModel], ...]:
    """The settings classes inside of an annotation such as `tuple[ResolutionStage, ...]` or a union."""
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        return (annotation,)
    return tuple(c for part in get_args(annotation) for c in classes_in(part))


def is_choice(field: FieldInfo) -> bool:
    """Whether a field only tells the members of a union apart; matching on the class reads it."""
    return get_origin(field.annotation) is Literal and len(get_args(field.annotation)) == 1


class Reader(ast.NodeVisitor):
    """Follows values whose annotation is a settings class, and notes which of their fields are read.

    It knows arguments, annotated and plain assignments, attributes of `self`, loops and comprehensions: enough for code
    that hands settings on by annotated arguments, which is how this project does it.
    """

    def __init__(self, classes: Classes) -> None:
        self.classes = classes
        self.known: dict[str, tuple[type[BaseModel], ...]] = {}  # expression -> what it may be
        self.reads: set[tuple[str, str]] = set()

    def resolve(self, node: ast.AST | None) -> tuple[type[BaseModel], ...]:
        """What an expression may be; empty for anything but settings."""
        match node:
            case ast.Name() | ast.Attribute() if ast.unparse(node) in self.known:
                return self.known[ast.unparse(node)]
            case ast.Attribute(value=value, attr=name):
                owners = [c for c in self.resolve(value) if name in c.model_fields]
                self.reads |= {(c.__name__, name) for c in owners}
                return tuple(inner for c in owners for inner in classes_in(c.model_fields[name].annotation))
            case ast.Subscript(value=value):
                return self.resolve(value)
        return ()

    def note(self, target: ast.AST, value: tuple[type[BaseModel], ...]) -> None:
        if isinstance(target, ast.Name | ast.Attribute):
            self.known[ast.unparse(target)] = value

    def annotated(self, annotation: ast.AST | None) -> tuple[type[BaseModel], ...]:
        names = [node.id for node in ast.walk(annotation) if isinstance(node, ast.Name)] if annotation else []
        return tuple(c for name in names for c in self.classes.get(name, ()))

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        outer = dict(self.known)
        for field in node.body:
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                self.known[f"self.{field.target.id}"] = self.annotated(field.annotation)
        functions = [part for part in node.body if isinstance(part, ast.FunctionDef)]
        for function in sorted(functions, key=lambda f: f.name != "__init__"):
            self.visit(function)
        self.known = outer

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        outer = dict(self.known)
        for argument in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs):
            self.known[argument.arg] = self.annotated(argument.annotation)
        for part in node.body:
            self.visit(part)
        mine = {name: value for name, value in self.known.items() if name.startswith("self.")}
        self.known = outer | mine

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        self.note(node.target, self.annotated(node.annotation))
        self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> None:
        self.visit(node.value)
        for target in node.targets:
            if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                for part, value in zip(target.elts, node.value.elts, strict=False):
                    self.note(part, self.resolve(value))
            else:
                self.note(target, self.resolve(node.value))

    def visit_For(self, node: ast.For) -> None:
        self.note(node.target, self.resolve(node.iter))
        self.generic_visit(node)

    def comprehension(self, node: ast.GeneratorExp | ast.ListComp | ast.SetComp | ast.DictComp) -> None:
        for part in node.generators:
            self.note(part.target, self.resolve(part.iter))
        self.generic_visit(node)

    visit_GeneratorExp = visit_ListComp = visit_SetComp = visit_DictComp = comprehension

    def visit_Attribute(self, node: ast.Attribute) -> None:
        if isinstance(node.ctx, ast.Load):
            self.resolve(node)
        self.generic_visit(node)


def fields_read(sources: Iterator[ast.AST], classes: Classes) -> set[tuple[str, str]]:
    found = set()
    for source in sources:
        reader = Reader(classes)
        reader.visit(source)
        found |= reader.reads
    return found


def product() -> Iterator[ast.AST]:
    return (repository.tree(path) for path in repository.modules(*repository.PACKAGES) if path not in DEFINITIONS)


def knobs() -> list[tuple[str, str, FieldInfo]]:
    return [(c.__name__, name, field) for c in settings_classes() for name, field in c.model_fields.items()]


def numbers(annotation: object, metadata: list[Any]) -> Iterator[tuple[type, list[Any]]]:
    """The numeric types inside of an annotation, each with what bounds it."""
    if annotation in (int, float):
        assert isinstance(annotation, type)
        yield annotation, metadata
    elif get_origin(annotation) is typing.Annotated:
        inner, *more = get_args(annotation)
        extra = [entry for part in more for entry in (part.metadata if isinstance(part, FieldInfo) else [part])]
        yield from numbers(inner, extra)
    else:
        for part in get_args(annotation):
            yield from numbers(part, [])


def test_every_knob_is_read() -> None:
    reads = fields_read(product(), classes_by_name())
    owners = {name: type(value).__name__ for name, value in PipelineSettings()}
    sections = {section for spec in STEPS.values() for section in spec.sections}  # test_entries: steps read them
    reads |= {("PipelineSettings", section.partition(".")[0]) for section in sections}
    reads |= {(owners[stage], knob) for stage, _, knob in (section.partition(".") for section in sections) if knob}
    unread = [f"{c}.{name}" for c, name, field in knobs() if not is_choice(field) and (c, name) not in reads]
    assert not unread, f"no code reads (from an annotated value): {', '.join(unread)}"


class Wheel(BaseModel):
    spokes: int
    tire: int


class Cart(BaseModel):
    wheels: tuple[Wheel, ...]
    color: int


@pytest.mark.parametrize(
    ("source", "reads"),
    [
        ("def f(w: Wheel): return w.spokes", {("Wheel", "spokes")}),
        ("def f(w): return w.spokes", set()),
        ("def f(w: Wheel): w.spokes = 1", set()),
        ("def f(c: Cart): return [w.tire for w in c.wheels]", {("Cart", "wheels"), ("Wheel", "tire")}),
        ("def f(job): s: Cart = job.settings; return s.color", {("Cart", "color")}),
        ("class C:\n def g(self): return self.w.tire\n def __init__(self, w: Wheel): self.w = w", {("Wheel", "tire")}),
    ],
)
def test_a_knob_that_nobody_reads_would_be_noticed(source: str, reads: set[tuple[str, str]]) -> None:
    classes = {"Wheel": (Wheel,), "Cart": (Cart,)}
    assert fields_read(iter([ast.parse(source)]), classes) == reads


@pytest.mark.parametrize("settings", settings_classes(), ids=lambda c: c.__name__)
def test_every_member_of_a_union_is_chosen_somewhere(settings: type[Settings]) -> None:
    if any(is_choice(field) for field in settings.model_fields.values()):
        names = {node.id for source in product() for node in ast.walk(source) if isinstance(node, ast.Name)}
        alone = len([c for c in classes_by_name().values() if settings in c]) == 1
        assert settings.__name__ in names or alone


@pytest.mark.parametrize(("owner", "name", "field"), knobs(), ids=lambda value: value if isinstance(value, str) else "")
def test_every_number_is_bounded(owner: str, name: str, field: FieldInfo) -> None:
    for _, bounds in numbers(field.annotation, field.metadata):
        assert any(isinstance(bound, BOUNDS) for bound in bounds), f"{owner}.{name} may be any number"


@pytest.mark.parametrize("settings", settings_classes(), ids=lambda c: c.__name__)
def test_infinity_and_nan_are_refused(settings: type[Settings]) -> None:
    valid = example(settings).model_dump(mode="json")
    for name, field in settings.model_fields.items():
        if any(kind is float for kind, _ in numbers(field.annotation, [])):
            for wrong in (math.inf, -math.inf, math.nan):
                value = (wrong,) if get_origin(field.annotation) is tuple else wrong
                with pytest.raises(ValidationError):
                    settings.model_validate({**valid, name: value})
                    pytest.fail(f"{settings.__name__}.{name} takes {wrong}")


def test_an_unbounded_number_would_be_noticed() -> None:
    class Loose(BaseModel):
        model_config = ConfigDict(extra="forbid")
        tight: tuple[typing.Annotated[float, Field(gt=0)], ...]
        loose: tuple[float, ...] = Field(min_length=1)

    bounded = {
        name: all(any(isinstance(b, BOUNDS) for b in bounds) for _, bounds in numbers(field.annotation, field.metadata))
        for name, field in Loose.model_fields.items()
    }
    assert bounded == {"tight": True, "loose": False}


@pytest.mark.parametrize(("owner", "name", "field"), knobs(), ids=lambda value: value if isinstance(value, str) else "")
def test_every_number_says_what_it_is(owner: str, name: str, field: FieldInfo) -> None:
    if any(numbers(field.annotation, [])):
        assert field.description or name in EVIDENT, f"{owner}.{name} has no description"


@pytest.mark.parametrize("settings", settings_classes(), ids=lambda c: c.__name__)
def test_the_defaults_are_allowed_and_nothing_else_is_taken(settings: type[Settings]) -> None:
    value = example(settings)
    tree = value.model_dump(mode="json")
    assert settings.model_validate(tree) == value
    with pytest.raises(ValidationError):
        settings.model_validate({**tree, "nonsense": 1})


@pytest.mark.parametrize("name", PROFILES)
def test_every_profile_is_allowed(name: str) -> None:
    settings = profile(name)
    assert PipelineSettings.model_validate(settings.model_dump(mode="json")) == settings
    assert revise(settings, {}) == settings


@pytest.mark.parametrize("name", PROFILES)
def test_every_knob_can_be_set_by_its_path(name: str) -> None:
    settings = profile(name)
    for path, value in leaves(settings.model_dump(mode="json")):
        assert revise(settings, {path: value}) == settings
        with pytest.raises(BadInput, match="unknown setting"):
            revise(settings, {f"{path}x": value})


def leaves(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{name}.")
        elif name != "kind":
            yield f"{prefix}{name}", value


def example(settings: type[Settings]) -> Settings:
    """An instance: the defaults, and for fields without one the pipeline's own or something small."""
    given: dict[str, Any] = {"until": 1.0, "size": 64}
    pipeline = PipelineSettings()
    values = {
        name: getattr(pipeline, name, given.get(name))
        for name, field in settings.model_fields.items()
        if field.is_required()
    }
    return settings(**values)
