#!/usr/bin/env bash
# FMPy drives a controller of 10 Hz at 5 Hz if the drive lasts 120 s, at 0.6 Hz if it lasts 1,200 s
# (FMPy 0.3.32, pythonfmu 0.7.0; the FMU states a step of 0.1 s, the call only a stop time).
# Guess before: it is called every 0.1 s; a longer drive has the same first minute.
# Seen: behind a leader that brakes at 20 s, a gap of 13.2 m in a drive of 60 s becomes a crash.
# Hurt: who tests a cruise controller as an FMU; the step doubles until 1,000 samples suffice.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        fmpy==0.3.32 pythonfmu==0.7.0 numpy==2.4.1 || exit 2
cd "$folder"
cat >cruise.py <<'EOF'
from pythonfmu import DefaultExperiment, Fmi2Causality, Fmi2Slave, Real


class Cruise(Fmi2Slave):
    """A car with a controller that changes its acceleration by at most 0.1 m/s2 a call."""

    def __init__(self, **given):
        super().__init__(**given)
        self.default_experiment = DefaultExperiment(step_size=0.1)
        self.leader, self.speed, self.gap, self.acceleration = 20.0, 20.0, 30.0, 0.0
        self.register_variable(Real("leader", causality=Fmi2Causality.input))
        self.register_variable(Real("gap", causality=Fmi2Causality.output))

    def do_step(self, time, step):
        wanted = 0.2 * (self.gap - 2.0 - 1.4 * self.speed) + 0.8 * (self.leader - self.speed)
        change = min(max(wanted - self.acceleration, -0.1), 0.1)
        self.acceleration = min(max(self.acceleration + change, -6.0), 3.0)
        self.gap += (self.leader - self.speed - 0.5 * self.acceleration * step) * step
        self.speed = max(self.speed + self.acceleration * step, 0.0)
        return True
EOF
venv/bin/pythonfmu build -f cruise.py >/dev/null
venv/bin/python -W ignore - <<'EOF'
import sys

import numpy as np
from fmpy import simulate_fmu

times = np.linspace(0.0, 1200.0, 12001)
speeds = np.interp(times, [20.0, 24.0], [20.0, 8.0])  # the leader brakes at 3 m/s2
leader = np.array(list(zip(times, speeds)), dtype=[("time", float), ("leader", float)])
found = {}
for stop in (60.0, 120.0, 1200.0):
    rows = simulate_fmu("Cruise.fmu", stop_time=stop, input=leader, output=["gap"])
    step = rows["time"][1] - rows["time"][0]
    smallest = rows["gap"][rows["time"] < 60.05].min()
    print(f"drive of {stop:.0f} s: called every {step:.1f} s, gap of {smallest:.1f} m before 60 s")
    found[stop] = (round(step, 3), smallest > 0.0)
sys.exit(0 if found == {60.0: (0.1, True), 120.0: (0.2, False), 1200.0: (1.6, False)} else 1)
EOF
