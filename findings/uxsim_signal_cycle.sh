#!/usr/bin/env bash
# UXsim 1.15.1, signals: each phase lasts one time step longer than it says, and the time step is
# 5 s unless `deltan` is changed (a platoon of 5 cars, 1 s of reaction time).
# Guess before: 12 s of green in 30 s let 40 % of a full lane pass, to a tenth; cycles are right.
# Seen: 56 %. Phases of 30 and 30 s have a cycle of 70 s, four of 15 s one of 80 s (deltan=1: 62 and
# 64), so that two such signals drift apart. No warning; its pages give green times in seconds.
# Hurt: signal plans, capacities, green waves, speed advice.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq uxsim==1.15.1 numpy==2.4.6 || exit 2
cd "$folder"
venv/bin/python -W error::UserWarning - <<'EOF'
import sys

import numpy as np
from uxsim import World

PLANS = [30, 30], [15, 15, 15, 15], [12, 18]


def drive(plan: list[int], deltan: int) -> tuple[np.ndarray, float]:
    """Return when the first phase begins [s], and how many cars of a full lane pass."""
    world = World(name="", deltan=deltan, tmax=600, print_mode=0, save_mode=0, show_mode=0,
                  random_seed=0)
    world.addNode("from", 0, 0)
    world.addNode("signal", 1, 0, signal=plan)
    world.addNode("to", 2, 0)
    world.addLink("in", "from", "signal", length=1000, free_flow_speed=15, signal_group=[0])
    world.addLink("out", "signal", "to", length=1000, free_flow_speed=15)
    world.adddemand("from", "to", 0, 600, flow=0.8)
    world.exec_simulation()
    green = np.array(world.get_node("signal").signal_log) == 0
    begins = world.DELTAT * (np.flatnonzero(green[1:] & ~green[:-1]) + 1)
    return begins, world.get_link("in").cum_departure[-1]


cycles, shares = {}, {}
for deltan in (5, 1):
    free = drive([0], deltan)[1]
    cycles[deltan], begins = [], []
    for plan in PLANS:
        at, passed = drive(list(plan), deltan)
        begins.append(at)
        cycles[deltan].append(float(np.diff(at).mean()))
        shares[deltan] = passed / free
        print(f"deltan {deltan}: {plan} s have a cycle of {cycles[deltan][-1]:.0f} s,",
              f"{passed:.0f} of {free:.0f} cars pass, {shares[deltan]:.0%}")
    apart = begins[1][:5] - begins[0][:5]
    print(f"deltan {deltan}: the first two begin {apart[0]:.0f} s apart, five cycles later",
          f"{apart[4]:.0f} s")
same = cycles == {5: [70, 80, 35], 1: [62, 64, 32]}
sys.exit(0 if same and shares[5] > 0.5 and shares[1] < 0.45 else 1)
EOF
