"""What start, length and warm-up of the windows change in savings at equal flow."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import pandas as pd
import pytest
from helpers import strategies_of

from lcc_rl.config import load
from lcc_rl.config.nodes import CALLED
from lcc_rl.data.profiles import Profiles, from_records, leader_profiles
from lcc_rl.envs.inputs import load_episodes
from lcc_rl.evaluation.episodes import evaluate
from lcc_rl.results.fronts import at_equal_flow
from lcc_rl.results.report import windows_for

FIRST = 40  # seconds of every record that never count
WHOLE = 0  # of a protocol: a window is a whole record
ENERGY, RECORDED = "total_path_energy_kj", "recorded"
SETTINGS = (
    "variant=alcc",
    "experiment=limits",
    "evaluation={profiles: null, sample_episodes: 0, behind_filter: []}",
    "evaluation.baselines=[recorded,idm_acc_filtered]",
)
Protocol = tuple[int, int]  # seconds that count in a window, and those before


@dataclass(frozen=True)
class Source:
    """Records and policies, and what their savings hold.

    Args:
        words: data, drivers, policy and the filter's longest time gaps.
        shortest: length of the shortest record [s].
        drivers: episodes of a window.
        protocols: how the seconds are cut into windows.
        unit: from ``FIRST`` on, as many multiples of it count as a record has [s].
        most: largest differences of savings, against recorded drivers and then the rule.
        least: smallest savings.
    """

    words: tuple[str, ...]
    shortest: int
    drivers: int
    protocols: tuple[Protocol, ...]
    unit: int
    most: tuple[float, ...]
    least: tuple[float, ...]


LIMITS = "policy=pretrained/alcc_limits"
I80 = "data=episodes", "drivers=i80_energy", "evaluation.front=[3.2]"
FROM_A_MINUTE: tuple[Protocol, ...] = ((60, 20), (60, 40), (WHOLE, 40))
SOURCES = {
    "stop_and_go": Source(
        (LIMITS, "data=stop_and_go", "drivers=i80_energy", "evaluation.front=[1.7]"),
        160,
        3,
        (*FROM_A_MINUTE, (120, 20)),
        120,
        (0.003, 0.002),
        (0.05, 0.0),
    ),
    "platoons": Source(
        (LIMITS, "data=platoons", "drivers=highway", "evaluation.front=[1.0]"),
        160,
        3,
        FROM_A_MINUTE,
        60,
        (0.003, 0.001),
        (0.0, -0.001),
    ),
    # Its records are too short for two windows each, and no front of the rule has as much flow as
    # the first network, or as little as the second one.
    "i80": Source((LIMITS, *I80), 100, 6, FROM_A_MINUTE[:2], 60, (0.008,), (0.05,)),
    "i80, paper": Source(
        ("policy=pretrained/alcc", *I80), 100, 6, FROM_A_MINUTE[:2], 60, (0.005,), (0.05,)
    ),
}


def held_out(source: Source, words: list[str]) -> Profiles:
    """The whole records that are held out if none is shorter than ``shortest``."""
    cfg = load("evaluate", [*words, f"scenario.horizon={10 * source.shortest}"])
    records = leader_profiles(load_episodes(cfg.data).episodes, cfg.scenario.time_step)
    return cfg.split.made(CALLED)(records.at_least(10 * source.shortest))[1]


def windows(
    records: Profiles, unit: int, counted: int, before: int
) -> Iterator[tuple[int, Profiles]]:
    """Yield lengths [steps] and windows in which the same seconds of every record count."""
    behind = [records.follower(number) for number in range(len(records))]
    parts: dict[int, list[tuple[int, int]]] = {}
    for number in range(len(records)):
        seconds = (len(records.record(number)) - 1 - 10 * FIRST) // (10 * unit) * unit
        length = counted or seconds
        begins = [FIRST - before + x for x in range(0, seconds, length)]
        parts.setdefault(10 * (length + before), []).extend((number, x) for x in begins)
    for steps, chosen in parts.items():
        slices = [(number, slice(10 * x, 10 * x + steps + 1)) for number, x in chosen]
        yield (
            steps,
            from_records(
                [records.record(number)[part] for number, part in slices],
                [f"{records.names[number]}+{x}s" for number, x in chosen],
                [records.recordings[number] for number, _ in chosen],
                records.time_step,
                [x[part] for number, part in slices if (x := behind[number]) is not None],
            ),
        )


def evaluated(
    source: Source, words: list[str], records: Profiles, protocol: Protocol
) -> pd.DataFrame:
    """Rows per strategy and window."""
    made, first = [], 0
    for steps, profiles in windows(records, source.unit, *protocol):
        cfg = load(
            "evaluate", [*words, f"scenario.horizon={steps}", f"evaluation.warm_up={protocol[1]}"]
        )
        strategies, inputs = strategies_of(cfg)
        inputs = replace(inputs, evaluation=profiles)
        rows = pd.concat(
            [evaluate(one, inputs, source.drivers, 8192, 2026)[0] for one in strategies]
        )
        made.append(rows.assign(profile_id=rows["profile_id"] + first))
        first += len(profiles)
    return windows_for(pd.concat(made, ignore_index=True))


def savings(rows: pd.DataFrame) -> tuple[float, ...]:
    """The network's savings at equal flow, against the recorded drivers and against the rule."""
    names = [str(name) for name in rows["strategy"].unique()]
    network, rule = ([x for x in names if x.startswith(kind)] for kind in ("alcc", "idm"))
    others = ([RECORDED], rule)
    return tuple(at_equal_flow(rows, network, x, ENERGY, RECORDED).value for x in others)


@pytest.mark.slow
@pytest.mark.parametrize("name", SOURCES)
def test_savings_of_the_same_seconds_hardly_depend_on_the_windows(
    name: str, request: pytest.FixtureRequest
) -> None:
    source = SOURCES[name]
    words = [*SETTINGS, *source.words]
    if "data=episodes" in words:
        words.append(f"data.path={request.getfixturevalue('shared_data') / 'i80_pairs.parquet'}")
    records = held_out(source, words)
    saved = [savings(evaluated(source, words, records, one)) for one in source.protocols]
    columns = zip(*saved, strict=True)
    for found, most, least in zip(columns, source.most, source.least, strict=False):
        assert max(found) - min(found) < most, saved
        assert min(found) > least, saved
