"""Free memory of this machine, a check before allocations, and a pause of garbage collection."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from lcc_rl.errors import ConfigError, raised_as

if TYPE_CHECKING:
    import torch

PROCESS, MEMINFO, GROUPS = Path("/proc/self/cgroup"), Path("/proc/meminfo"), Path("/sys/fs/cgroup")
# Files of a control group's limit and use, and the line of memory.stat on file pages.
VERSION_1 = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
VERSION_2 = ("memory.max", "memory.current", "inactive_file")
SIZE_UNITS = ("B", "KiB", "MiB", "GiB", "TiB", "PiB", "EiB")


@contextmanager
def uncollected() -> Iterator[None]:
    """Pause garbage collection, which takes a fifth of the time of imports and compilers."""
    paused = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if paused:
            gc.enable()


def require_memory(needs: Mapping[str, float], device: torch.device | str = "cpu") -> None:
    """Check that planned allocations fit into the free memory.

    Args:
        needs: memory by option, as given [bytes].
        device: device of the tensors.

    Raises:
        ConfigError: naming the option that needs most, its need and the free memory.
    """
    free, total = available(device), sum(needs.values())
    if free is None or total <= free:
        return
    worst = max(needs, key=lambda name: needs[name])
    rest = f" ({amount(total)} with the rest)" if needs[worst] <= free else ""
    owner = "this machine" if str(device).startswith("cpu") else f"device {device}"
    raise ConfigError(
        f"{worst} needs about {amount(needs[worst])} of memory{rest}; {owner} has {amount(free)} "
        "free"
    )


def torch_device(name: torch.device | str) -> torch.device:
    """Return a device by its name; raise a ConfigError if this machine does not have it."""
    import torch  # here, because reading a table needs no torch

    kinds = (RuntimeError, AssertionError, TypeError)  # depends on the build of torch
    with raised_as(ConfigError, f"device {str(name)!r} is not available", *kinds):
        device = torch.device(name)
        torch.empty(0, device=device)
    return device


def available(device: torch.device | str = "cpu") -> int | None:
    """Return the free memory of a device [bytes]; None if it is unknown.

    On the CPU it is the least of the system's available memory and the free memory of the process's
    control groups (Linux), or the physical memory (macOS).
    """
    if str(device).startswith("cuda"):
        import torch

        return int(torch.cuda.mem_get_info(torch_device(device))[0])
    return min([*_of_system(), *_of_groups()], default=None)


def amount(size: float) -> str:
    """Return a size in bytes with its unit, e.g. ``"1.9 TiB"``."""
    index = 0
    while size >= 1000 and index < len(SIZE_UNITS) - 1:
        size, index = size / 1024, index + 1
    return f"{size:.2g} {SIZE_UNITS[index]}" if size < 100 else f"{size:.0f} {SIZE_UNITS[index]}"


def _of_system() -> Iterator[int]:
    with suppress(OSError, ValueError, IndexError):
        _, _, after = MEMINFO.read_text("utf-8").partition("MemAvailable:")
        yield int(after.split()[0]) * 1024
        return
    with suppress(OSError, ValueError, AttributeError):  # not supported by the system
        yield os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _of_groups() -> Iterator[int]:
    """Yield the free memory of each control group of this process, version 1 and 2."""
    with suppress(OSError):
        for line in PROCESS.read_text("utf-8").splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers in ("", "memory"):
                group = GROUPS / controllers / path.strip("/")
                for folder in (group, *group.parents):
                    if folder.is_relative_to(GROUPS):
                        yield from _left(folder, *(VERSION_1 if controllers else VERSION_2))


def _left(folder: Path, limit: str, used: str, reclaimable: str) -> Iterator[int]:
    """Yield the free memory of a group, including reclaimable file pages."""
    # ValueError: "max", no limit.
    with suppress(OSError, ValueError):
        most, now = (int((folder / name).read_text("utf-8")) for name in (limit, used))
        rows = (line.split() for line in (folder / "memory.stat").read_text("utf-8").splitlines())
        yield max(0, most - now + int(dict(rows).get(reclaimable, 0)))
