"""Files of conf/ are composed once for each choice of them; settings are applied every time."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from functools import cache
from io import StringIO
from typing import Any

import pytest
from hydra._internal import config_loader_impl as hydra
from hydra._internal.defaults_list import Overrides
from omegaconf import OmegaConf


@contextmanager
def composed_once() -> Iterator[None]:
    """Keep what Hydra parses, lists and merges, but for files of ``--config-dir``."""
    listed, loader = hydra.create_defaults_list, hydra.ConfigLoaderImpl
    merged, known = loader._compose_config_from_defaults_list, {}
    read = OmegaConf.load
    parsed = cache(lambda text: read(StringIO(text)))

    def kept(key: str, repo: Any, make: Callable[[], Any]) -> Any:
        places = [source.full_path() for source in repo.get_sources()]
        if any(place.startswith("file:") for place in places):
            return make()
        key = f"{key} {places}"
        if key not in known:
            known[key] = pickle.dumps(make())
        return pickle.loads(known[key])

    def list_once(repo: Any, config_name: str, overrides_list: list[Any], **how: Any) -> Any:
        own = Overrides(repo, overrides_list).config_overrides
        key = f"{config_name} {how} {[x.input_line for x in overrides_list if x not in own]}"
        found = kept(key, repo, lambda: listed(repo, config_name, overrides_list, **how))
        return replace(found, config_overrides=own)

    def merge_once(self: Any, defaults: list[Any], repo: Any) -> Any:
        return kept(repr(defaults), repo, lambda: merged(self, defaults, repo))

    def read_once(file: Any) -> Any:
        return deepcopy(parsed(file.read())) if hasattr(file, "read") else read(file)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OmegaConf, "load", read_once)
        patch.setattr(hydra, "create_defaults_list", list_once)
        patch.setattr(loader, merged.__name__, merge_once)
        yield
