"""Write docs/entries.md: the entries of the environments and the equations of the papers."""

from __future__ import annotations

import argparse
import sys
import tomllib
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from torchrl.envs import TransformedEnv

from lcc_rl.config import load
from lcc_rl.config.schemas import StudyConfig
from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs import MultiAgent, SingleAgent, build_env
from lcc_rl.envs.clock import Clock, option_specs
from lcc_rl.envs.inputs import constant_profiles
from lcc_rl.envs.single import group_key, view_of
from lcc_rl.envs.step import pieces_of, written
from lcc_rl.errors import ConfigError
from lcc_rl.functional.pattern import AUTOMATED, VehicleString
from lcc_rl.pieces import Handover, Piece
from lcc_rl.pieces.base import ROLE, TERM, Key, as_key, declared

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "entries.md"
SPECS = ("observation", "action", "reward", "done")
WIDEST = 3  # widths of wider entries depend on settings
CLOCK = declared(Clock)
ENTRIES = declared(Piece, Clock, SingleAgent, MultiAgent)
SIZES = "scenario.string=automated*3 human*5"
HEAD = """# Entries and equations

<!-- Written by `python tools/entries.py`; do not edit. -->

## Entries

Keys of the environments' TensorDicts, at the root after a reset and under `"next"` after a step.
`role` stands for a role of the string, such as `"human"`; `name` for a term of the reward.
Shapes: `*B` batch of episodes, `N` vehicles of the string from front to back, `A` automated
vehicles, `n` vehicles of the role, `k` a width that depends on settings; float32 unless noted
otherwise. The classes are in `lcc_rl.pieces` and `lcc_rl.envs`. A *reset option* may be given to
`env.reset(options={key: value})`, with a value for each episode. `env.reset(td, set_state=True)`
continues from the state in `td`; without `set_state` the state is ignored.
"""
PAPERS = """A1–A20: Wang et al., *Adaptive Leading Cruise Control in Mixed Traffic Considering
Human Behavioral Diversity* (ALCC). H1–H21: Yan et al., *Hybrid Car-Following Strategy Based on
Deep Deterministic Policy Gradient and Cooperative Adaptive Cruise Control* (HCFS). Vehicles count
from the front, 0 is the leader. T is the time step, in A4 and A15 the desired time gap. Import
paths start with `lcc_rl.`. – means no unit, or no deviation."""


class Equation(NamedTuple):
    """One equation or several related ones.

    number: as ``A3`` or ``H4–H6``; formula: in plain text; symbols: with units; functions: import
    paths below ``lcc_rl``; deviation: difference of the code from the printed form.
    """

    number: str
    formula: str
    symbols: str
    functions: list[str]
    deviation: str = "–"


TABLE = tomllib.loads(Path(__file__).with_name("equations.toml").read_text(encoding="utf-8"))
EQUATIONS = [Equation(**row) for row in TABLE["equation"]]


def configurations() -> Iterator[StudyConfig]:
    """Yield configurations that together write every entry, with different sizes."""
    for path in sorted((ROOT / "conf" / "variant").glob("*.yaml")):
        string = "scenario.string=human*5" if path.stem == "direct" else SIZES
        cfg = load("train", [f"variant={path.stem}", string])
        yield cfg
        if cfg.deployed is not None:
            yield cfg.after_training()
    knowledge = ["+knowledge=[spread,preview,traffic]", "scenario.pieces.traffic.delay=1.0"]
    knowledge += ["scenario.pieces.memory.kind=stacked"]
    cfg = load("train", ["variant=alcc", SIZES, "+filter=cbf", "+faults=all", *knowledge])
    yield cfg
    held = "scenario.controllers.automated.hold=0.5"
    hills = ["energy=electric", "+slope=hills", "+knowledge=terrain"]
    yield load("train", ["variant=alcc", SIZES, "+event=cut_in", held, *hills])
    for drawn_or_single in ({"size": 6, "penetration": 0.34}, "automated human*4"):
        yield cfg.with_(scenario={"string": drawn_or_single})
    human = "scenario.controllers.human"
    late = [f"controller@{human}=ovm", f"{human}.delay=4"]
    late += [f"{human}.{noise}_noise=0.3" for noise in ("acceleration", "gap")]
    yield load("train", ["variant=alcc", SIZES, *late])
    handover = "controller@scenario.controllers.automated=handover"
    yield load("train", ["variant=reference", "scenario=ring", handover, SIZES])
    saturation = "controller@scenario.controllers.automated=pi_saturation"
    yield load("train", ["variant=reference", "energy=mixture", saturation, SIZES])
    yield load("train", ["variant=reference", saturation.replace("pi_saturation", "calm"), SIZES])
    yield load("train", ["variant=idm", handover.replace("handover", "mpc"), SIZES])


def environments() -> Iterator[tuple[TransformedEnv, VehicleString]]:
    """Yield an environment of every configuration, and its string."""
    population = bootstrap()
    for cfg in configurations():
        string = cfg.scenario.vehicles
        scenario = cfg.scenario
        profiles = constant_profiles(10.0, scenario.horizon, scenario.time_step, ["constant"])
        env = build_env(cfg, profiles, population, batch_size=7)
        if count := string.count(AUTOMATED):
            env = env.append_transform(view_of(count))
        yield env, string


def entry_key(key: Key, roles: Collection[str]) -> Key:
    """Return the declared key of an entry.

    Raises:
        ConfigError: if no class declares it.
    """
    by_role = tuple(ROLE if part in roles else part for part in key)
    for known in (key, by_role, (*key[:-1], TERM)):
        if known in ENTRIES:
            return known
    raise ConfigError(f"no class declares unit and meaning of {'.'.join(key)}")


def symbols(key: Key, shape: Iterable[int], string: VehicleString) -> str:
    """Return a shape in symbols, such as ``[*B, N, 1]``."""
    _, *sizes = shape
    counts = {string.count(AUTOMATED): "A", len(string): "N"}
    listed = entry_key(key, string.names)
    if ROLE in listed:
        counts = {string.count(key[listed.index(ROLE)]): "n"}
    names = ["k" if size > WIDEST else str(size) for size in sizes]
    # The last number is the width of an entry; an index has none.
    for place in range(len(sizes) - (key[-1] != "index")):
        names[place] = counts.get(sizes[place], names[place])
    return f"[{', '.join(['*B', *names])}]"


def writers(env: TransformedEnv, key: Key) -> list[str]:
    """Return the names of the classes that write an entry."""
    if key[-1] == "action":
        return ["the policy"]
    if group_key(key) != key:
        return [SingleAgent.__name__]
    if key in MultiAgent.keys:
        return [MultiAgent.__name__]
    pieces = []
    for piece in pieces_of(env):
        pieces += [piece.before, piece.after] if isinstance(piece, Handover) else []
        pieces.append(piece)
    return ["Clock"] * (key in CLOCK) + [type(x).__name__ for x in pieces if key in written([x])]


def collect(found_in: Iterable[tuple[TransformedEnv, VehicleString]]) -> dict[Key, list[str]]:
    """Return shape, mark and then the writers of every entry, in the order of the dictionary.

    The mark names the options of ``env.reset``.

    Raises:
        ConfigError: if an entry is not in the dictionary, or has two shapes.
    """
    rows: dict[Key, list[str]] = {}
    for env, string in found_in:
        parts = [getattr(env, f"full_{x}_spec") for x in SPECS]
        options = option_specs(env)
        specs = {as_key(key): spec for part in parts for key, spec in part.items(True, True)}
        for key, spec in specs.items():
            if ("observation",) in specs and group_key(key) == key:
                continue  # only the root of the single-agent view
            kind = "" if spec.dtype == torch.float32 else f" {str(spec.dtype).split('.')[1]}"
            shape = symbols(key, spec.shape, string) + kind
            row = rows.setdefault(entry_key(key, string.names), [shape, ""])
            row[1] = "; reset option" if key in options else row[1]
            if row[0] != shape:
                raise ConfigError(f"{'.'.join(key)} has two shapes, {row[0]} and {shape}")
            row += [name for name in writers(env, key) if name not in row]
    return {key: rows[key] for key in sorted(rows)}


def table(*rows: Iterable[str]) -> str:
    """Return a Markdown table, the first row its head."""
    lines = ["| " + " | ".join(x.replace("|", r"\|") for x in row) + " |" for row in rows]
    return "\n".join([lines[0], "|---" * lines[0].count(" | ") + "|---|", *lines[1:]]) + "\n"


def page(rows: dict[Key, list[str]]) -> str:
    """Return the page."""
    entries = [("key", "shape", "unit", "meaning", "written by")]
    for key, (shape, mark, *names) in rows.items():
        shown = ", ".join(part if part in (ROLE, TERM) else f'"{part}"' for part in key)
        entry = ENTRIES[key]
        known = (
            f"`{shown}`",
            f"`{shape}`".replace(", ", ",\N{NO-BREAK SPACE}"),
            entry.unit,
            entry.meaning + mark,
        )
        entries.append((*known, ", ".join(names)))
    equations = [("equation", "formula", "symbols and units", "implemented by", "deviation")]
    for number, formula, symbols, functions, deviation in EQUATIONS:
        paths = ", ".join(f"`{path}`" for path in functions)
        equations.append((number, f"`{formula}`", symbols.replace("*", r"\*"), paths, deviation))
    return "\n".join([HEAD, table(*entries), "## Equations\n", PAPERS + "\n", table(*equations)])


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing; exit 1 if stale")
    check = parser.parse_args(arguments).check
    text = page(collect(environments()))
    if not check:
        PAGE.write_text(text, encoding="utf-8")
    elif not PAGE.is_file() or PAGE.read_text(encoding="utf-8") != text:
        print("docs/entries.md differs from the code: python tools/entries.py", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
