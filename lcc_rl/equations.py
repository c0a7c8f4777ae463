"""Every equation of the two papers: formula, symbols with units, and what implements it."""

from __future__ import annotations

import re
from typing import NamedTuple

LAST = {"A": 20, "H": 21}  # numbers of equations of ALCC and of HCFS
PAPERS = """A1–A20: Wang et al., *Adaptive Leading Cruise Control in Mixed Traffic Considering
Human Behavioral Diversity* (ALCC). H1–H21: Yan et al., *Hybrid Car-Following Strategy Based on
Deep Deterministic Policy Gradient and Cooperative Adaptive Cruise Control* (HCFS). Vehicles count
from the front, 0 is the leader. T is the time step, in A4 and A15 the desired time gap. Import
paths begin with `lcc_rl.`. – means no unit, or no deviation. *Not recorded*: the paper's formula
has not been compared with the code. The update of DDPG is `agents.ddpg.DDPG`."""
REFERENCE = re.compile(r"\b([AH])(\d+)[a-d]?(?:–\1?(\d+)[a-d]?)?")


class Equation(NamedTuple):
    """One equation, or several that belong together.

    number: as ``A3`` or ``H4–H6``; formula: in plain text; symbols: with units; functions: import
    paths below ``lcc_rl``; deviation: how the code differs from what is printed.
    """

    number: str
    formula: str = "not recorded"
    symbols: str = "–"
    functions: tuple[str, ...] = ()
    deviation: str = "–"


def numbers_in(text: str) -> set[str]:
    """Return the equations that a text names, ranges written out.

    Examples:
        >>> sorted(numbers_in("CACC (HCFS H1–H2), see A18d"))
        ['A18', 'H1', 'H2']
    """
    found = set()
    for paper, first, last in REFERENCE.findall(text):
        found |= {f"{paper}{number}" for number in range(int(first), int(last or first) + 1)}
    return found


EQUATIONS = (
    Equation(
        "A1",
        "F = δ m a + m g f + ½ C_D A_f ρ v²",
        "F N; m 1005 kg; a m/s²; v m/s; g 9.81 m/s²; A_f 2.02 m²; ρ 1.206 kg/m³; δ, f, C_D –",
        ("functional.power.traction_force",),
        "a cross-check of A2; the motion is A18",
    ),
    Equation(
        "A2",
        "P = Σ p_ij v^i a^j",
        "P W; v m/s at the start of the step; a m/s² as executed",
        ("functional.power.motor_power", "pieces.features.MotorPower"),
        "braking power counts; recuperation=false cuts P off at 0",
    ),
    Equation(
        "A3",
        "dv/dt = a (1 − (v/v0)^δ − (s*/s)²)",
        "v, v0 m/s; a m/s²; s, s* m; δ 4",
        ("functional.idm.idm_acceleration", "pieces.controllers.IDM"),
        "s at least 0.1 m; dv/dt within −8…5 m/s²",
    ),
    Equation(
        "A4",
        "s* = s0 + max(0, v T + v Δv / (2 √(a b)))",
        "s0 m; T s; Δv = v − v_ahead m/s; a, b m/s²",
        ("functional.idm.desired_gap", "pieces.controllers.IDM"),
    ),
    Equation("A5"),
    Equation(
        "A6",
        "RMSPE = √(Σ_t (v_sim − v_obs)² / Σ_t v_obs²)",
        "v_sim, v_obs m/s; RMSPE –",
        ("drivers.speed_error.SpeedError", "drivers.idm_fit.fit"),
    ),
    Equation("A7–A9"),
    Equation(
        "A10",
        "TTC = d / (v − v_ahead) where v > v_ahead",
        "TTC s; d m; v m/s",
        ("functional.safety.time_to_collision", "pieces.features.TimeToCollision"),
        "within 0.01…1000 s",
    ),
    Equation(
        "A11",
        "R_safe = log(TTC / 4 s) where TTC ≤ 4 s, else 0",
        "R_safe –; TTC s",
        ("pieces.rewards.SafetyReward",),
        "TTC to a margin of 1 m; margin=0 is the printed form",
    ),
    Equation(
        "A12",
        "TG = d / v",
        "TG s; d m; v m/s",
        ("functional.safety.time_gap", "pieces.features.TimeGap"),
        "v at least 1 m/s (speed_floor=0 is the printed form); TG at most 1000 s",
    ),
    Equation(
        "A13",
        "R_eff = −1 where TG ≥ 2.5 s, else 0",
        "R_eff –; TG s",
        ("pieces.rewards.EfficiencyReward",),
    ),
    Equation(
        "A14",
        "R_CAV = −P(v_1, a_1) T / 20000 W",
        "R_CAV –; P W; T is the number of seconds of a step",
        ("pieces.rewards.EnergyReward",),
    ),
    Equation(
        "A15",
        "ã_2 = mean_i f_IDM(·; v0_i, T_i) for t < 5 s, then f_IDM(·; ṽ0, T̃) fitted online",
        "ã_2 m/s²; v0 m/s; T s",
        (
            "functional.estimation.predict_and_update",
            "functional.estimation.PopulationMean",
            "pieces.estimator.DriverEstimator",
        ),
        "the fit is a recursive second-order filter of (v0^−δ, T), with the population as prior",
    ),
    Equation(
        "A16",
        "R_HDV = −P(v_2, ã_2) T / 20000 W",
        "R_HDV –; P W; ã_2 m/s² of A15",
        ("pieces.rewards.EnergyReward", "pieces.features.MotorPower"),
        "summed over the human vehicles back to the next automated one",
    ),
    Equation(
        "A17",
        "r = R_safe + R_eff + R_CAV + R_HDV",
        "all –",
        ("pieces.rewards.TotalReward",),
        "minus 100 in the step of a collision (CollisionPenalty)",
    ),
    Equation(
        "A18",
        "v' = v + a T; d' = d + T ((v_a − v) + (v_a' − v')) / 2; human: a (1 + ξ), ξ ~ U(0, 0.05)",
        "v, v_a (ahead) m/s; d m; a m/s²; T s; ξ –; ' after the step",
        (
            "functional.kinematics.advance_speed",
            "functional.kinematics.advance_gap",
            "functional.string.advance_string",
            "pieces.string.StringMotion",
            "pieces.controllers.IDM",
        ),
        "v' = max(0, v + a T), and the executed a is (v' − v) / T",
    ),
    Equation(
        "A19",
        "r = R_safe + R_eff + R_CAV",
        "all –",
        ("pieces.rewards.TotalReward",),
        "minus 100 in the step of a collision (CollisionPenalty)",
    ),
    Equation(
        "A20",
        "E = Σ_t (P_CAV + P_HDV) T",
        "E J (tables: kJ); P W; T s",
        ("evaluation.metrics.energy_measures", "evaluation.episodes.measure"),
        "over all vehicles of the string; also net of the change in kinetic energy",
    ),
    Equation(
        "H1–H2",
        "e_x(i,j) = x_j − x_i − (i − j)(L + h); e_v(i,j) = v_j − v_i; j = i − 1 and j = 0",
        "e_x, x, L, h m; e_v, v m/s",
        ("functional.cacc.platoon_errors", "pieces.connected.Communication"),
        "signs reversed: as printed the gap is negative; positions are received 5 ms late",
    ),
    Equation(
        "H3",
        "s_i = (e_x(i,i−1), e_v(i,i−1), e_x(i,0), e_v(i,0), v_i, a_i)",
        "e_x m; e_v, v m/s; a m/s²",
        ("pieces.observation.Observation",),
        "each entry times a constant of conf/observation/platoon.yaml",
    ),
    Equation(
        "H4–H6",
        "r_i = −ω1 |e_v(i,0)| / v_max − ω2 |(a_k − a_{k−1}) / T| / (2 a_max / T)",
        "e_v, v_max m/s; a m/s²; T s; r, ω1, ω2 –",
        (
            "functional.hcfs.PlatoonReward",
            "pieces.rewards.VelocityReward",
            "pieces.rewards.JerkReward",
        ),
        "ω1 / v_max = 0.369 s/m and ω2 = 0.036 follow from Table IV",
    ),
    Equation("H7–H10"),
    Equation(
        "H11",
        "v_cmd = v_i + k1 e_x(i,i−1) + k2 e_v(i,i−1) + k3 e_x(i,0) + k4 e_v(i,0)",
        "v m/s; e_x m; e_v m/s; k1, k3 1/s; k2, k4 –",
        ("functional.cacc.cacc_acceleration", "pieces.connected.CACC"),
        "a speed command, reached in one step: a = clip((v_cmd − v_i) / T, ±a_max)",
    ),
    Equation(
        "H12–H14",
        "w = the candidate of larger r_i one step ahead, l the other; α = 1 where w changed, "
        "else 0; β = α/2; a_k = (1 − β) w + β l",
        "w, l, a m/s²; r, α, β –",
        ("functional.hcfs.hybrid_decision", "pieces.hybrid.HCFS"),
        "candidates are first held within the jerk bound and below a safe cap",
    ),
    Equation(
        "H15–H21",
        "|a_k − a_{k−1}| ≤ J T for all k where both candidates keep it",
        "a m/s²; J m/s³; T s",
        ("functional.hcfs.hybrid_decision", "functional.hcfs.jerk_interval"),
        "a theorem; the bound yields to the safe cap and to standstill",
    ),
)
