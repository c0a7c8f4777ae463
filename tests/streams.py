"""The embedded stream is driven once for each size of it: every command's test begins with one."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from lcc_rl.data.sources import LoadedEpisodes
from lcc_rl.synthetic.stream import StreamSource


@contextmanager
def driven_once() -> Iterator[None]:
    """Keep what streams of the shipped drivers hold, by their settings; ``generate`` stays."""
    load = StreamSource.load
    known: dict[str, bytes] = {}

    def load_once(self: StreamSource) -> LoadedEpisodes:
        if self.drivers:
            return load(self)
        key = repr(self)
        if key not in known:
            known[key] = pickle.dumps(load(self))
        return pickle.loads(known[key])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StreamSource, "load", load_once)
        yield
