"""Nodes of a configuration: descriptions of objects by class and settings.

A stored node is a mapping with the class under ``_target_``.
:func:`lcc_rl.config.schemas.parse_config` converts each to a :class:`Node`, including nested ones.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType
from typing import Any, Self

from lcc_rl.errors import LARGEST, ConfigError, line_of, replacing, require, unknown_name
from lcc_rl.settings import TARGET, Settings, defaults, find_target, parse, values
from lcc_rl.settings import as_plain as as_plain

MISSING = "???"
STORED = (str, int, float, type(None), list, Mapping)
CALLED = ("__call__",)  # required of objects that are used as functions


def _place(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


class Node:
    """Description of an object: class, settings and their place in the configuration.

    A node is immutable; :meth:`changed` returns another one. Copies share the object. Other
    processes receive the settings only.

    Args:
        settings: settings by name, as stored, with ``_target_`` and the defaults of the class;
            descriptions of objects are nodes.
        where: their place in the configuration, for messages.
    """

    settings: Mapping[str, Any]
    where: str

    def __init__(self, settings: Mapping[str, Any], where: str) -> None:
        vars(self).update(settings=MappingProxyType(dict(settings)), where=where)

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"{self.where}: a node does not change; use changed({name}=…)")

    @classmethod
    def of(cls, settings: Mapping[str, Any], where: str) -> Self:
        """Return the checked node of a mapping with ``_target_``, completed by defaults.

        Raises:
            ConfigError: naming the wrong setting.
        """
        for key, _, value in settings_at(as_plain(settings), where):
            if not isinstance(value, STORED):
                raise ConfigError(
                    f"{key} is {value!r}, which a configuration cannot store; expected numbers, "
                    "texts, lists, mappings or objects of settings"
                )
        node = as_nodes(with_defaults(settings, where), where)
        if not isinstance(node, cls):
            raise ConfigError(f"{where}: expected {TARGET}: module.Class, got {settings!r}")
        check_nodes(node)
        return node

    def changed(self, **settings: Any) -> Self:
        """Return the node with other settings."""
        return self.of({**self.settings, **settings}, self.where)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Node) and self.settings == other.settings

    __hash__ = None  # type: ignore[assignment]

    def __deepcopy__(self, memo: Any) -> Self:
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (dict(self.settings), self.where)

    def __repr__(self) -> str:
        return repr(as_plain(self))

    @cached_property
    def kind(self) -> Any:
        """The class or function."""
        return find_target(str(self.settings[TARGET]), self.where)

    @property
    def name(self) -> str:
        """Its name in tables: ``ddpg`` for the agent DDPG."""
        return str(self.settings[TARGET]).rpartition(".")[2].lower()

    def stored(self) -> dict[str, Any]:
        """Return the settings."""
        return dict(self.settings)

    def made(self, needed: type | Sequence[str] = object) -> Any:
        """Return the object; for a class with :class:`Settings` it is always the same one.

        Args:
            needed: the class of the object, or its required methods and attributes.

        Raises:
            ConfigError: if it cannot be built, or has another class.
        """
        value = self._object if has_settings(self.kind) else self._made()
        if isinstance(needed, type):
            fits, expected = isinstance(value, needed), f"a subclass of {_place(needed)}"
        else:
            fits, expected = all(hasattr(value, x) for x in needed), f"an object with {needed[0]}"
        require(fits, f"{self.where}: expected {expected}, got {_place(type(value))}")
        return value

    def check(self) -> None:
        """Check the settings; a class or function without :class:`Settings` is not called."""
        self._check_parts()
        if has_settings(self.kind):
            self.made()
        else:
            self._check_names()

    @cached_property
    def _object(self) -> Any:
        return self._made()

    def _made(self) -> Any:
        presets = defaults(self.kind) if has_settings(self.kind) else {}
        arguments = {
            key: value
            for key, value in self.settings.items()
            # A default need not have the annotated type, and may be any object.
            if not (key == TARGET or (key in presets and _same(as_plain(value), presets[key])))
        }

        def unbuilt(error: Exception) -> ConfigError | None:
            reason = f"{self.kind.__name__} cannot be built: {line_of(error, True)}"
            named = isinstance(error, OSError)  # it names its file
            return None if named else ConfigError(f"{self.where}: {reason}")

        with replacing(unbuilt):  # a user's class may raise any error
            arguments = {key: _objects(value) for key, value in arguments.items()}
            if has_settings(self.kind):
                return parse(self.kind, arguments, self.where)
            self._check_names()
            for key in (key for key, value in arguments.items() if value == MISSING):
                raise ConfigError(f"{self.where}.{key} is required: use {self.where}.{key}=…")
            return self.kind(**arguments)

    def _check_parts(self) -> None:
        """Refuse a setting that only the nodes inside have, and name their settings."""
        names = settings_of(self.kind)
        for key in sorted(self.settings.keys() - {TARGET, *names}) if names is not None else ():
            having = (x for x in nodes_in(self) if key in (settings_of(x.kind) or ()))
            places = ", ".join(f"{x.where}.{key}" for x in having)
            text = f"{self.where}.{key}: {self.kind.__name__} has no {key}, its parts have it"
            require(not places, f"{text}: {places}")

    def _check_names(self) -> None:
        names = settings_of(self.kind)
        for key in self.settings if names is not None else ():
            if key not in (names or ()) and key != TARGET:
                subject = f"setting of {self.where} ({self.kind.__name__})"
                raise unknown_name(subject, key, names or ())


def _same(one: Any, other: Any) -> bool:
    return type(one) is type(other) and bool(one == other)


def _objects(value: Any) -> Any:
    """Return a setting with objects in place of nodes."""
    if isinstance(value, Node):
        return value.made()
    if isinstance(value, Mapping):
        return {key: _objects(item) for key, item in value.items()}
    return [_objects(item) for item in value] if isinstance(value, list) else value


def as_nodes(value: Any, where: str = "") -> Any:
    """Return a setting in which every mapping with ``_target_`` is a :class:`Node`.

    Args:
        value: a setting as plain containers, or with nodes in them.
        where: its place in the configuration.
    """
    return _mapped(value, where, lambda found, at: Node(found, at) if TARGET in found else found)


def _mapped(value: Any, where: str, change: Callable[[dict[str, Any], str], Any]) -> Any:
    """Change every mapping, the inner ones first, by itself and its place."""
    if isinstance(value, list):
        return [_mapped(item, f"{where}[{index}]", change) for index, item in enumerate(value)]
    if not isinstance(value, Mapping):
        return value
    named = {str(key): x for key, x in value.items()}  # Hydra reads {1: …} as a number
    places = {key: f"{where}.{key}".removeprefix(".") for key in named}
    return change({key: _mapped(x, places[key], change) for key, x in named.items()}, where)


def without_defaults(value: Any) -> Any:
    """Return settings as plain containers without those that equal the default of their class.

    Settings that a later version adds are thus absent if their default changes nothing.
    """
    if isinstance(value, Node):
        presets = defaults(value.kind) if has_settings(value.kind) else {}
        value = value.settings
    elif isinstance(value, Settings):
        presets, value = defaults(type(value)), values(value)
    elif isinstance(value, Mapping):
        presets = {}
    else:
        return [without_defaults(item) for item in value] if isinstance(value, list) else value
    missing = object()
    changed = {key: x for key, x in value.items() if as_plain(x) != presets.get(key, missing)}
    return {key: without_defaults(item) for key, item in changed.items()}


def nodes_in(value: Any) -> Iterator[Node]:
    """Yield the nodes in a configuration or a part of one, each before those nested in it."""
    if isinstance(value, Node):
        yield value
        value = value.settings
    elif isinstance(value, Settings):
        value = values(value)
    if isinstance(value, Mapping):
        value = list(value.values())
    for inner in value if isinstance(value, list) else ():
        yield from nodes_in(inner)


def check_nodes(value: Any) -> None:
    """Check every node in a configuration or a part of one."""
    for node in nodes_in(value):
        node.check()


def has_settings(kind: Any) -> bool:
    """Whether this is a class with :class:`Settings`."""
    return inspect.isclass(kind) and issubclass(kind, Settings)


def settings_of(target: Any) -> list[str] | None:
    """Return the names of a class's or function's settings; None if it takes any."""
    try:
        params = inspect.signature(target).parameters
    except (TypeError, ValueError):  # some builtins have no signature
        return None
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in params.values()):
        return None
    return list(params)


def with_defaults(value: Any, where: str = "") -> Any:
    """Return a setting in which every mapping with ``_target_`` contains the defaults of its class.

    Args:
        value: a setting as plain containers; references to other settings may be unresolved.
        where: its place in the configuration, for messages.
    """
    return _mapped(value, where, _completed)


def _completed(settings: dict[str, Any], where: str) -> dict[str, Any]:
    kind: Any = find_target(str(settings[TARGET]), where) if TARGET in settings else None
    for key in settings if kind is not None else ():
        if str(key).startswith("_") and key != TARGET:
            raise ConfigError(f"{where}.{key} has no effect: a node has {TARGET} and settings")
    if has_settings(kind):
        for key, default in defaults(kind).items():
            value = settings.setdefault(key, default)
            if isinstance(value, Mapping) and isinstance(default, Mapping):
                settings[key] = {**default, **value}
    return settings


def takes_action(node: Node) -> bool:
    """Whether a controller, or one inside it, executes the action of a policy."""
    kinds = [inner.kind for inner in nodes_in(node)]
    reads = (name for kind in kinds for name in getattr(kind, "reads", ()))
    hybrid = any(getattr(kind, "takes_action", False) for kind in kinds)
    return hybrid or any(name.endswith(".action") for name in reads)


def check_numbers(value: Any, where: str) -> None:
    """Refuse numbers that are not finite or too large, also in lists and mappings."""
    for key, _, item in settings_at(value, where):
        if isinstance(item, float) and not abs(item) <= LARGEST:
            raise ConfigError(
                f"{key} must be a finite number of size {LARGEST:g} at most, got {item}"
            )
        if isinstance(item, int) and not abs(item) < 2**63:
            raise ConfigError(f"{key} must be a number of 63 bits, got {item.bit_length()} bits")


def settings_at(content: Any, where: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield dotted key, container and value of every value in nested mappings and lists."""
    if isinstance(content, (Mapping, list)):
        entries = content.items() if isinstance(content, Mapping) else enumerate(content)
        for key, value in entries:
            name = f"{where}.{key}" if where else str(key)
            yield name, content, value
            yield from settings_at(value, name)
