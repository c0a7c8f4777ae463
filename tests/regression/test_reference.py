"""Rollouts, policies, evaluations and trainings equal those recorded at commit 7a6769e.

There, two separate environments computed them; ``tests/regression/record_reference.py`` of commit
91b908f recorded them, and reference/commands.json holds the overrides that give them today.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from helpers import slow_but
from tensordict import TensorDict

from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.factory import build_agent
from lcc_rl.commands import evaluation, training
from lcc_rl.config import load
from lcc_rl.data.profiles import Profiles, from_records
from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs import build_env
from lcc_rl.functional.safety import NEVER
from lcc_rl.results.policies import load_policy

REFERENCE = Path(__file__).parent / "reference"
COMMANDS = json.loads((REFERENCE / "commands.json").read_text())
CASES = COMMANDS["rollouts"]
PLATOON_POLICY = REFERENCE / "ddpg.pt"  # that shipped then
STEPS = 40
# Where a division and a product by the largest acceleration have gone, or a network acts, whose
# products are rounded by the processor and by where its weights lie in memory; 40 steps of a
# closed loop enlarge that (two processors differ by up to 2e-5).
ROUNDED = 1e-4
# Relative differences of the first iterations of a training, of three: updates enlarge a rounding
# until it decides whether an episode ends in a collision.
LEARNED = (1e-4, 2e-3)
# Where the arithmetic is the same, so is every bit of the motion.
EXACT = (
    "alcc_collision",
    "barrier",
    "cacc",
    "cacc_paper_like",
    "deadbeat",
    "deadbeat_oracle",
    "direct",
    "idm",
    "idm_sampled",
)
OTHER_GAINS = "cacc paper_like"  # were others then
MOTION = ("speed", "gap", "relative_speed", "acceleration", "jerk", "power")
RADIO = ("gap_error", "speed_error", "leader_gap_error", "leader_speed_error", "received_gap")
ESTIMATED = ("predicted_acceleration", "predicted_power", "estimate", "covariance")


def arrays(name: str) -> dict[str, np.ndarray]:
    """Read a file of arrays; what is left open would be closed, with a warning, in another test."""
    with np.load(REFERENCE / name) as file:
        return dict(file)


def recorded_profiles() -> Profiles:
    """The leaders of the recording, as they were: a sine may be rounded otherwise elsewhere."""
    speeds = arrays("rollouts/inputs.npz")["profile_speeds"]
    records = [torch.from_numpy(speed) for speed in speeds]
    names = [f"rec{i % 2}/{i}@0.0s" for i in range(len(records))]
    return from_records(records, names, [f"rec{i % 2}" for i in range(len(records))], 0.1)


def policy_of(cfg, driver):
    """The policy that drove: a shipped one, one with the weights of seed 0, or a constant."""
    if not cfg.learns:
        return lambda td: td
    if isinstance(driver, float):
        return lambda td: td.set(("automated", "action"), torch.full((3, 1, 1), driver))
    agent = build_agent(cfg, bootstrap())
    if driver != "seed 0":
        agent.policy.load_state_dict(shipped_then(driver)[0])
    return shared_policy(agent.policy)


def shipped_then(name: str):
    """Weights and configuration of a policy that shipped when the reference was recorded."""
    return load_policy(PLATOON_POLICY if name == "ddpg" else f"pretrained/{name}")


def roll(name: str) -> dict[str, torch.Tensor]:
    """Play a case; every entry by its name, ``[batch, time, …]``."""
    cfg = load("train", CASES[name]["overrides"])
    policy = policy_of(cfg, CASES[name]["driver"])
    env = build_env(cfg.after_training(), recorded_profiles(), bootstrap(), 3, 0)
    moments, steps = [], []
    with torch.no_grad():
        td = env.reset()
        kept = list(td.keys(True, True))
        for _ in range(STEPS):
            moments.append(td.select(*kept).clone())
            td = env.step(policy(td))
            steps.append(td.clone())
            td = env.step_mdp(td)
        moments.append(td.select(*kept))
    return {"moments": torch.stack(moments, 1), "steps": torch.stack(steps, 1)}


def compare(found: torch.Tensor, reference: np.ndarray, what: str) -> None:
    """Compare an entry with the recording, bit for bit or up to rounding."""
    found = found.reshape(reference.shape).numpy()
    if reference.dtype.kind != "f":
        np.testing.assert_array_equal(found, reference, err_msg=what)
    else:
        # Accelerations and jerks divide a rounding of the speed by the step, once or twice.
        steps = {"acceleration": 10.0, "jerk": 100.0, **dict.fromkeys(ESTIMATED, 100.0)}.get(
            what, 1.0
        )
        scale = steps * max(float(np.abs(reference).max()), 1.0)
        np.testing.assert_allclose(
            found, reference, rtol=ROUNDED, atol=ROUNDED * scale, err_msg=what
        )


# Every second one is quick; make test-all plays all.
@pytest.mark.parametrize("name", slow_but(sorted(CASES)[::2], sorted(CASES)))
def test_rollouts(name) -> None:
    data = arrays(f"rollouts/{name}.npz")
    played = roll(name)
    moments, steps = played["moments"], played["steps"]
    for entry in ("seed", "profile", "start"):
        space = "episode" if entry == "seed" else "leader"
        compare(moments[space, entry][:, 0], data[entry], entry)
    compare(moments["leader", "speed"], data["leader_speed"], "leader")
    for entry in (*MOTION, *RADIO):
        if entry in data:
            compare(moments["vehicles", entry], data[entry], entry)
            if name in EXACT:
                found = moments["vehicles", entry].reshape(data[entry].shape).numpy()
                np.testing.assert_array_equal(found, data[entry], err_msg=entry)
    for entry in ESTIMATED:
        if entry in data and ("human", entry) in moments.keys(True):
            compare(moments["human", entry], data[entry], entry)
    for entry in ("ttc", "time_gap"):
        if entry in data:
            compare(moments["vehicles", entry][:, :, 0], data[entry], entry)
    for place, entry in enumerate(("winner", "switches", "clamps", "cap_interventions")):
        if f"hybrid_{entry}" in data:
            compare(steps["next", "hybrid", entry], data[f"hybrid_{entry}"], f"{place} {entry}")
    for entry in (key for key in data if key.startswith("reward_")):
        key = ("next", "automated", "reward_terms", entry[len("reward_") :])
        if key in steps.keys(True):
            compare(steps[key], data[entry], entry)
    if name != "direct":
        compare(steps["next", "automated", "reward"], data["reward"], "reward")
        compare(moments["automated", "observation"], data["observation"], "observation")
    for entry in ("done", "terminated", "truncated"):
        compare(moments[entry], data[entry], entry)


@pytest.mark.parametrize("name", ["alcc", "reference", "ddpg"])
def test_shipped_policies_act_as_before(name) -> None:
    data = arrays("policies.npz")
    weights, cfg = shipped_then(name)
    agent = build_agent(cfg, bootstrap())
    agent.policy.load_state_dict(weights)
    seen = TensorDict({"observation": torch.from_numpy(data[f"{name}.observation"])}, [64])
    with torch.no_grad():
        action = agent.policy(seen)["action"]
    compare(action, data[f"{name}.action"], name)


def compare_tables(found: pd.DataFrame, reference: pd.DataFrame, tolerance: float) -> None:
    """Compare the columns that a reference table has, row by row."""
    assert len(found) == len(reference)
    for column in reference:
        old, new = reference[column], found[column]
        if column.endswith("ttc") or column == "min_ttc_s":
            # Recorded when a gap that never closes was still the number 1000.
            old = old.mask(old >= NEVER)
        if old.dtype.kind in "fiu" and column != "training_seed":
            # A ratio of two small sums of squares shows every rounding.
            tolerance = 1e-3 if column == "energy_ratio" else tolerance
            scale = max(float(old.abs().max()), 1.0)
            np.testing.assert_allclose(
                new.to_numpy(float),
                old.to_numpy(float),
                rtol=tolerance,
                atol=tolerance * scale,
                err_msg=column,
            )
        else:
            assert new.astype(str).tolist() == old.astype(str).tolist(), column


@pytest.mark.parametrize("name", slow_but(["alcc"], sorted(COMMANDS["evaluation"])))
def test_evaluations(name, tmp_path) -> None:
    words = COMMANDS["evaluation"][name]
    cfg = load("evaluate", [word.replace("<ddpg.pt>", f"'{PLATOON_POLICY}'") for word in words])
    evaluation.run(cfg, tmp_path, quiet=True)
    for table in ("episodes", "steps"):
        path = REFERENCE / "evaluation" / f"{name}_{table}.parquet"
        if path.exists():
            found, reference = pd.read_parquet(tmp_path / f"{table}.parquet"), pd.read_parquet(path)
            reference = reference[reference["strategy"] != OTHER_GAINS].reset_index(drop=True)
            known = found[found["strategy"].isin(reference["strategy"])].reset_index(drop=True)
            compare_tables(known, reference, 1e-4 if table == "steps" else 1e-5)


@pytest.mark.parametrize(
    "name", slow_but(["alcc_ddpg", "alcc_analytic", "ddpg"], sorted(COMMANDS["training"]))
)
def test_trainings(name, tmp_path) -> None:
    cfg = load("train", COMMANDS["training"][name])
    training.run(cfg, tmp_path, quiet=True)
    rows = pd.read_parquet(tmp_path / "training.parquet")
    reference = pd.read_parquet(REFERENCE / "training" / f"{name}.parquet")
    assert len(rows) == len(reference)
    for row, tolerance in enumerate(LEARNED):
        compare_tables(rows[row : row + 1], reference[row : row + 1], tolerance)
