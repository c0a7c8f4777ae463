"""What must not change while mechanisms are made one: data tables, actions, pages, the main table.

``LCC_RL_RECORD=1 pytest -m slow tests/regression/test_pins.py`` records the pins anew; a commit
that does so gives the reason. Data pins need the real files and are skipped without them.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from commands import run_command
from page_blocks import ROOT
from tensordict import TensorDict

from lcc_rl.agents.factory import build_agent
from lcc_rl.config import load
from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs.inputs import load_episodes as load_source
from lcc_rl.envs.inputs import load_inputs
from lcc_rl.results.policies import load_policy
from lcc_rl.results.report import summary, windows_for

pytestmark = pytest.mark.slow

PINS = Path(__file__).parent / "reference" / "pins.json"
RECORD = bool(os.environ.get("LCC_RL_RECORD"))
# Every table that today's readers make of the real files, by the words of a command.
EPISODES = {
    "i80_pairs": ("data=episodes", "data.path=<i80_pairs.parquet>"),
    "i80_layout": ("data=ngsim", "data.path=<i80_pairs_ngsim_layout.csv.gz>"),
    "coifman": (
        "data=ngsim",
        "data.path=<i80_coifman_li_2017_native.txt.gz>",
        "data.criteria.min_duration_s=8",
        "data.criteria.passenger_cars_only=false",
    ),
    "openacc": ("data=openacc", "data.path=<openacc_astazero_acc_short_9cars.csv.gz>"),
    "casale": ("data=openacc", "data.path=<new_openacc_native_casale.csv.gz>"),
    "zalazone": ("data=openacc", "data.path=<new_openacc_native_zalazone_dynamic_part26.csv.gz>"),
    "stream": ("data=stream",),
    "highway": ("data=highway",),
    "platoons": ("data=platoons",),
}
LEADERS = {
    "i24": ("leader=i24", "leader.path=<i24_leaders.parquet>"),
    "record": ("leader=record", "leader.path=<leader_openacc_platoon3_10hz.csv>"),
    "hwfet": ("leader=record", "leader.path=<cycle_hwfet_1hz.csv>"),
    "everyday": ("leader=everyday",),
    "i80_pairs": ("data=episodes", "data.path=<i80_pairs.parquet>"),
    "stream": ("data=stream",),
}
POLICIES = sorted(path.stem for path in (ROOT / "lcc_rl/assets/pretrained").glob("*.pt"))


def digest(values: np.ndarray) -> str:
    """Return a checksum of the bits of an array, or of the words of one of objects."""
    numbers = values.dtype.kind in "fiub"
    data = np.ascontiguousarray(values).tobytes() if numbers else "\n".join(map(str, values))
    return hashlib.sha256(data if isinstance(data, bytes) else data.encode()).hexdigest()[:16]


def of_table(table: pd.DataFrame) -> dict[str, str]:
    columns = {str(name): digest(table[name].to_numpy()) for name in table}
    return {"rows": str(len(table)), **columns}


def check(name: str, found: object) -> None:
    """Compare with what is pinned, or pin it."""
    pins = json.loads(PINS.read_text(encoding="utf-8")) if PINS.exists() else {}
    if RECORD:
        PINS.write_text(json.dumps({**pins, name: found}, indent=1, sort_keys=True) + "\n", "utf-8")
    else:
        assert found == pins[name]


def words_of(words: tuple[str, ...], folder: Path) -> list[str]:
    return [word.replace("<", f"'{folder}/").replace(">", "'") for word in words]


@pytest.mark.parametrize("name", EPISODES)
def test_episodes_of_real_files(name: str, request: pytest.FixtureRequest) -> None:
    real = any("<" in word for word in EPISODES[name])
    folder = request.getfixturevalue("shared_data") if real else Path()
    cfg = load("calibrate", words_of(EPISODES[name], folder))
    check(f"episodes.{name}", of_table(load_source(cfg.data).episodes))


@pytest.mark.parametrize("name", LEADERS)
def test_leaders_of_real_files(name: str, request: pytest.FixtureRequest) -> None:
    real = any("<" in word for word in LEADERS[name])
    folder = request.getfixturevalue("shared_data") if real else Path()
    inputs = load_inputs(load("evaluate", ["variant=alcc", *words_of(LEADERS[name], folder)]))
    found = {}
    for part in ("training", "evaluation"):
        profiles = getattr(inputs, part)
        records = [profiles.record(number).numpy() for number in range(len(profiles))]
        found[part] = digest(np.concatenate(records)) if records else ""
        found[f"{part}_names"] = digest(np.array(profiles.names, object))
    check(f"leaders.{name}", found)


@pytest.mark.parametrize("name", POLICIES)
def test_actions_of_shipped_policies(name: str) -> None:
    weights, cfg = load_policy(f"pretrained/{name}")
    agent = build_agent(cfg, bootstrap())
    agent.policy.load_state_dict(weights)
    size = next(x.shape[-1] for x in weights.values() if x.ndim == 2)
    seen = torch.linspace(-1.0, 1.5, 32 * size).reshape(32, size)[torch.arange(31, -1, -1)]
    with torch.no_grad():
        action = agent.policy(TensorDict({"observation": seen}, [32]))["action"]
    pinned = (
        json.loads(PINS.read_text(encoding="utf-8")).get(f"policy.{name}")
        if PINS.exists()
        else None
    )
    if RECORD:
        check(f"policy.{name}", action.flatten().tolist())
    else:
        np.testing.assert_allclose(action.flatten().numpy(), pinned, rtol=1e-5, atol=1e-6)


def test_table_of_the_main_job(tmp_path: Path) -> None:
    """README's table, by the command: energies within 0.2 %, where no bit is promised."""
    run_command("run", cwd=tmp_path, check=True)
    (rows,) = tmp_path.rglob("evaluation/episodes.parquet")
    table = summary(windows_for(pd.read_parquet(rows))).set_index("strategy")
    found = table["path_energy_kj_per_km"].to_dict()
    if RECORD:
        check("main", found)
    pinned = json.loads(PINS.read_text(encoding="utf-8"))["main"]
    assert found.keys() == pinned.keys()
    np.testing.assert_allclose([found[k] for k in pinned], list(pinned.values()), rtol=2e-3)
