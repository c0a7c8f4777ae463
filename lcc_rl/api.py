"""Training and evaluation as functions, for notebooks and programs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from lcc_rl.commands import evaluation, training
from lcc_rl.commands.evaluation import Run
from lcc_rl.config import load
from lcc_rl.config.words import with_variant
from lcc_rl.errors import require
from lcc_rl.evaluation.foreign import as_given
from lcc_rl.evaluation.named import setting_of
from lcc_rl.runs.output import repeated_warnings_left_out
from lcc_rl.runs.states import fresh_folder


def learn(
    variant: str = "alcc", overrides: Sequence[str] = (), folder: str | Path | None = None
) -> Run:
    """Train a variant and evaluate it, as ``lcc-rl train`` does.

    Args:
        variant: ``"alcc"``, ``"reference"`` … (``conf/variant``).
        overrides: further settings, ``["experiment=limits", "seed=3"]``.
        folder: folder of the results; a training in it is resumed. By default a new one below
            ``outputs/train``.

    Returns:
        The run, with the rows of the held-out windows.

    Raises:
        LccError: for any error in settings, data or files, in one line.

    Examples:
        >>> run = learn("alcc", ["experiment=smoke"], "outputs/mine")  # doctest: +SKIP
        >>> run.table[["strategy", "total_path_energy_kj"]]  # doctest: +SKIP
    """
    target = Path(folder or fresh_folder("train", variant))
    cfg = load("train", with_variant(variant, overrides))
    return Run(target, training.run(cfg, target, quiet=True, resume=True), cfg)


def compare(
    strategies: Any,
    variant: str = "alcc",
    overrides: Sequence[str] = (),
    folder: str | Path | None = None,
) -> Run:
    """Evaluate policies, controllers and baselines on the same held-out windows.

    Args:
        strategies: one or several strategies, or a mapping of them by name: runs, run folders,
            policy files, ``"pretrained/alcc"``; controllers as names, objects, classes, plain
            functions of named entries (:class:`lcc_rl.pieces.Law`) or yaml files; policies of
            other libraries, see :mod:`lcc_rl.evaluation.foreign`, with the variant's observation.
            Append ``_filtered`` to a name to put the controller behind the safety filter.
        variant: variant of the scenario and the data.
        overrides: further settings, ``["evaluation.drivers=12"]``.
        folder: folder of the results and figures; by default a new one below
            ``outputs/evaluate``, without figures, which take seconds.

    Returns:
        The run, with the rows of all strategies. Further calls do not repeat a warning.

    Raises:
        LccError: for any error in settings, data or files, in one line.

    Examples:
        >>> found = compare([run, "pretrained/alcc_limits", "idm_acc"])  # doctest: +SKIP
        >>> found = compare({"slow": PID(gain=0.1), "fast": PID(gain=0.4)})  # doctest: +SKIP
    """
    target = Path(folder or fresh_folder("evaluate", variant))
    typed = with_variant(variant, overrides)
    cfg = load("evaluate", typed)
    if isinstance(strategies, (str, PathLike)) or not isinstance(strategies, Iterable):
        strategies = [strategies]
    named = isinstance(strategies, Mapping)
    pairs = strategies.items() if named else [(type(x).__name__, x) for x in strategies]
    valid = pairs and all(isinstance(name, str) for name, _ in pairs)
    require(valid, f"compare: expected strategies, or a mapping of them by name: {strategies!r}")
    resolved = [(name, x, as_given(x, name)) for name, x in pairs]
    policies = {name: policy for name, _, policy in resolved if policy is not None}
    several = len(policies) < sum(policy is not None for *_, policy in resolved)
    require(not several, "compare: two policies of one class; name them: {'a': …, 'b': …}")
    rules = [(name, x) for name, x, policy in resolved if policy is None]
    if named:
        spec: Any = {name: setting_of(x, f"compare.{name}") for name, x in rules}
    else:
        spec = [setting_of(x) for _, x in rules]
    cfg = cfg.with_(compare=spec)
    with repeated_warnings_left_out():
        rows = evaluation.run(cfg, target, own=False, quiet=True, policies=policies, typed=typed)
    if folder is not None:
        evaluation.draw(rows, cfg, target)
    return Run(target, rows, cfg)
