"""The page of the ring road: its JavaScript, run in Chromium, drives as the package does."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from helpers import check_refused, play, slow_but
from tensordict import TensorDict

from lcc_rl.config import load
from lcc_rl.config.nodes import Node
from lcc_rl.energy import CirclesFuel
from lcc_rl.envs import build_env
from lcc_rl.envs.inputs import load_inputs
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.named import controller_of
from lcc_rl.evaluation.strategies import trained
from lcc_rl.functional.pattern import parse_string
from lcc_rl.interfaces.export import export
from lcc_rl.interfaces.ring_page import RING_TASK, filter_data, page_data, ring_of, ring_page
from lcc_rl.pieces import CBFFilter
from lcc_rl.pieces.base import SEED
from lcc_rl.pieces.cbf import REMEMBERS
from lcc_rl.results.policies import load_policy

STEPS, EPISODE = 600, 976413892
LOUDER = 10.0  # times the task's noise: in a minute a wave grows
RING, FOLLOW = "pretrained/ring-22", "pretrained/i80-follow"  # with memory; with all of the filter
ALONE, PAIR = "automated human*21", "automated human*9 automated human*9"
# Drivers of a table with a reaction, on another ring.
OTHERS = ("drivers=i80_energy", "scenario.circumference=300")
# Whose page, who drives, from which step on, in which string.
CASES = [
    (RING, "human", 0, ALONE, ()),
    (RING, "follower_stopper", 200, ALONE, ()),
    (RING, "pi_saturation", 200, ALONE, ()),
    (RING, "network", 0, ALONE, ()),
    (FOLLOW, "network", 0, PAIR, ()),
    (RING, "follower_stopper", 200, ALONE, OTHERS),
]
DRIVE = """<script>
d.human.spread *= LOUDER;
const roles = ROLES, marked = new Set(roles.keys().filter(place => roles[place] === "automated"));
const one = new Ring(roles.length, marked, START ? "human" : DRIVER, EPISODE), ways = [];
for (let step = 0; step < STEPS; step++) {
  if (step === START) one.driver = DRIVER;
  one.advance();
  ways.push(one.cars.map(car => Math.round(1e6 * car.x)));
}
document.title = JSON.stringify([ways, one.fuel]);
</script>"""

WIDER = {"shortest_time_gap": 1.2, "full_speed": 8.0, "braking_ahead": 3.5}
ALL = """<script>document.title = JSON.stringify(STATES.map(([wanted, v, gap, ahead, a]) => {
  const car = { v, gap, ahead: { v: ahead, a } };
  return [...FILTERS.map(f => filtered(f, wanted, car)), fuelRate(v, a)];
}))</script>"""
VISIT = """<script>
el("seed").value = 2; restart(); show();
const read = () => { show(); return el("span").textContent; }, names = [read()];
el("skip").click(); names.push(read());
const wave = readings()[3];
document.querySelector("[value=network]").click(); advance(50); names.push(read());
const note = el("note3").textContent, leads = [el("lead").textContent];
el("count").value = 18; el("count").oninput(); leads.push(el("lead").textContent);
document.title = JSON.stringify([names, wave, note, leads.map(text => parseInt(text))]);
</script>"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """Run a script on a page; what it makes the page's title comes back."""
    name = next(filter(shutil.which, ("chromium", "chromium-browser", "google-chrome")), None)
    if name is None:
        pytest.skip("no Chromium: apt-get install chromium")
    folder = tmp_path_factory.mktemp("chromium")
    flags = "headless no-sandbox disable-gpu disable-quic no-first-run disable-sync dump-dom"
    flags += " disable-background-networking disable-component-update"
    words = [name, *(f"--{flag}" for flag in flags.split()), f"--user-data-dir={folder}/profile"]

    def run(page: str, script: str, **given: Any) -> Any:
        for key, value in given.items():
            script = re.sub(rf"\b{key.upper()}\b", json.dumps(value), script)
        path = folder / "page.html"
        path.write_text(page.replace("</body>", f"{script}</body>"), encoding="utf-8")
        done = subprocess.run([*words, path.as_uri()], capture_output=True, text=True, timeout=120)
        return json.loads(re.search("<title>(.*?)</title>", done.stdout)[1])

    return run


def driven(
    policy: str, driver: str, start: int, string: str, more: tuple[str, ...]
) -> tuple[torch.Tensor, float]:
    """Positions of all cars after each step of the package [m], and the fuel of all [g]."""
    settings = [f"scenario.horizon={STEPS}", f"scenario.string={string}"]
    cfg, actor = load("evaluate", [*RING_TASK, *settings, *more]), None
    human, inputs = cfg.scenario.controllers["human"], load_inputs(cfg)
    human = human.changed(wiener=LOUDER * human.made().wiener)
    cfg = cfg.with_(scenario={"controllers": {"human": human}})
    if driver == "network":
        weights, own = load_policy(policy)
        own = own.with_(scenario={"name": cfg.scenario.name})  # one of an open road
        strategy = trained(cfg, policy, (weights, own), inputs.population)
        cfg, actor = strategy.cfg, strategy.policy
        filters = {"automated": None, **own.scenario.filters}
        cfg = cfg.with_(scenario={"filters": filters})
    else:
        after = human if driver == "human" else controller_of(driver)
        both = {"before": human, "after": after, "from_s": 0.1 * start}
        cfg = cfg.driven_by(
            Node.of({"_target_": "lcc_rl.pieces.Handover", **both}, "own")
        ).without_equipment()
    env = build_env(cfg, inputs.evaluation, inputs.population, (1,), nominal=True)
    given = TensorDict({SEED: torch.tensor([[EPISODE]])}, batch_size=[1])
    kept = [("vehicles", name) for name in ("speed", "gap", "power")]
    speed, gap, power = (x.flatten(1) for x in play(env, actor, given, kept)[0].values())
    front = (0.05 * (speed[1:, :1] + speed[:-1, :1])).cumsum(0)
    behind = torch.nn.functional.pad(gap[:, 1:] + 5.0, (1, 0)).cumsum(-1)
    return front - behind, 0.1 * float(power.sum()) / 42.36e3  # the heat of a gram [J]


@contextmanager
def double_precision() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize(
    ("policy", "driver", "start", "string", "settings"), slow_but((CASES[3], CASES[-1]), CASES)
)
def test_all_cars_of_the_page_drive_as_those_of_the_package(
    policy, driver, start, string, settings, browser
) -> None:
    case = {"louder": LOUDER, "roles": parse_string(string).roles, "driver": driver, "start": start}
    ways, fuel = browser(
        ring_page(policy, (), settings), DRIVE, **case, steps=STEPS, episode=EPISODE
    )
    with double_precision():
        found, burnt = driven(policy, driver, start, string, settings)
    apart = (found - 1e-6 * torch.tensor(ways)).abs().max()
    assert apart < 1e-3
    assert fuel == pytest.approx(burnt, rel=1e-5)


def test_filter_and_fuel_are_the_packages_in_any_state(browser) -> None:
    chance = torch.Generator().manual_seed(0)
    low, high = torch.tensor([[-3.0, 0, 0.5, 0, -3], [3, 20, 40, 20, 3]], dtype=torch.float64)
    states = low + (high - low) * torch.rand(2000, 5, generator=chance, dtype=torch.float64)
    states[::50, 1], states[::50, 4] = 0.0, 0.0  # some stand
    filters = [CBFFilter(**settings).bind() for settings in ({}, WIDER)]
    given = {"states": states.tolist(), "filters": [filter_data(f) for f in filters]}
    found = torch.tensor(browser(ring_page(RING), ALL, **given), dtype=torch.float64)
    columns, anew = states.unsqueeze(1).split(1, -1), states.new_zeros(len(states), 1, REMEMBERS)
    wanted = [f.filtered(*columns, anew)[0].flatten() for f in filters]
    fuel = CirclesFuel(vehicle="Compact").fuel(states[:, 1], states[:, 4])
    torch.testing.assert_close(found, torch.stack([*wanted, fuel], -1), rtol=1e-7, atol=1e-8)


def test_readings_name_their_time_and_the_skip_ends_in_a_wave(browser) -> None:
    span, spread, compared, counts = browser(ring_page(RING), VISIT)
    names = ["Mean since the start: 0 s", "Mean of the last minute", "Mean since the handover: 5 s"]
    assert span == names
    assert 2.0 < spread < 4.0  # [m/s], seed 2: 0.8 after five minutes
    assert re.fullmatch(r".+ %, before 2\.\d\d", compared)
    assert counts == [22, 18]  # of the lead


def test_a_page_has_the_ring_of_the_training_but_for_what_is_given(monkeypatch) -> None:
    own = (
        "scenario.circumference=300",
        "drivers.time_gap=0.83",
        "scenario.string=automated*2 human*20",
    )
    trained_there = {}, load("train", [*RING_TASK, *own, "energy.vehicle=midSUV"])
    monkeypatch.setattr("lcc_rl.interfaces.ring_page.load_policy", lambda *_, **__: trained_there)

    def found(*given: str) -> tuple[Any, ...]:
        cfg = ring_of("run", (), given)
        ring, settings = cfg.scenario, cfg.drivers.settings
        vehicle = cfg.energy.settings["vehicle"]
        return ring.circumference, len(ring.vehicles), settings.get("time_gap"), vehicle

    assert found() == (300.0, 22, 0.83, "midSUV")
    assert found("scenario.circumference=400")[:3] == (400.0, 22, 0.83)
    assert found("drivers=i80", "energy=compact") == (300.0, 22, None, "Compact")


def test_rules_of_a_page_have_the_limits_of_their_cars() -> None:
    rules = page_data(RING, (), ())["rules"].values()
    limits = [(rule["max_deceleration"], rule["max_acceleration"]) for rule in rules]
    assert limits == [(3.0, 1.5), (3.0, 1.5)]


def test_settings_in_the_address(browser) -> None:
    page = ring_page(RING).replace(
        "location.search", '"?length=300&T=0.83&delay=x&cars=25&other=1"'
    )
    found = "[d.circumference, d.human.drivers.time_gap, ring.cars.length, strange]"
    script = f"<script>document.title = JSON.stringify({found})</script>"
    assert browser(page, script) == [300, [0.83], 25, ["delay", "other"]]


def test_what_the_page_cannot_compute_is_one_clear_error(tmp_path) -> None:
    cases = [(policy, policy) for policy in ("pretrained/ddpg", "idm_acc")]
    check_refused(lambda policy: export(policy, tmp_path / "ring.html"), cases)
    settings = {
        "energy": "energy=mixture",
        "drivers": "drivers.gap_noise=0.1",
        "scenario.sensors": "+faults=sensors",
        "scenario.fleet": "+fleet=trucks",
        "role truck": "scenario.string=automated human truck",
    }
    for words, given in settings.items():
        ring = [given, *("+controller@scenario.controllers.truck=idm",) * given.endswith("truck")]
        with pytest.raises(ConfigError, match=f"does not support {words}"):
            export(RING, tmp_path / "ring.html", overrides=ring)
    unseen = ("seed=3", "agent=td3", "scenario.horizon=200", "filter=cbf", "training.episodes=3")
    cases = [(words, "has no effect: a page shows drivers, energy, .*") for words in unseen]
    cases += [("scenario.circumference_range=[0.5,2]", "only episodes of a training draw it")]
    check_refused(lambda words: ring_page(RING, overrides=[words]), cases, ConfigError)
    with pytest.raises(ConfigError, match="no road"):
        export(RING, tmp_path / "ring.onnx", overrides=["scenario.circumference=300"])
