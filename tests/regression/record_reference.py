"""How the files in reference/ were made: what the code of commit 7a6769e computed.

That code named its entries otherwise, so this script runs in a checkout of it only:

  cd <old checkout>
  PYTHONPATH=.:tests OMP_NUM_THREADS=1 python <here>/record_reference.py [part …]

Everything is stored under neutral names, vehicles front to back (the controlled car, then the
humans behind it; or all followers of a platoon), floats as computed. Parts: rollouts, policies,
evaluation, training, headline (which needs the real data; LCC_RL_DATA names their folder).
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import torch
from helpers import POPULATION, VARIANTS, wavy_profiles
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp

from lcc_rl.agents.actor import ConstantPolicy
from lcc_rl.cli import evaluate, train
from lcc_rl.config import load
from lcc_rl.config.schemas import TrainConfig
from lcc_rl.envs.factory import build_agent, build_env, build_policy
from lcc_rl.results.files import read_parquet
from lcc_rl.results.policies import load_policy

REFERENCE = Path(__file__).resolve().parent / "reference"
SHARED = "<shared>"  # stands for the folder of the real data in what is written
BATCH, STEPS, SEED = 3, 40, 0
HORIZON = f"scenario.horizon={STEPS}"
STACKED = "scenario.pieces.memory.kind=stacked"
REMEMBERED = "scenario.pieces.memory.sources=[leader.speed,cav.gap]"
NOISY = ("scenario.pieces.preview.noise=0.5", "scenario.pieces.preview.delay=0.2")
TIGHT = ("controller.jerk_bound=10", "gains=path")

# Case: variant, further overrides, and who drives: "rule" (what the variant's agent is), a shipped
# policy by name, "seed 0" (the untrained network of seed 0), or a constant action.
Driver = str | float
ROLLOUTS: dict[str, tuple[str, tuple[str, ...], Driver]] = {
    "alcc": ("alcc", (), "alcc"),
    "reference": ("reference", (), "reference"),
    "own_energy": ("own_energy", (), "reference"),
    "barrier": ("barrier", (), "rule"),
    "idm": ("idm", (), "rule"),
    "direct": ("direct", (), "rule"),
    "cacc": ("cacc", (), "rule"),
    "ddpg": ("ddpg", (), "ddpg"),
    "deadbeat": ("deadbeat", (), "rule"),
    "hcfs": ("hcfs", (), "ddpg"),
    "alcc_five_seed0": ("alcc", ("scenario.followers=5",), "seed 0"),
    "alcc_five": ("alcc", ("scenario.followers=5",), "alcc"),
    "alcc_filter": ("alcc", ("+filter=barrier",), "alcc"),
    "alcc_memory": ("alcc", ("+knowledge=memory",), "seed 0"),
    "alcc_memory_stacked": ("alcc", ("+knowledge=memory", STACKED, REMEMBERED), "seed 0"),
    "alcc_preview": ("alcc", ("+knowledge=preview",), "seed 0"),
    "alcc_preview_noisy": ("alcc", ("+knowledge=preview", *NOISY), "seed 0"),
    "alcc_collision": ("alcc", (), 1.0),
    "idm_sampled": ("idm", ("agent.sampled=true",), "rule"),
    "hcfs_oracle": ("hcfs", ("controller.lookahead=oracle",), "ddpg"),
    # The shipped policy nearly always wins; an untrained one makes the hybrid switch and clamp.
    "hcfs_switching": ("hcfs", TIGHT, "seed 0"),
    "hcfs_switching_oracle": ("hcfs", (*TIGHT, "controller.lookahead=oracle"), "seed 0"),
    "deadbeat_oracle": ("deadbeat", ("agent.lookahead=oracle",), "rule"),
    "cacc_path": ("cacc", ("gains=path",), "rule"),
    "cacc_paper_like": ("cacc", ("gains=paper_like",), "rule"),
}
SMALL = ("data.platoons=8", "data.recordings=2", "evaluation.profiles=2", "evaluation.drivers=3")
LEARNED = ("policy=pretrained", "compare=[pretrained/reference]")
EVALUATIONS = {
    "alcc": ("variant=alcc", *LEARNED, *SMALL, "evaluation.sample_episodes=1"),
    "alcc_five": ("variant=alcc", *LEARNED, *SMALL, "scenario.followers=5"),
    "alcc_filter": ("variant=alcc", *LEARNED, *SMALL, "+filter=barrier"),
    "hcfs": (
        "variant=hcfs",
        "policy=pretrained",
        "evaluation.profiles=4",
        "evaluation.full_length=false",
    ),
}
SMOKE = ("experiment=smoke", "seed=0", "threads=1", "data.platoons=4", "data.recordings=2")
SOON = "agent.batch_size=64"  # learning begins in the first of the three iterations
TRAININGS = {
    "alcc_ddpg": ("variant=alcc", "agent=ddpg", *SMOKE, SOON),
    "alcc_td3": ("variant=alcc", "agent=td3", *SMOKE, SOON),
    "alcc_sac": ("variant=alcc", "agent=sac", *SMOKE, SOON),
    "alcc_analytic": ("variant=alcc", "agent=analytic", *SMOKE),
    "reference_ddpg": ("variant=reference", "agent=ddpg", *SMOKE, SOON),
    "own_energy": ("variant=own_energy", *SMOKE, SOON),
    "ddpg": ("variant=ddpg", *SMOKE, SOON),
    "hcfs": ("variant=hcfs", *SMOKE, SOON),
}
RULES = ("barrier", "idm", "direct", "cacc", "deadbeat")  # train only evaluates them
I80 = ("data=ngsim", f"data.path={SHARED}/i80_pairs_ngsim_layout.csv.gz")
HEADLINES = {
    "alcc": ("variant=alcc", *LEARNED, *I80),
    "hcfs": ("variant=hcfs", "policy=pretrained", "evaluation.full_length=false"),
}

# -- rollouts --------------------------------------------------------------------------------------

CONSTANTS = {
    ("episode", "seed"): "seed",
    ("leader", "profile"): "profile",
    ("leader", "start"): "start",
    ("cav", "gap_factor"): "gap_factor",
    ("hdv", "driver"): "driver",
    ("hdv", "desired_speed"): "desired_speed",
    ("hdv", "desired_time_gap"): "desired_time_gap",
}
LEADER = {
    ("leader", "speed"): "leader_speed",
    ("leader", "acceleration"): "leader_acceleration",
    ("leader", "next_speed"): "leader_next_speed",
}
# Of every vehicle that has them, front to back.
STRING = ("speed", "gap", "relative_speed", "acceleration", "jerk", "power")
OTHERS = {
    ("cav", "ttc"): "ttc",
    ("cav", "time_gap"): "time_gap",
    ("barrier", "action"): "filtered_action",
    ("memory", "entries"): "memory",
    ("memory", "history"): "memory_history",
    ("preview", "speed"): "preview",
    **{("hdv", key): key for key in ("predicted_acceleration", "predicted_power")},
    **{("hdv", key): key for key in ("estimate", "covariance")},
    **{
        ("platoon", key): key
        for key in (
            "gap_error",
            "speed_error",
            "leader_gap_error",
            "leader_speed_error",
            "received_gap",
        )
    },
    **{(key,): key for key in ("observation", "done", "terminated", "truncated")},
}
HYBRID = ("winner", "switches", "clamps", "cap_interventions")
WIDE = ("observation", "action", "memory", "memory_history", "preview")


def leaves(td: TensorDictBase) -> set[tuple[str, ...]]:
    found = td.keys(True, True)
    return {(key,) if isinstance(key, str) else tuple(key) for key in found}


def seen(td: TensorDictBase) -> dict[str, Tensor]:
    """Everything that a moment holds, under neutral names; nothing may be left over."""
    values = {name: td[key] for key, name in {**LEADER, **OTHERS}.items() if key in leaves(td)}
    known = {*CONSTANTS, *LEADER, *OTHERS, ("episode", "step")}
    for entry in STRING:
        keys = [(space, entry) for space in ("cav", "hdv", "platoon")]
        parts = [td[key] for key in keys if key in leaves(td)]
        known |= set(keys)
        if parts:
            event = max(part.ndim for part in parts)
            values[entry] = torch.cat(
                [part if part.ndim == event else part.unsqueeze(-2) for part in parts], -2
            )
            if event == 2:
                values[entry] = values[entry].unsqueeze(-2)
    spare = {key for key in leaves(td) if key not in known}
    spare = {key for key in spare if key[0] not in ("action", "hybrid", "reward", "reward_terms")}
    assert not spare, spare
    return values


def chosen(td: TensorDictBase) -> dict[str, Tensor]:
    """What the policy decided at a moment, and what it was worth one step later."""
    values = {"action": td["action"], "reward": td["next", "reward"]}
    for name, term in td["next", "reward_terms"].items():
        values[f"reward_{name}"] = term
    if "hybrid" in td.keys():  # noqa: SIM118
        values |= {f"hybrid_{name}": td["hybrid", name] for name in HYBRID}
    return values


def drive(cfg: TrainConfig, policy: Any) -> dict[str, np.ndarray]:
    """Play one episode in every slot, without resets: [batch, time (+ 1), …]."""
    env = build_env(cfg, wavy_profiles(), POPULATION, BATCH, SEED)
    with torch.no_grad():
        td = env.reset()
        begun = {key: td[key].clone() for key in CONSTANTS if key in leaves(td)}
        moments, decisions = [seen(td)], []
        for _ in range(STEPS):
            td = env.step(policy(td))
            moments.append(seen(td["next"]))
            decisions.append(chosen(td))
            td = step_mdp(td)
    assert all(torch.equal(td[key], value) for key, value in begun.items())
    record = {CONSTANTS[key]: value for key, value in begun.items()}
    for rows in (moments, decisions):
        record |= {name: torch.stack([row[name] for row in rows], 1) for name in rows[0]}
    return {
        name: (value.squeeze(-1) if name not in WIDE and value.shape[-1] == 1 else value).numpy()
        for name, value in record.items()
    }


def driver(cfg: TrainConfig, who: Driver) -> Any:
    """Build what drives a case."""
    if isinstance(who, float):
        return ConstantPolicy(who)
    own = who in ("rule", "seed 0")
    return build_policy(cfg, build_agent(cfg, POPULATION).policy if own else shipped(who))


def shipped(name: str) -> Any:
    """Build a shipped policy."""
    weights, own = load_policy("pretrained", name)
    policy = build_agent(own, POPULATION).policy
    policy.load_state_dict(weights)
    return policy


def rollouts() -> None:
    """Play every case; rollouts/<case>.npz, and what all of them are made from."""
    profiles = wavy_profiles()
    write_arrays(
        "rollouts/inputs.npz",
        {
            "profile_speeds": profiles.speeds.view(len(profiles), -1).numpy(),
            "driver_desired_speed": POPULATION.desired_speed.numpy(),
            "driver_time_gap": POPULATION.time_gap.numpy(),
        },
    )
    note = {}
    for case, (variant, overrides, who) in ROLLOUTS.items():
        words = [f"variant={variant}", HORIZON, *overrides]
        cfg = load("train", words)
        record = drive(cfg, driver(cfg, who))
        write_arrays(f"rollouts/{case}.npz", record)
        note[case] = {"overrides": words, "driver": who}
    assert np.load(REFERENCE / "rollouts/alcc_collision.npz")["terminated"].any()
    write_note("rollouts", note)


# -- policies --------------------------------------------------------------------------------------


def observations(entries: int, count: int = 64) -> Tensor:
    """Well-mixed observations between −1.5 and 1.5, [count, entries]."""
    total = count * entries
    return torch.linspace(-1.5, 1.5, total)[(torch.arange(total) * 37) % total].view(count, entries)


def act(policy: Any) -> dict[str, np.ndarray]:
    """Return fixed observations and a learned policy's actions on them."""
    entries = next(value for value in policy.state_dict().values() if value.ndim == 2).shape[1]
    seen_by = observations(entries)
    td = TensorDict({"observation": seen_by}, [len(seen_by)])
    with torch.no_grad():
        return {"observation": seen_by.numpy(), "action": policy(td)["action"].numpy()}


def policies() -> None:
    """Actions of every shipped policy; policies.npz."""
    named = {name: act(shipped(name)) for name in ("alcc", "reference", "ddpg")}
    write_arrays("policies.npz", flat(named))


# -- evaluation and training -----------------------------------------------------------------------


def evaluation() -> None:
    """Rows of small evaluations; evaluation/<case>_episodes.parquet and …_steps.parquet."""
    note, columns = {}, {}
    for case, words in EVALUATIONS.items():
        with tempfile.TemporaryDirectory() as folder:
            evaluate.run(load("evaluate", list(words)), folder, quiet=True)
            tables = ("episodes", "steps") if case in ("alcc", "hcfs") else ("episodes",)
            for table in tables:
                frame = read_parquet(Path(folder) / f"{table}.parquet")
                write_rows(f"evaluation/{case}_{table}.parquet", frame)
            columns[case] = columns_of(Path(folder))
        note[case] = {"command": "evaluate", "overrides": list(words)}
    write_note("evaluation", note)
    write_note("evaluate", columns, "columns.json")


def training() -> None:
    """Rows and final policies of smoke trainings; training/…, and every variant's columns."""
    note, columns, sums, actions = {}, {}, {}, {}
    for case, words in TRAININGS.items():
        with tempfile.TemporaryDirectory() as folder:
            train.run(load("train", list(words)), folder, quiet=True)
            write_rows(f"training/{case}.parquet", read_parquet(Path(folder) / "training.parquet"))
            columns[case] = columns_of(Path(folder))
            weights, own = load_policy(folder)
        policy = build_agent(own, POPULATION).policy
        policy.load_state_dict(weights)
        actions[case] = act(policy)
        values = torch.cat([value.flatten().double() for value in weights.values()])
        sums[case] = {
            "parameters": len(values),
            "sum": float(values.sum()),
            "norm": float(values.square().sum().sqrt()),
        }
        note[case] = {"command": "train", "overrides": list(words)}
    for variant in RULES:
        words = (f"variant={variant}", *SMOKE)
        with tempfile.TemporaryDirectory() as folder:
            train.run(load("train", list(words)), folder, quiet=True)
            columns[variant] = columns_of(Path(folder))
        note[variant] = {"command": "train", "overrides": list(words)}
    met = {next(w for w in one["overrides"] if "variant=" in w)[8:] for one in note.values()}
    assert met == set(VARIANTS), met
    write_arrays("training/actions.npz", flat(actions))
    write_note("weights", sums, "training/weights.json")
    write_note("training", note)
    write_note("train", columns, "columns.json")


def columns_of(folder: Path) -> dict[str, dict[str, str]]:
    """Return the columns of every table that a run left behind: name -> type."""
    schemas = {path.stem: pq.read_schema(path) for path in sorted(folder.glob("*.parquet"))}
    return {
        table: dict(zip(schema.names, map(str, schema.types), strict=True))
        for table, schema in schemas.items()
    }


def headline() -> None:
    """Means of the two studies' shipped policies on real data; headline.json."""
    data = os.environ.get("LCC_RL_DATA", str(Path(__file__).resolve().parents[3] / "shared/data"))
    note = {}
    for case, words in HEADLINES.items():
        given = [word.replace(SHARED, data) for word in words]
        with tempfile.TemporaryDirectory() as folder:
            rows = evaluate.run(load("evaluate", given), folder, quiet=True)
        keys = [key for key in ("case", "strategy") if key in rows]
        numbers = [*rows.select_dtypes(["number", "bool"]).columns]
        rows = rows.astype({name: float for name in numbers if name != "training_seed"})
        groups = rows.groupby(keys, sort=False)
        means = groups[[name for name in numbers if name != "training_seed"]].mean()
        note[case] = {
            "overrides": list(words),
            "rows": {named(key): int(count) for key, count in groups.size().items()},
            "means": {
                named(key): {name: None if np.isnan(x) else x for name, x in row.items()}
                for key, row in means.to_dict("index").items()
            },
        }
        write_note(case, note[case], "headline.json")


# -- writing ---------------------------------------------------------------------------------------


def named(key: str | tuple[str, ...]) -> str:
    return key if isinstance(key, str) else "/".join(key)


def flat(nested: dict[str, dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {f"{one}.{two}": value for one, inner in nested.items() for two, value in inner.items()}


def write_arrays(name: str, arrays: dict[str, np.ndarray]) -> None:
    path = REFERENCE / name
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays)


def write_rows(name: str, frame: pd.DataFrame) -> None:
    path = REFERENCE / name
    path.parent.mkdir(parents=True, exist_ok=True)
    frame.to_parquet(path, compression="zstd", index=False)


def write_note(key: str, content: Any, name: str = "commands.json") -> None:
    """Set one entry of a file of notes."""
    path = REFERENCE / name
    path.parent.mkdir(parents=True, exist_ok=True)
    notes = json.loads(path.read_text()) if path.exists() else {}
    notes[key] = content
    path.write_text(json.dumps(notes, indent=1, sort_keys=True, allow_nan=False) + "\n")


PARTS: dict[str, Callable[[], None]] = {
    "rollouts": rollouts,
    "policies": policies,
    "evaluation": evaluation,
    "training": training,
    "headline": headline,
}


def main(words: Sequence[str]) -> None:
    """Record the parts named, or all."""
    torch.set_num_threads(1)
    for name in words or PARTS:
        PARTS[name]()
        print("recorded", name, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
