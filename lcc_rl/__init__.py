"""Learn and compare car-following controllers in mixed traffic.

``lcc_rl.make_env`` builds a TorchRL environment of a string of vehicles, ``lcc_rl.results`` reads
what runs leave behind. The commands are ``python -m lcc_rl.train``, ``evaluate``, ``calibrate``,
``pipeline`` and ``status``.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from lcc_rl.runs import interrupts
from lcc_rl.version import __version__

__all__ = ["__version__", "make_env", "results"]

if interrupts.is_command():
    interrupts.end_quietly()


def __getattr__(name: str) -> Any:
    # Lazy: asking for the version must not load torch.
    if name == "make_env":
        return import_module("lcc_rl.envs.factory").make_env
    if name == "results":
        return import_module("lcc_rl.results")
    raise AttributeError(f"module 'lcc_rl' has no attribute {name!r}")
