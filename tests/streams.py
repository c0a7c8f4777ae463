"""What each command's test begins with is made once: embedded streams and composed files."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from io import StringIO
from typing import Any

import pytest
from hydra._internal import config_loader_impl as hydra
from hydra._internal.defaults_list import Overrides
from omegaconf import OmegaConf

from lcc_rl.data.sources import LoadedEpisodes
from lcc_rl.synthetic.stream import StreamSource


@contextmanager
def driven_once() -> Iterator[None]:
    """Keep what streams of the shipped drivers hold, by their settings; ``generate`` stays."""
    load = StreamSource.load
    known: dict[str, bytes] = {}

    def load_once(self: StreamSource) -> LoadedEpisodes:
        return load(self) if self.drivers else kept(known, repr(self), lambda: load(self))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StreamSource, "load", load_once)
        yield


@contextmanager
def composed_once() -> Iterator[None]:
    """Keep what Hydra lists and merges for each choice of files, but for ``--config-dir``."""
    loader, listed, read = hydra.ConfigLoaderImpl, hydra.create_defaults_list, OmegaConf.load
    merged = loader._compose_config_from_defaults_list
    known: dict[str, bytes] = {}

    def for_files(repo: Any, key: str, make: Callable[[], Any]) -> Any:
        places = [source.full_path() for source in repo.get_sources()]
        own = any(place.startswith("file:") for place in places)
        return make() if own else kept(known, f"{key} {places}", make)

    def list_once(repo: Any, config_name: str, overrides_list: list[Any], **how: Any) -> Any:
        own = Overrides(repo, overrides_list).config_overrides  # settings
        key = f"{config_name} {how} {[x.input_line for x in overrides_list if x not in own]}"
        found = for_files(repo, key, lambda: listed(repo, config_name, overrides_list, **how))
        return replace(found, config_overrides=own)

    def merge_once(self: Any, defaults: list[Any], repo: Any) -> Any:
        return for_files(repo, repr(defaults), lambda: merged(self, defaults, repo))

    def read_once(file: Any) -> Any:
        text = file.read() if hasattr(file, "read") else ""
        return kept(known, text, lambda: read(StringIO(text))) if text else read(file)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OmegaConf, "load", read_once)
        patch.setattr(hydra, "create_defaults_list", list_once)
        patch.setattr(loader, merged.__name__, merge_once)
        yield


def kept(known: dict[str, bytes], key: str, make: Callable[[], Any]) -> Any:
    """Return a copy of what was made for a key."""
    if key not in known:
        known[key] = pickle.dumps(make())
    return pickle.loads(known[key])
