"""NGSIM room: files in any published layout become one SI table of trajectories."""

from __future__ import annotations

from lcc_rl.data.ngsim_writer import write_ngsim

__all__ = ["write_ngsim"]
