"""Unit and meaning of every entry that the shipped pieces and the clock write."""

from __future__ import annotations

from collections.abc import Collection

from lcc_rl.errors import ConfigError
from lcc_rl.pieces.base import Key

# Stand for any role of the string, and for any name under ``reward.terms``.
ROLE, NAME = "role", "name"

# Key → unit ("–" where there is none) and meaning.
ENTRIES: dict[Key, tuple[str, str]] = {
    ("episode", "seed"): ("–", "seed from which everything random in the episode follows"),
    ("episode", "step"): ("–", "steps since the start of the episode"),
    ("done",): ("–", "terminated or truncated"),
    ("terminated",): ("–", "a collision ended the episode, where collisions do"),
    ("truncated",): ("–", "the horizon is reached"),
    ("leader", "profile"): ("–", "id of the speed record that the leader plays"),
    ("leader", "start"): ("–", "sample of the record at which the episode begins"),
    ("leader", "speed"): ("m/s", "speed of the leader"),
    ("leader", "acceleration"): ("m/s²", "backward difference of its speed"),
    ("leader", "next_speed"): ("m/s", "its speed one step ahead, for oracles"),
    ("vehicles", "speed"): ("m/s", "speed"),
    ("vehicles", "gap"): ("m", "gap to the vehicle ahead, bumper to bumper"),
    ("vehicles", "relative_speed"): ("m/s", "speed of the vehicle ahead minus own speed"),
    ("vehicles", "acceleration"): ("m/s²", "acceleration executed during the last step"),
    ("vehicles", "jerk"): ("m/s³", "change of the executed acceleration per second"),
    ("vehicles", "command"): ("m/s²", "acceleration commanded for the last step"),
    ("vehicles", "power"): ("W", "power drawn during the last step"),
    ("vehicles", "energy_class"): ("–", "number of the vehicle's energy model, of a mixture"),
    ("vehicles", "ttc"): ("s", "time-to-collision; 1000 where the gap does not close"),
    ("vehicles", "time_gap"): ("s", "gap divided by speed"),
    ("vehicles", "gap_error"): ("m", "e_x(i,i−1), positive where too far behind"),
    ("vehicles", "speed_error"): ("m/s", "e_v(i,i−1), positive where too slow"),
    ("vehicles", "leader_gap_error"): ("m", "e_x(i,0), to the leader of its chain"),
    ("vehicles", "leader_speed_error"): ("m/s", "e_v(i,0), to the leader of its chain"),
    ("vehicles", "received_gap"): ("m", "gap by the position received"),
    ("vehicles", "leader_speed"): ("m/s", "speed of the leader of its chain"),
    ("vehicles", "leader_acceleration"): ("m/s²", "acceleration of the leader of its chain"),
    (ROLE, "index"): ("–", "places of the role's vehicles, 0 at the front"),
    (ROLE, "driver"): ("–", "id of each vehicle's driver in the population"),
    (ROLE, "desired_speed"): ("m/s", "desired speed v0 of the driver"),
    (ROLE, "desired_time_gap"): ("s", "desired time gap T of the driver"),
    (ROLE, "equilibrium_gap"): ("m", "gap at which the driver follows the leader's first speed"),
    (ROLE, "motion_history"): ("m/s, m, m/s", "past (speed, gap, relative speed), latest first"),
    (ROLE, "correction"): ("m/s²", "what the safety filter added to a policy's command"),
    (ROLE, "promised"): ("–", "1 where the safety filter answers for the step: see CBFFilter"),
    (ROLE, "safe"): ("–", "1 where full braking keeps the filter's limit when the step begins"),
    (ROLE, "predicted_acceleration"): ("m/s²", "acceleration of the last step as predicted"),
    (ROLE, "predicted_power"): ("W", "motor power at the predicted acceleration"),
    (ROLE, "estimate"): ("–, s", "estimated (q, T), q = (15 m/s / v0)^δ"),
    (ROLE, "covariance"): ("–, s, s²", "its covariance (C_qq, C_qT, C_TT)"),
    (ROLE, "speed_history"): ("m/s", "own speeds of the last steps, latest first"),
    (ROLE, "commanded_speed"): ("m/s", "speed that PI with saturation commanded last"),
    (ROLE, "unsolved"): ("–", "1 where the plan of MPC had no solution, and it brakes"),
    ("command", ROLE): ("m/s²", "acceleration that the role's controller commands"),
    ("wanted", ROLE): ("m/s²", "acceleration commanded before the safety filter"),
    ("obeyed", ROLE): ("m/s²", "acceleration that engine and brakes make of the command"),
    (ROLE, "actuation"): ("m/s²", "that of the last step, and commands that do not act yet"),
    (ROLE, "sensed_gap"): ("m", "gap as measured"),
    (ROLE, "sensed_speed"): ("m/s", "own speed as measured"),
    (ROLE, "sensed_relative_speed"): (
        "m/s",
        "speed of the vehicle ahead minus own speed, as measured",
    ),
    (ROLE, "sensed_ahead_speed"): ("m/s", "speed of the vehicle ahead as measured"),
    (ROLE, "sensed_ahead_acceleration"): ("m/s²", "its acceleration as measured"),
    (ROLE, "sensors"): ("–", "age of the measurement [steps], and true states to measure"),
    ("hybrid", "winner"): ("–", "candidate chosen: 0 rule, 1 policy, −1 at reset"),
    ("hybrid", "switches"): ("–", "changes of the winner since the start"),
    ("hybrid", "clamps"): ("–", "steps in which the jerk bound cut a candidate"),
    ("hybrid", "cap_interventions"): ("–", "steps in which the safe cap cut a candidate"),
    ("preview", "speed"): ("m/s", "speed of the leader at each horizon ahead"),
    ("memory", "entries"): ("of source", "averages or past values of each source"),
    ("memory", "history"): ("of source", "values of each source in the last steps"),
    ("automated", "observation"): ("–", "observed entries, each times its constant"),
    ("automated", "action"): ("–", "action in [−1, 1]"),
    ("automated", "reward_terms", NAME): ("–", "weighted term of the reward"),
    ("automated", "reward"): ("–", "sum of the terms"),
    ("observation",): ("–", "observation in the single-agent view"),
    ("action",): ("–", "action in the single-agent view"),
    ("reward_terms", NAME): ("–", "terms of the reward in the single-agent view"),
    ("reward",): ("–", "reward in the single-agent view"),
}


def entry_key(key: Key, roles: Collection[str]) -> Key:
    """Return the key under which :data:`ENTRIES` lists an entry.

    Args:
        key: full key of the entry.
        roles: the roles of the string.

    Raises:
        ConfigError: if the entry is not listed.

    Examples:
        >>> entry_key(("human", "driver"), ("automated", "human"))
        ('role', 'driver')
    """
    if key in ENTRIES:
        return key
    by_role = tuple(ROLE if part in roles else part for part in key)
    for listed in (by_role, (*key[:-1], NAME)):
        if listed in ENTRIES:
            return listed
    raise ConfigError(f"lcc_rl.pieces.entries lacks unit and meaning of {'.'.join(key)}")
