"""Memory that is free on this machine, and refusal of what needs more before it is allocated."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from lcc_rl.errors import ConfigError

if TYPE_CHECKING:
    import torch

PROCESS, MEMINFO, GROUPS = Path("/proc/self/cgroup"), Path("/proc/meminfo"), Path("/sys/fs/cgroup")
# Of a control group: files of its limit and its use, and the line of memory.stat on file pages.
VERSION_1 = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
VERSION_2 = ("memory.max", "memory.current", "inactive_file")
SIZE_UNITS = ("B", "KiB", "MiB", "GiB", "TiB", "PiB", "EiB")


def require_memory(needs: Mapping[str, float], device: torch.device | str = "cpu") -> None:
    """Check that what is about to be allocated fits into the memory that is free.

    Args:
        needs: bytes by the option, as it was given, that they are due to.
        device: where the tensors will live.

    Raises:
        ConfigError: naming the option that needs most, how much, and how much is free.
    """
    free, total = available(device), sum(needs.values())
    if free is None or total <= free:
        return
    worst = max(needs, key=lambda name: needs[name])
    more = f" ({amount(total)} with the rest)" if needs[worst] <= free else ""
    place = "this machine" if str(device).startswith("cpu") else f"device {device}"
    raise ConfigError(
        f"{worst} needs about {amount(needs[worst])} of memory{more}; {place} has {amount(free)} "
        "free"
    )


def torch_device(name: torch.device | str) -> torch.device:
    """Return a device by its name, or raise a ConfigError where this machine has none such."""
    import torch  # here: reading a table needs no torch

    try:
        device = torch.device(name)
        torch.empty(0, device=device)
    # Which error torch raises depends on how it was built.
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).strip().partition("\n")[0]
        raise ConfigError(f"device {str(name)!r} is not available: {reason}") from error
    return device


def available(device: torch.device | str = "cpu") -> int | None:
    """Return the bytes that can be allocated on a device; None if it is not known.

    On the CPU the least of what the system calls available and what the process's control groups
    leave (Linux); the physical memory where the system says no more (macOS).
    """
    if str(device).startswith("cuda"):
        import torch

        return int(torch.cuda.mem_get_info(torch_device(device))[0])
    return min([*_of_system(), *_of_groups()], default=None)


def amount(size: float) -> str:
    """Return a number of bytes with its unit, e.g. ``"1.9 TiB"``."""
    place = 0
    while size >= 1000 and place < len(SIZE_UNITS) - 1:
        size, place = size / 1024, place + 1
    return f"{size:.2g} {SIZE_UNITS[place]}" if size < 100 else f"{size:.0f} {SIZE_UNITS[place]}"


def _of_system() -> Iterator[int]:
    with suppress(OSError, ValueError, IndexError):
        _, _, after = MEMINFO.read_text("utf-8").partition("MemAvailable:")
        yield int(after.split()[0]) * 1024
        return
    with suppress(OSError, ValueError, AttributeError):  # no such name, or no such system
        yield os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _of_groups() -> Iterator[int]:
    """Yield what each control group above this process leaves, of version 1 and 2."""
    with suppress(OSError):
        for line in PROCESS.read_text("utf-8").splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers in ("", "memory"):
                place = GROUPS / controllers / path.strip("/")
                for folder in (place, *place.parents):
                    if folder.is_relative_to(GROUPS):
                        yield from _left(folder, *(VERSION_1 if controllers else VERSION_2))


def _left(folder: Path, limit: str, used: str, reclaimable: str) -> Iterator[int]:
    """Yield what one group leaves; files that it holds in memory are given up first."""
    # ValueError: "max", no limit.
    with suppress(OSError, ValueError):
        most, now = (int((folder / name).read_text("utf-8")) for name in (limit, used))
        rows = (line.split() for line in (folder / "memory.stat").read_text("utf-8").splitlines())
        yield max(0, most - now + int(dict(rows).get(reclaimable, 0)))
