"""The model predictive controller: its program, its limits on the road, and what it refuses."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest
import torch
from helpers import POPULATION, compose, wavy_profiles
from scipy.optimize import minimize

from lcc_rl.data.profiles import from_records
from lcc_rl.envs import build_env
from lcc_rl.functional.kinematics import advance_gap
from lcc_rl.functional.power import acceleration_loss, steady_power
from lcc_rl.pieces import MPC
from lcc_rl.pieces.mpc import MPCSettings

AUTO = "scenario.controllers.automated"
PLACE = f"controller@{AUTO}"


def rows(count: int = 64, seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Speeds, gaps, accelerations, speeds and accelerations ahead, ``[count, 1, 1]``."""
    generator = torch.Generator().manual_seed(seed)

    def draw(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(count, 1, 1, generator=generator)

    speed = draw(0.0, 25.0)
    ahead = (speed + draw(-4.0, 4.0)).clamp(min=0.0)
    return speed, (speed * draw(0.5, 3.0)).clamp(min=1.0), draw(-2, 2), ahead, draw(-2, 2)


def plan_cost(settings: MPCSettings, plan: torch.Tensor, moment: list[float]) -> torch.Tensor:
    """What a plan costs, by moving both vehicles through it."""
    s, h = settings, settings.step
    speed, gap, last, ahead, change = (torch.tensor(x, dtype=torch.float64) for x in moment)
    one, cost, first, lead = torch.ones_like(speed), 0.0, speed, ahead
    slope = torch.func.grad(steady_power)(first) / acceleration_loss(first, one)
    for step, a in enumerate(plan):
        decayed = 1.0 - np.exp(-h * (step + 1) / s.acceleration_time)
        new_lead = (ahead + change * s.acceleration_time * decayed).clamp(min=0.0)
        new_speed = speed + h * a  # the plan itself keeps it from falling below zero
        gap = advance_gap(gap, lead, speed, new_lead, new_speed, h)
        speed, lead = new_speed, new_lead
        near = (s.margin + s.least_time_gap * speed - gap).clamp(min=0.0)
        least = s.margin + (s.least_time_gap - s.longest_time_gap) * lead
        most = s.longest_time_gap * speed + least.clamp(min=s.longest_gap)
        far = (gap - most).clamp(min=0.0)
        ttc = (s.least_ttc * (speed - lead) - gap).clamp(min=0.0)
        cost += a**2 + s.jerk_price * ((a - last) / h) ** 2 + s.steady_price * slope * speed
        cost += s.near_price * near**2 + s.far_price * far**2 + s.ttc_price * ttc**2
        last = a
    return cost


def best_plan(settings: MPCSettings, moment: list[float]) -> np.ndarray:
    """The best plan by a general solver that knows nothing of the program's matrices."""
    count = round(settings.horizon / settings.step)
    keeps_forward = {
        "type": "ineq",
        "fun": lambda plan: moment[0] + settings.step * np.cumsum(plan),
    }
    limit = settings.max_acceleration or 3.0

    def cost(plan: np.ndarray) -> tuple[float, np.ndarray]:
        plan = torch.tensor(plan, requires_grad=True)
        value = plan_cost(settings, plan, moment)
        return value.item(), torch.autograd.grad(value, plan)[0].numpy()

    found = minimize(
        cost,
        np.zeros(count),
        jac=True,
        method="SLSQP",
        bounds=[(-limit, limit)] * count,
        constraints=[keeps_forward],
        options={"maxiter": 500, "ftol": 1e-10},
    )
    assert found.success, found.message
    return found.x


class TestWithOSQP:
    @pytest.fixture(autouse=True)
    def _installed(self) -> None:
        pytest.importorskip("osqp", reason="extra mpc")

    def test_commands_what_a_dense_solver_finds(self) -> None:
        chosen = {"horizon": 4.0, "tolerance": 1e-6, "max_acceleration": 2.5}
        settings = MPCSettings(**chosen)
        states = rows(10)
        command, unsolved = MPC(**chosen).bind().command(*states)
        expected = [
            best_plan(settings, [float(x[row]) for x in states])[0] for row in range(len(command))
        ]
        assert not unsolved.any()
        assert command.flatten().tolist() == pytest.approx(expected, abs=5e-3)
        assert command.min() == pytest.approx(-2.5)
        assert (command.abs() < 2.4).sum() >= 4, "plans inside of the limits are compared, too"

    def test_a_command_depends_on_its_own_row_alone(self) -> None:
        piece, states = MPC().bind(), rows()
        command = piece.command(*states)[0]
        order = torch.randperm(len(command), generator=torch.Generator().manual_seed(1))
        assert torch.equal(piece.command(*(x[order] for x in states))[0], command[order])
        alone = deepcopy(piece).command(*(x[5:6] for x in states))[0]
        assert torch.equal(alone, command[5:6])
        twice = piece.command(*(torch.cat([x, x]) for x in states))[0]
        assert torch.equal(twice, torch.cat([command, command]))

    def test_a_coarse_tolerance_changes_little(self) -> None:
        fine, coarse = (
            MPC(tolerance=x).bind().command(*rows())[0] for x in (1e-7, MPCSettings().tolerance)
        )
        assert (fine - coarse).abs().max() < 0.02

    def test_without_a_solution_it_brakes_and_says_so(self) -> None:
        command, unsolved = MPC(iterations=1).bind().command(*rows(4))
        assert command.flatten().tolist() == [-3.0] * 4
        assert unsolved.flatten().tolist() == [1.0] * 4

    def test_what_is_no_number_stays_none(self) -> None:
        states = rows(3)
        states[1][1] = torch.nan
        command, unsolved = MPC().bind().command(*states)
        assert command.isnan().flatten().tolist() == [False, True, False]
        assert not unsolved.any()

    def test_compiled_code_calls_it_as_it_is(self) -> None:
        piece, states = MPC().bind(), rows(4)

        def twice(*entries: torch.Tensor) -> torch.Tensor:
            return 2.0 * piece.command(*entries)[0]

        compiled = torch.compile(twice, backend="eager", dynamic=False)
        assert torch.equal(compiled(*states), twice(*states))

    def test_keeps_behind_a_leader_that_brakes_to_a_stop(self) -> None:
        time = torch.arange(201) * 0.1
        braking = (15.0 - 2.0 * (time - 2.0).clamp(min=0.0)).clamp(min=0.0)
        data = driven(braking)
        gap, speed = (data["next", "vehicles", x][0, :, 0, 0] for x in ("gap", "speed"))
        assert gap.min() > 0.9 * MPCSettings().margin
        assert data["next", "vehicles", "ttc"][0, :, 0].min() > 3.0
        assert speed[-1] < 0.05
        assert not data["next", "automated", "unsolved"].any()

    def test_follows_a_steady_leader_at_a_steady_gap_within_its_limits(self) -> None:
        data = driven(torch.full((201,), 12.0))
        gap, speed = (data["next", "vehicles", x][0, :, 0, 0] for x in ("gap", "speed"))
        assert speed[-50:].tolist() == pytest.approx([12.0] * 50, abs=0.15)
        assert gap[-50:].max() - gap[-50:].min() < 0.3
        settings = MPCSettings()
        assert settings.margin + settings.least_time_gap * 12.0 < gap[-1]
        assert gap[-1] < settings.longest_time_gap * 12.0 + 1.0

    def test_drives_another_vehicle_while_a_policy_learns_by_the_gradient(self) -> None:
        words = (
            "scenario.string='automated mpc human'",
            "+controller@scenario.controllers.mpc=mpc",
            "+scenario.start.mpc=${scenario.start.automated}",
            "scenario.horizon=5",
        )
        env = build_env(compose("reference", *words), wavy_profiles(), POPULATION, 2, seed=0)
        action = torch.zeros(2, 1, 1, requires_grad=True)
        data = env.rollout(5, lambda td: td.set(("automated", "action"), action))
        power = data["next", "vehicles", "power"].sum((0, 1, 3))
        own, other = (torch.autograd.grad(x, action, retain_graph=True)[0] for x in power[:2])
        assert (own != 0).all()
        assert (other == 0).all(), "what it commands passes no gradient"


def driven(speeds: torch.Tensor):
    """A rollout of 20 s behind a leader of given speeds, [1, 200]."""
    profiles = from_records([speeds.float()], ["a"], ["a"], 0.1)
    cfg = compose(
        "idm", f"{PLACE}=mpc", "scenario.horizon=200", "scenario.pieces.leader.start=first"
    )
    return build_env(cfg, profiles, POPULATION, 1, seed=0, nominal=True).rollout(200)
