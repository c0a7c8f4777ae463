"""Nodes of a configuration: a mapping whose ``_target_`` names the class that it describes."""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from typing import Any

from lcc_rl.errors import LARGEST, ConfigError, LccError, unknown_name
from lcc_rl.settings import Settings, defaults, parse

TARGET = "_target_"
MISSING = "???"
CALLED = ("__call__",)  # what a node that is used as a function makes


def is_node(value: Any) -> bool:
    """Whether a setting describes an object."""
    return isinstance(value, Mapping) and TARGET in value


def short_name(target: object) -> str:
    """Return what tables call the class that a ``_target_`` names: ``ddpg`` of the agent DDPG."""
    return str(target).rpartition(".")[2].lower()


def path_of(kind: Any) -> str:
    """Return the ``_target_`` that names a class or function.

    Raises:
        ConfigError: if a module does not hold it by its name.
    """
    module, name = (getattr(kind, key, None) for key in ("__module__", "__qualname__"))
    if not module or not name or getattr(import_module(module), name, None) is not kind:
        raise ConfigError(
            f"{name or kind!r} cannot be named in a configuration: define it at the top of a "
            "module, of a script or of a notebook"
        )
    return f"{module}.{name}"


def find_target(target: str, where: str) -> Any:
    """Return the class or function that a ``_target_`` names."""
    module, _, name = target.rpartition(".")
    try:
        found = getattr(import_module(module), name)
    except Exception as error:  # a module of the user's own may raise anything
        hint = ""
        if not isinstance(error, (ImportError, AttributeError, ValueError)):
            raise ConfigError(f"{where}: {module} cannot be imported: {error}") from error
        if isinstance(error, ModuleNotFoundError) and not str(error.name).startswith("lcc_rl"):
            hint = "; if it is a file of your own, export PYTHONPATH=<its folder>"
        raise ConfigError(f"{where}.{TARGET}: cannot find {target!r}: {error}{hint}") from error
    if not callable(found):
        raise ConfigError(f"{where}.{TARGET}: {target!r} is no class or function")
    return found


def settings_of(target: Any) -> list[str] | None:
    """Return the names of a class's or function's settings; None if it takes any."""
    try:
        found = inspect.signature(target).parameters
    except (TypeError, ValueError):  # some builtins do not tell
        return None
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in found.values()):
        return None
    return list(found)


def with_defaults(value: Any, where: str = "") -> Any:
    """Return a setting in which every node holds the defaults of its class, too.

    Args:
        value: a setting as plain containers; references to other settings may be unresolved.
        where: its place in the configuration, for messages.
    """
    if isinstance(value, list):
        return [with_defaults(item, f"{where}[{place}]") for place, item in enumerate(value)]
    if not isinstance(value, Mapping):
        return value
    found = {
        key: with_defaults(item, f"{where}.{key}".removeprefix(".")) for key, item in value.items()
    }
    kind = find_target(str(found[TARGET]), where) if TARGET in found else None
    if inspect.isclass(kind) and issubclass(kind, Settings):
        for key, default in defaults(kind).items():
            own = found.setdefault(key, default)
            if isinstance(own, Mapping) and isinstance(default, Mapping):
                found[key] = {**default, **own}
    return found


def check_nodes(value: Any, where: str) -> None:
    """Check every node in a setting.

    Args:
        value: a setting as plain containers.
        where: its place in the configuration, for messages.
    """
    for key, _, node in [(where, None, value), *settings_at(value, where)]:
        if is_node(node):
            kind = find_target(str(node[TARGET]), key)
            if inspect.isclass(kind) and issubclass(kind, Settings):
                build(node, key)
            else:
                _check_names(kind, node, key)


def build(
    node: Any,
    where: str,
    needed: type | Sequence[str] = object,
    world: Any = None,
    name: str | None = None,
    **resources: Any,
) -> Any:
    """Construct the object that a node describes, and first those nested in it.

    Args:
        node: a mapping with ``_target_``; its other keys are the settings of that class, or the
            arguments of that function.
        where: the node's place in the configuration, for messages.
        needed: the class of the object, or the methods and attributes that it must have.
        world: the :class:`lcc_rl.pieces.world.World` that a part of an environment is put into.
        name: the name of the part there.
        **resources: further arguments of a class or function without :class:`Settings`, given
            where its parameters have these names.
    """
    if not is_node(node):
        without = f"; to leave it out, use ~{where}" if node is None else ""
        raise ConfigError(f"{where}: expected a node with {TARGET}, got {node!r}{without}")
    kind = find_target(str(node[TARGET]), where)
    given = {key: value for key, value in node.items() if not str(key).startswith("_")}
    for key, value in given.items():
        if is_node(value):
            given[key] = build(value, f"{where}.{key}", **resources)
    try:
        made = _made(kind, given, where, resources)
        if world is not None and hasattr(made, "bind"):
            made = made.bind(world, name)
    except (LccError, OSError):  # an OSError names its file, which says more than the node
        raise
    except Exception as error:  # a class of the user's own may raise anything
        reason = f"{type(error).__name__}: {error}"
        raise ConfigError(f"{where}: {kind.__name__} cannot be built: {reason}") from error
    if not _fits(made, needed):
        called = needed.__name__ if isinstance(needed, type) else f"an object with {needed[0]}"
        raise ConfigError(f"{where}: expected {called}, got {type(made).__name__}")
    return made


def _made(kind: Any, given: dict[str, Any], where: str, resources: dict[str, Any]) -> Any:
    if inspect.isclass(kind) and issubclass(kind, Settings):
        return parse(kind, given, where)
    known = _check_names(kind, given, where)
    for key, value in given.items():
        if value == MISSING:
            raise ConfigError(f"{where}.{key} is required: use {where}.{key}=…")
    offered = {k: v for k, v in resources.items() if k in known and k not in given}
    return kind(**given, **offered)


def _check_names(kind: Any, given: Mapping[str, Any], where: str) -> list[str]:
    """Refuse settings that a class or function without :class:`Settings` does not have."""
    known = settings_of(kind)
    for key in given if known is not None else ():
        if key not in known and not key.startswith("_"):  # type: ignore[operator]
            raise unknown_name(f"setting of {where} ({kind.__name__})", key, known or ())
    return known or []


def _fits(made: Any, needed: type | Sequence[str]) -> bool:
    if isinstance(needed, type):
        return isinstance(made, needed)
    return all(hasattr(made, name) for name in needed)


def takes_action(node: Any) -> bool:
    """Whether a controller, or one inside it, carries out the action of a policy."""
    reads = (getattr(kind, "reads", ()) for kind in _kinds(node))
    return any(name.endswith(".action") for names in reads for name in names)


def takes_population(node: Any) -> bool:
    """Whether a controller, or one inside it, drives as the drivers of a population."""
    return any(getattr(kind, "takes_population", False) for kind in _kinds(node))


def _kinds(node: Any) -> list[Any]:
    """Return the classes of a controller and of those inside it."""
    nodes = [node, *(inner for _, _, inner in settings_at(node))]
    return [find_target(str(one[TARGET]), "controller") for one in nodes if is_node(one)]


def check_numbers(value: Any, where: str) -> None:
    """Refuse numbers that are not finite or too large, in lists and mappings, too."""
    for key, _, item in settings_at(value, where):
        if isinstance(item, float) and not abs(item) <= LARGEST:
            raise ConfigError(
                f"{key} must be a finite number of size {LARGEST:g} at most, got {item}"
            )
        if isinstance(item, int) and not abs(item) < 2**63:
            raise ConfigError(f"{key} must be a number of 63 bits, got {item.bit_length()} bits")


def settings_at(content: Any, where: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield every value in nested mappings and lists: its dotted key, what holds it, and itself."""
    if isinstance(content, (Mapping, list)):
        items = content.items() if isinstance(content, Mapping) else enumerate(content)
        for key, value in items:
            name = f"{where}.{key}" if where else str(key)
            yield name, content, value
            yield from settings_at(value, name)


def forget_places(content: Mapping[str, Any]) -> list[str]:
    """Set every setting that names a place to write to null; a class lists them as ``WRITES``.

    Args:
        content: a configuration as plain containers, changed in place.

    Returns:
        The settings that named one, as ``key=value``.
    """
    found = []
    for key, node, target in list(settings_at(content)):
        if key.rpartition(".")[2] != TARGET:
            continue
        where = key.removesuffix(TARGET)
        try:
            names = getattr(find_target(str(target), where), "WRITES", ())
        except ConfigError:  # building the node says so
            continue
        for name in names:
            if node.get(name) is not None:
                found.append(f"{where}{name}={node[name]}")
                node[name] = None
    return found
