"""Hydra composes the package's files once for each choice of files: half of the suite's time.

What a test types on top of the choice, as ``agent.hidden=[8]``, is still parsed, merged and checked
every time. Files of other places than the package are never kept.
"""

from __future__ import annotations

import pickle
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
from hydra._internal import config_loader_impl as loader
from hydra._internal.config_repository import ConfigRepository, IConfigRepository
from hydra.core.default_element import ResultDefault
from hydra.core.override_parser.types import Override
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig

CONSTANT = {"pkg", "structured"}  # schemes of files that no test writes
LOADER = loader.ConfigLoaderImpl
READ, CHOOSE, MERGE = (
    ConfigRepository.load_config,
    loader.create_defaults_list,
    LOADER._compose_config_from_defaults_list,
)


@contextmanager
def composed_once() -> Iterator[None]:
    """Keep what files hold, chosen lists of files, and what each list is merged to."""
    with _with(_reading(READ), _choosing(CHOOSE), _merging(MERGE)):
        yield


@contextmanager
def composed_anew() -> Iterator[None]:
    """Let Hydra compose as it does for a user."""
    with _with(READ, CHOOSE, MERGE):
        yield


@contextmanager
def _with(read: Any, choose: Any, merge: Any) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ConfigRepository, "load_config", read)
        patch.setattr(loader, "create_defaults_list", choose)
        patch.setattr(LOADER, "_compose_config_from_defaults_list", merge)
        yield


def _reading(read: Any) -> Any:
    known: dict[Hashable, bytes] = {}

    def load_config(self: ConfigRepository, config_path: str) -> ConfigResult | None:
        places = _sources(self)
        if not places:
            return read(self, config_path)
        key = places, config_path
        if key not in known:
            known[key] = pickle.dumps(read(self, config_path))
        return pickle.loads(known[key])

    return load_config


def _choosing(choose: Any) -> Any:
    known: dict[Hashable, Any] = {}

    def create_defaults_list(
        repo: IConfigRepository,
        config_name: str | None,
        overrides_list: list[Override],
        **how: bool,
    ) -> Any:
        places = _sources(repo)
        if not places:
            return choose(repo, config_name, overrides_list, **how)
        typed = [item for item in overrides_list if not item.is_sweep_override()]
        values = [item for item in typed if _is_value(item, repo)]
        groups = [item for item in typed if not _is_value(item, repo)]
        lines = tuple(item.input_line for item in groups)
        key = places, config_name, lines, tuple(sorted(how.items()))
        if key not in known:
            known[key] = choose(repo, config_name, groups, **how)
        return replace(known[key], config_overrides=values)

    return create_defaults_list


def _merging(merge: Any) -> Any:
    known: dict[Hashable, bytes] = {}

    def compose(self: Any, defaults: list[ResultDefault], repo: IConfigRepository) -> DictConfig:
        places = _sources(repo)
        if not places:
            return merge(self, defaults, repo)
        key = places, *((item.config_path, item.package, item.is_self) for item in defaults)
        if key not in known:
            known[key] = pickle.dumps(merge(self, defaults, repo))
        return pickle.loads(known[key])

    return compose


def _sources(repo: IConfigRepository) -> tuple[str, ...]:
    """Where files are looked for; nothing where a test may have written there."""
    sources = repo.get_sources()
    constant = {source.scheme() for source in sources} <= CONSTANT
    return tuple(source.path for source in sources) if constant else ()


def _is_value(item: Override, repo: IConfigRepository) -> bool:
    """Whether a word sets a value, as Hydra itself tells it from the choice of a file."""
    return isinstance(item.value(), dict) or not repo.group_exists(item.key_or_group)
