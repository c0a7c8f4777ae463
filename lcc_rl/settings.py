"""Settings of a class as annotated, checked fields.

A class that derives from :class:`Settings` is a pydantic dataclass: an annotated name in its body
is a setting with type, range and default; names without annotation are plain class attributes::

    class Comfort(RewardTerm):
        limit: Positive = 2.0    # jerk below notice [m/s³]
        reads = ("self.jerk",)
        def reward(self, jerk): return -(jerk.abs() - self.limit).clamp(min=0.0)

Unknown names, values of another type, and numbers outside their range or not finite raise a
:class:`ConfigError` that names the setting.
"""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
from collections.abc import Callable, Mapping
from functools import wraps
from importlib import import_module
from types import UnionType
from typing import (
    Annotated,
    Any,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from pydantic import AfterValidator, ConfigDict, Field, ValidationError, validate_call
from pydantic.dataclasses import dataclass
from pydantic.fields import FieldInfo

from lcc_rl.errors import (
    LARGEST,
    LARGEST_SIZE,
    LAST_SEED,
    ConfigError,
    in_short,
    is_ours,
    line_of,
    nearest,
    replacing,
    unknown_name,
)

Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(gt=0.0, le=LARGEST)]
NonNegative = Annotated[float, Field(ge=0.0, le=LARGEST)]
Speed = Annotated[float, Field(ge=0.0, le=100.0)]  # speed of a vehicle [m/s]
Acceleration = Annotated[float, Field(gt=0.0, le=12.0)]  # most of a car's brakes or drive [m/s²]
LearningRate = Annotated[float, Field(gt=0.0, le=1.0)]
Share = Annotated[float, Field(ge=0.0, lt=1.0)]
Count = Annotated[int, Field(ge=1, le=LARGEST_SIZE)]
Whole = Annotated[int, Field(ge=0)]
Seed = Annotated[int, Field(ge=0, le=LAST_SEED)]
Million = Annotated[int, Field(ge=1, le=1_000_000)]
MOST_PARALLEL = max(64, 4 * (os.cpu_count() or 1))  # most threads or processes of a command
Parallel = Annotated[int, Field(ge=1, le=MOST_PARALLEL)]


def _increasing(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError(f"must not fall, got {list(ends)}")
    return ends


Increasing = AfterValidator(_increasing)  # checks the two ends of a range

# Range of a factor that training episodes draw by their seed; 1 in an evaluation.
Factors = Annotated[tuple[Positive, Positive], Increasing]

# What pydantic adds to a place for the one of several types that it tried.
ONE_TYPE = re.compile(r"constrained-\w+|[\w-]+\[.*|int|float|str|bool|callable")
TARGET = "_target_"  # the key that names the class of a node
STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

S = TypeVar("S", bound="Settings")
R = TypeVar("R")


@dataclass_transform(kw_only_default=True, eq_default=False)
class Settings:
    """Base of classes with annotated fields as settings; see the module."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "__init__" in vars(cls):
            raise TypeError(f"{cls.__name__}: settings are annotated fields, without __init__")
        dataclass(cls, kw_only=True, eq=False, config=STRICT)
        construct = cls.__init__

        @wraps(construct)
        def checked(self: Any, **settings: Any) -> None:
            # Of pydantic, whose ValidationError is one, or of validate.
            with replacing(lambda error: refused(error, cls, cls.__name__), ValueError):
                construct(self, **_converted(cls, settings, cls.__name__))
                self.validate()

        cls.__init__ = checked  # type: ignore[method-assign]

    def validate(self) -> None:
        """Check relations between the settings, and derive values from them.

        Raises:
            ValueError: describing the error; the place of the settings is added to its message.
        """


def parse(kind: type[S], given: Mapping[str, Any], where: str) -> S:
    """Construct a class from external settings.

    Args:
        kind: the class.
        given: its settings by name; a list may stand for a tuple, a mapping for an object with
            settings or a dataclass.
        where: their place in the configuration, for messages.

    Raises:
        ConfigError: naming the first unknown or wrong setting.
    """
    settings = {key: value for key, value in given.items() if value != "???"}
    try:
        return kind(**_converted(kind, settings, where))
    except RefusedSetting as error:
        if error.__cause__ is None:  # it contains its place already
            raise
        raise refused(error.__cause__, kind, where) from None


def _converted(kind: type[Settings], given: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return settings as their annotations declare them."""
    types = {name: field.annotation for name, field in kind.__pydantic_fields__.items()}  # type: ignore[attr-defined]
    return {name: _as_declared(types.get(name), x, f"{where}.{name}") for name, x in given.items()}


def _as_declared(annotation: Any, value: Any, where: str) -> Any:
    """Return lists as tuples and mappings as objects according to the annotation."""
    kind, inner = get_origin(annotation) or annotation, get_args(annotation)
    if kind is Annotated:
        return _as_declared(inner[0], value, where)
    if kind in (Union, UnionType):
        choices = (_as_declared(arg, value, where) for arg in inner)
        return next((x for x in choices if type(x) is not type(value) or x != value), value)
    if isinstance(value, list) and inner:
        args = inner if len(inner) == len(value) and ... not in inner else inner[:1] * len(value)
        items = [_as_declared(arg, x, where) for arg, x in zip(args, value, strict=True)]
        return tuple(items) if kind is tuple else items
    if not isinstance(value, Mapping) or not inspect.isclass(kind):
        return value
    if issubclass(kind, Mapping):
        of = inner[1] if inner else Any
        return {key: _as_declared(of, x, f"{where}.{key}") for key, x in value.items()}
    if inspect.isabstract(kind):
        return value
    if issubclass(kind, Settings):
        return parse(kind, value, where)
    if dataclasses.is_dataclass(kind):
        hints = get_type_hints(kind)
        return kind(**{name: _as_declared(hints.get(name), x, where) for name, x in value.items()})
    return value


class RefusedSetting(ConfigError):
    """A setting that its class refuses; its cause is the ValueError with the reason."""


def refused(error: Any, kind: Any, where: str) -> ConfigError:
    """Return the one-line error for a ValueError or pydantic's first error."""
    return RefusedSetting(_reason(error, kind, where))


def _reason(error: Any, kind: Any, where: str) -> str:
    if not isinstance(error, ValidationError):
        return f"{where}: {error}".removeprefix(": ")
    first = error.errors()[0]
    if first["type"] in ("unexpected_keyword_argument", "unexpected_positional_argument"):
        names = [field.name for field in dataclasses.fields(kind)]
        what = f"setting of {where} ({kind.__name__})" if where else "option"
        name = str(first["loc"][-1])
        plain = f" A setting has a type: {name}: float = …" if hasattr(kind, name) else ""
        return f"{unknown_name(what, name, names)}{plain}"
    place = [x for x in first["loc"] if x == first["loc"][0] or not ONE_TYPE.fullmatch(str(x))]
    path = "".join(f"[{x}]" if isinstance(x, int) else f".{x}" for x in place)
    key = (where + path).removeprefix(".")
    if first["type"] == "missing" and len(first["loc"]) == 1:
        return f"{key} is required: use {key}=…"
    if first["type"] == "value_error":
        return f"{key}: {first['ctx']['error']}"
    rule = re.sub(r"^\w+ should", "must", first["msg"])
    return f"{key} {rule}, got {in_short(first['input'], 200)}"


def checked(function: Callable[..., R]) -> Callable[..., R]:
    """Decorate a function so that its annotated arguments are checked as settings."""
    call = validate_call(config=STRICT)(function)
    names = inspect.signature(function)

    @wraps(function)
    def checking(*args: Any, **kwargs: Any) -> R:
        try:
            given = names.bind(*args, **kwargs).arguments
        except TypeError as error:
            raise TypeError(f"{function.__name__}() {error}") from None
        try:
            return call(**given)
        except ValidationError as error:
            raise refused(error, function, function.__name__) from error

    return checking


def values(settings: Any, of: Any = None) -> dict[str, Any]:
    """Return the settings of an object by name; ``of``: those of a class only."""
    names = (field.name for field in dataclasses.fields(of or settings))
    return {name: getattr(settings, name) for name in names}


def defaults(kind: type[Settings]) -> dict[str, Any]:
    """Return the defaults of a class's settings by name, as plain containers."""
    plain = {}
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        if isinstance(field.default, FieldInfo):
            if not field.default.is_required():
                plain[field.name] = as_plain(field.default.get_default(call_default_factory=True))
        elif field.default is not dataclasses.MISSING:
            plain[field.name] = as_plain(field.default)
        elif field.default_factory is not dataclasses.MISSING:
            plain[field.name] = as_plain(field.default_factory())
    return plain


def as_plain(value: Any) -> Any:
    """Return a configuration, a part of one or a node as plain containers, as files store them."""
    if hasattr(value, "stored"):  # a node
        value = value.stored()
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = values(value)
    if isinstance(value, Mapping):
        return {key: as_plain(item) for key, item in value.items()}
    return [as_plain(item) for item in value] if isinstance(value, (list, tuple)) else value


def path_of(kind: Any) -> str:
    """Return the ``_target_`` that names a class or function.

    Raises:
        ConfigError: if its module does not contain it by its name.
    """
    module, name = (getattr(kind, key, None) for key in ("__module__", "__qualname__"))
    if not module or not name or getattr(import_module(module), name, None) is not kind:
        raise ConfigError(
            f"{name or kind!r} cannot be named in a configuration: define it at the top level of "
            "a module, a script or a notebook"
        )
    return f"{module}.{name}"


def find_target(target: str, where: str) -> Any:
    """Return the class or function of a ``_target_``.

    Raises:
        ConfigError: naming its place in the configuration, if there is none.
    """
    module, _, name = target.rpartition(".")
    where = f"{where}.{TARGET}"
    holder = load_module(module, where, target)
    member = getattr(holder, name, None)
    if not callable(member):
        hint = f"{module} has no {name!r}.{nearest(name, dir(holder))}"
        reason = hint if member is None else "it is no class or function"
        raise ConfigError(f"{where}: cannot find {target!r}: {reason}")
    return member


def load_module(module: str, where: str, target: str = "") -> Any:
    """Return a module, for an object ``target`` in it.

    Raises:
        ConfigError: naming the place in the configuration, if it cannot be imported.
    """

    def refused_import(error: Exception) -> ConfigError:
        if not isinstance(error, (ImportError, AttributeError, ValueError)):
            return ConfigError(f"{where}: {module} cannot be imported: {line_of(error)}")
        hint = ""
        if isinstance(error, ModuleNotFoundError) and not is_ours(error.name):
            hint = "; for your own file, export PYTHONPATH=<its folder>"
        return ConfigError(f"{where}: cannot find {target or module!r}: {line_of(error)}{hint}")

    with replacing(refused_import):  # a user's module may raise any error
        return import_module(module)
