"""Runs of a sweep as one evaluation: a row per setting, and what is missing or has no effect."""

from __future__ import annotations

import hashlib
import os
import shlex
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lcc_rl.arrays import Floats
from lcc_rl.config.compose import NOT_IDENTITY
from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.io.files import as_rows
from lcc_rl.io.tensors import checksums
from lcc_rl.results.loading import SHARD, listed, load
from lcc_rl.results.names import ON_FRONT
from lcc_rl.results.report import baseline_of
from lcc_rl.results.runs import CONFIG, EPISODES, POLICY, differences, flat_settings, without
from lcc_rl.results.windows import SOURCE, STRATEGY, TRAINED
from lcc_rl.runs.plans import choices_of
from lcc_rl.runs.states import run_folders

# Settings in which the parts and the seeds of one study differ.
SHARED = (*NOT_IDENTITY, "seed", SHARD)
OF_ENERGY = ("energy.", "scenario.string.", "scenario.fleet.")  # models and vehicles
EPISODE = [STRATEGY, TRAINED, SOURCE, "profile_id", "driver_id", "repeat"]
EPISODE += ["case", "run_id", "follower"]
Choices = Mapping[str, Any]  # of a run, by dotted key


def load_sweep(root: str | Path) -> pd.DataFrame:
    """Read the rows of all runs below a folder as those of one evaluation.

    Strategies are named by the settings in which the runs differ (:func:`labels`); the seeds of a
    training share a name. A strategy that no run trained, with the same rows in all of them, occurs
    once. Settings that change the baseline name a ``source`` (:func:`conditions`).
    ``attrs["remarks"]`` has sentences on missing runs and settings without effect,
    ``attrs["first"]`` the folder of the first run.

    Raises:
        ConfigError: if the runs have different leaders, or a training occurs twice.
        ResultsError: as :func:`load`.
    """
    root = Path(root)
    loaded = load(root, settings=())
    rows = loaded.assign(run=loaded["run"].astype(str), strategy=loaded["strategy"].astype(str))
    every = rows["run"].unique()
    settings = _settings([root / x for x in every])
    runs = {name: without(x, SHARED) for name, x in zip(every, settings, strict=True)}
    if of := conditions(rows, runs, root):
        words = rows["run"].map(of)
        rows[SOURCE] = rows[SOURCE].astype(str) + ", " + words if SOURCE in rows else words
    for (strategy, *_), group in rows.groupby(["strategy", *[SOURCE] * bool(of)]):
        first, *rest = (one.drop(columns="run") for _, one in group.groupby("run"))
        equal = (first.reset_index(drop=True).equals(x.reset_index(drop=True)) for x in rest)
        if group["training_seed"].isna().any() and all(equal):
            rows = rows.drop(index=group.index.difference(first.index))
        else:
            names = list(dict.fromkeys(group["run"]))
            plain, mark, limit = str(strategy).partition(ON_FRONT)
            named = {
                name: f"{plain} {words}".strip() + mark + limit
                for name, words in zip(names, _told_apart(names, runs, root), strict=True)
            }
            rows.loc[group.index, "strategy"] = group["run"].map(named)
    rows = rows.drop_duplicates([name for name in rows if name != "run"])
    _check_one_study(root, rows, runs)
    table = rows.drop(columns="run").reset_index(drop=True)
    missing = dict(loaded.attrs.get("unfinished", {}))
    for name, why in loaded.attrs.get("damaged", {}).items():
        missing[name] = f"damaged: {why.removeprefix(f'{root / name}{os.sep}')}"
    remarks = [f"Without rows: {listed(missing)}."] * bool(missing) + without_effect(root)
    remarks += _of_vehicles(runs, root) if not of else []
    remarks += [f"{x[0].upper()}{x[1:]}." for x in loaded.attrs.get("versions", ())]
    table.attrs |= {"remarks": remarks, "first": str(root / next(iter(runs)))}
    return table


def conditions(rows: pd.DataFrame, runs: Mapping[str, Choices], root: Path) -> dict[str, str]:
    """Return the words of each run on what changes the baseline, ``event=cut_in``; else nothing.

    Baselines of several machines differ by rounding and count as one.
    """
    own = rows["strategy"] == baseline_of(rows["strategy"])
    compared = {*rows.loc[own, "run"]} & {*rows.loc[~own, "run"]}
    if rows.loc[own, "training_seed"].notna().any() or compared != {*runs}:
        return {}
    alike: list[tuple[Floats, list[str]]] = []
    for name, part in rows[own].astype({"run": str}).groupby("run"):
        numbers = part.select_dtypes("number").to_numpy(np.float64)
        for kept, names in alike:
            if kept.shape == numbers.shape and np.allclose(kept, numbers, 1e-3, 1e-3, True):
                names.append(str(name))
                break
        else:
            alike.append((numbers, [str(name)]))
    found = _told_apart([names[0] for _, names in alike], runs, root)
    named = zip(found, alike, strict=True)
    return {name: word for word, (_, names) in named if word for name in names}


def _told_apart(names: Collection[str], runs: Mapping[str, Choices], root: Path) -> list[str]:
    """Return the words by which runs of these names differ, see :func:`labels`."""
    found = labels([runs[name] for name in names], [root / name for name in names])
    return [", ".join(words.values()) for words in found]


def _of_vehicles(runs: Mapping[str, Choices], root: Path) -> list[str]:
    """Return a sentence if the vehicles of runs, or their energy models, differ."""
    first: dict[str, str] = {}
    for name, own in runs.items():
        first.setdefault(str({k: x for k, x in own.items() if f"{k}.".startswith(OF_ENERGY)}), name)
    if len(first) == 1:
        return []
    words = " and ".join(_told_apart(first.values(), runs, root))
    return [f"Energies are not comparable, because energy models or vehicles differ: {words}."]


def labels(stored: Sequence[Choices], folders: Sequence[Path]) -> list[dict[str, str]]:
    """Return for each run the words by which it differs, ``efficiency.weight=0.5``, by key.

    They are on what the commands varied and what only some of them set, and on stored settings if
    a run has no command, or as far as that does not tell different settings apart. Equal settings
    share their words, as equal values do: ``weight=1.0`` is ``weight=1``.
    """
    typed = [without(choices_of(folder), SHARED) for folder in folders]
    if not all(typed):
        return differences(stored)
    pairs = [*zip(stored, typed, strict=True)][::-1]  # the first ones replace others
    first = {str(own): words for own, words in pairs}
    text = {(k, str(own[k])): x for own, words in pairs for k, x in words.items() if k in own}
    keys = [*dict.fromkeys(key for words in first.values() for key in words)]
    kept = [key for key in keys if not all(key in words for words in first.values())]
    whole = []
    for own in stored:
        known = {k: own[k] for k in kept if k in own} | first[str(own)] | dict(own)
        whole.append({k: text.get((k, str(x)), x) for k, x in known.items()})
    return differences(whole, *kept, last=keys)


def _settings(folders: Sequence[Path]) -> list[dict[str, Any]]:
    """Return the settings of runs, with one path for files of equal content; else nothing."""
    first: dict[Any, str] = {}
    found = []
    for folder in folders:
        own: dict[str, Any] = {}
        with suppress(ResultsError):  # they cannot be read
            own = flat_settings(folder / CONFIG)
        hashes = {key: x for key, x in own.items() if key.startswith("inputs.")}
        paths = {
            (path := key.split(".", 2)[2]): first.setdefault(x, path) for key, x in hashes.items()
        }
        own = {key: paths.get(x, x) for key, x in own.items() if key not in hashes}
        found.append(own | {f"inputs.{first[x]}": x for x in hashes.values()})
    return found


def without_effect(root: Path) -> list[str]:
    """Return sentences on settings without effect: on networks of a seed, or on evaluations."""
    folders = run_folders(root)
    trained = [x for x in folders if (x / POLICY).is_file()]
    others = [x for x in folders if (x / EPISODES).is_file() and not (x / POLICY).is_file()]
    lines = _equal(trained, "networks of equal seeds", lambda x: checksums(x / POLICY))
    return [*lines, *_equal(others, "rows", _numbers)]


def _numbers(folder: Path) -> bytes:
    """Return a hash of the numbers of a run's rows; empty if they are many or damaged."""
    with suppress(ResultsError):
        rows = as_rows(folder / EPISODES)
        if isinstance(rows, pd.DataFrame):
            each = pd.util.hash_pandas_object(rows.select_dtypes("number"), index=False)
            return hashlib.sha256(each.to_numpy().tobytes()).digest()
    return b""


def _equal(folders: Sequence[Path], what: str, digest: Callable[[Path], Any]) -> Iterator[str]:
    """Yield a sentence for each set of settings by which runs of equal results differ."""
    stored = _settings(folders)
    named = labels([without(x, SHARED) for x in stored], folders)
    if not any(word != named[0] for word in named):  # seeds or shards, which may be many
        return
    equal = defaultdict(list)
    for folder, settings, word in zip(folders, stored, named, strict=True):
        # A damaged file equals no other one.
        equal[settings.get("seed"), digest(folder) or folder].append(word)
    cases: dict[str, set[str]] = {}
    for first, *rest in equal.values():
        if keys := [key for key in first if any(one.get(key) != first[key] for one in rest)]:
            names = " and ".join(", ".join(one.values()) for one in (first, *rest))
            cases.setdefault(", ".join(keys), set()).add(names)
    for which, found in sorted(cases.items()):
        one, *more = sorted(found)
        also = f" (and in {len(more)} more case{'s' * (len(more) > 1)})" * bool(more)
        yield f"{which} had no effect: the {what} are the same with {one}{also}."


def _check_one_study(root: Path, rows: pd.DataFrame, runs: Mapping[str, Choices]) -> None:
    if "leader_speed_mps" in rows:
        leaders = rows.groupby("profile_id")["leader_speed_mps"].nunique()
        if leaders.max() > 1:
            window = leaders.idxmax()
            own = rows[rows["profile_id"] == window].drop_duplicates("leader_speed_mps")["run"]
            words = " and ".join(filter(None, _told_apart([*own], runs, root)))
            raise ConfigError(
                f"{root}: its runs have different leaders ({words or f'profile_id {window}'}): "
                f"each has a table, lcc-rl table {shlex.quote(str(root / own.iloc[0]))}; "
                f"lcc_rl.results.load({str(root)!r}) reads all"
            )
    twice = rows[rows.duplicated([key for key in EPISODE if key in rows], keep=False)]
    for (strategy, seed), group in twice.groupby([STRATEGY, TRAINED], dropna=False, observed=True):
        where = " and ".join(group["run"].unique()[:2])
        raise ConfigError(f"{root}: it contains a training twice: {strategy}, seed {seed}: {where}")
