#!/usr/bin/env bash
# gymnasium `DiscretizeAction(env, 5)` takes the centres of five bins: on ±3 m/s² the actions are
# -2.4, -1.2, 0, 1.2 and 2.4, so full braking and full acceleration are out of reach (1.4.0).
# Guess before: five values from bound to bound.
# Seen: also "0" is 1e-7 in single precision.
# Hurt: who trains DQN beside a continuous agent: it has a fifth less braking, and with an even
# number of bins it cannot keep its speed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq gymnasium==1.4.0 numpy==2.4.1 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import sys

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import DiscretizeAction


class Following(gym.Env):
    observation_space = gym.spaces.Box(0, 100, (2,), np.float32)
    action_space = gym.spaces.Box(-3, 3, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.float32([20, 15]), {}

    def step(self, action):
        self.acceleration = float(action[0])
        return np.float32([20, 15]), 0.0, False, False, {}


found = {}
for bins in (5, 4):
    env = DiscretizeAction(Following(), bins)
    env.reset(seed=0)
    found[bins] = []
    for k in range(bins):
        env.step(k)
        found[bins].append(env.unwrapped.acceleration)
    print(f"{bins} bins on ±3 m/s²:", [round(a, 3) for a in found[bins]])
expected = {5: [-2.4, -1.2, 0, 1.2, 2.4], 4: [-2.25, -0.75, 0.75, 2.25]}
sys.exit(0 if all(np.allclose(found[b], expected[b], atol=1e-5) for b in expected) else 1)
EOF
