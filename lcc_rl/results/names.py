"""Names of strategies, and counts, in tables, figures and pages."""

from __future__ import annotations

from collections.abc import Iterable

import pandas as pd

from lcc_rl.config.words import FILTERED
from lcc_rl.errors import require, unknown_name
from lcc_rl.functional.pattern import HUMAN

NETWORK = "alcc"
FILTER_ALONE = "constant_filtered"
MARKS = "†‡"  # after names in tables: loss of flow; a single training
RULE = "rule"  # the IDM, tuned on the same data by the gradient
RULE_ROWS = (RULE, "idm_acc_filtered", "idm_acc")
ON_FRONT = " X="  # between the name of a strategy and the longest time gap of its filter [s]
# Strategies with several variants, which further words of a name specify.
SEVERAL = {
    "reference": "network, own energy",
    "own_energy": "network, own energy × 2",
    NETWORK: "network",
    RULE: "IDM, tuned on these data",
    "cacc": "CACC",
    "ddpg": "DDPG",
    "hcfs": "HCFS",
}
LABELS = SEVERAL | {
    "idm": "one IDM driver",
    HUMAN: "simulated drivers",
    "recorded": "the recorded drivers",
    FILTER_ALONE: "safety filter alone",
    "idm_acc": "tuned IDM",
    "acc": "tuned ACC",
    "mpc": "MPC",
    "mpc_far": "MPC, longer gaps",
    "follower_stopper": "FollowerStopper",
    "pi_saturation": "PI with saturation",
    "fvdm": "FVDM",
    "gipps": "Gipps",
    "ovm": "OVM",
    "constant": "constant speed",
    "direct": "no automated car",
    "cacc path": "CACC, PATH gains",
    "cacc paper_like": "CACC, fitted to Table IV",
    "cacc tuned": "CACC, tuned",
    "hcfs between": "HCFS, best point between",
    "hcfs first": "HCFS, the first decides",
    "hcfs literal": "HCFS, literal",
    "hcfs oracle": "HCFS, oracle",
    "hcfs untuned": "HCFS of the fitted CACC",
    "deadbeat": "dead-beat, nothing learned",
    "deadbeat oracle": "dead-beat, oracle",
}
FORMER: dict[str, str] = {}  # renamed strategies by their words before


def in_words(name: str) -> str:
    """Return a strategy's name in tables, figures and pages.

    Other names, such as that of a user's file, are not changed.

    Examples:
        >>> in_words("alcc"), in_words("alcc ddpg"), in_words("my_idm_1.1")
        ('network', 'network (ddpg)', 'my_idm_1.1')
    """
    if name.endswith(FILTERED) and name not in LABELS:
        return f"{in_words(name.removesuffix(FILTERED))}, filtered"
    first, _, rest = name.partition(" ")
    if name not in LABELS and first in SEVERAL:
        text = rest if "=" in rest else rest.replace("_", " ")
        return f"{SEVERAL[first]} ({text})"
    return LABELS.get(name, name)


def strategy_named(given: str, known: Iterable[object]) -> str:
    """Return the strategy of a name, or of a name in tables.

    Raises:
        ConfigError: if there is none, naming the nearest.
    """
    names = list(map(str, known))
    rules = [x for x in RULE_ROWS if x in names]  # headings have "the rule" for the first
    stored = dict(zip([RULE], rules, strict=False))
    stored |= {label: name for label, name in FORMER.items() if name in names}
    stored |= {in_words(name): name for name in names} | {name: name for name in names}
    name = " ".join(given.split()).rstrip(f" {MARKS}")
    if name not in stored:
        raise unknown_name("strategy", given, names)
    return stored[name]


def rename(given: str, label: str, known: Iterable[object]) -> None:
    """Give a strategy another name in tables and figures of this process.

    Raises:
        ConfigError: if there is no such strategy, or the new name is that of another one.
    """
    names = list(map(str, known))
    require(label not in (*LABELS, *names, *map(in_words, names)), f"--rename: {label!r} is in use")
    name = strategy_named(given, names)
    FORMER[in_words(name)] = name
    LABELS[name] = label


def worded(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table with strategies in words, if it has any."""
    names = [name for name in ("strategy", "behind", "against") if name in table]
    return table.assign(**{name: [in_words(str(x)) for x in table[name]] for name in names})


def with_drivers(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table with the strategies in words, ``driver``, beside their names."""
    words = [in_words(str(name)) for name in table["strategy"]]
    return table.assign(driver=words)[[table.columns[0], "driver", *table.columns[1:]]]


def several(count: int, what: str) -> str:
    """Return a count in words."""
    return f"{count} {what}{'s' * (count != 1)}"


def size_of(windows: int, drivers: int, which: str = "held-out ") -> str:
    """Return the numbers of windows and drivers in words; ``which``: kind of the windows."""
    return f"{several(windows, f'{which}window')} × {several(drivers, 'driver')}"
