#!/usr/bin/env bash
# gymnasium `DelayObservation(env, 3)`: the first three observations of each episode are zeros, or
# the bound next to zero, not the state at the reset (gymnasium 1.4.0).
# Guess before: the reset observation is repeated, as FrameStackObservation does.
# Seen: the smallest gap that the space allows and speed 0 m/s.
# Hurt: who gives a policy a reaction delay: each episode begins with a crash.
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
from gymnasium.wrappers import DelayObservation, FrameStackObservation


class Following(gym.Env):
    observation_space = gym.spaces.Box(np.float32([1, 0]), np.float32([100, 40]))  # gap, speed
    action_space = gym.spaces.Box(-3, 3, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.float32([20, 15]), {}

    def step(self, action):
        return np.float32([20, 15]), 0.0, False, False, {}


env = DelayObservation(Following(), 3)
seen = [env.reset(seed=0)[0]] + [env.step(np.float32([0]))[0] for _ in range(4)]
print("delayed by 3:", [list(map(float, s)) for s in seen])
stacked = FrameStackObservation(Following(), 3).reset(seed=0)[0]
print("FrameStackObservation begins with:", stacked.tolist())
lowest = [bool((s == env.observation_space.low).all()) for s in seen]
sys.exit(0 if lowest == [True, True, True, False, False] and (stacked[:, 0] == 20).all() else 1)
EOF
