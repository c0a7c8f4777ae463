#!/usr/bin/env bash
# highway-env 1.12.1: cars that stop behind a stopped leader drive backwards, the IDM cars of its
# traffic and the car of a policy. Its reference lists a MIN_SPEED of -40 m/s among the constants.
# Guess before: speeds end at 0, for IDM cars and under full braking.
# Seen: of twelve IDM cars the first rolls back at 0.4 m/s, the twelfth at 2.5; a policy that brakes
# in highway-v0 stands after 5 s, drives -40 m/s after 13 s, at the reward of a slow car.
# Hurt: queues, stop-and-go waves, energy; braking as a safe action of a policy or a filter.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        highway-env==1.12.1 gymnasium==1.4.0 numpy==2.4.6 pandas==3.1.1 || exit 2
cd "$folder"
venv/bin/python -W ignore - <<'EOF'
import sys

import gymnasium as gym
import highway_env  # noqa: F401
import numpy as np
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle

step = 1 / 15  # the package's own [s]
network = RoadNetwork.straight_road_network(1, speed_limit=20, length=10_000)
road = Road(network, np_random=np.random.RandomState(0))
leader = Vehicle(road, [500, 0], 0, 15.0)
queue = [
    IDMVehicle(road, [470 - 30 * k, 0], 0, 15.0, target_speed=20, enable_lane_change=False)
    for k in range(12)
]
road.vehicles = [leader, *queue]
speeds = []
for k in range(1350):  # 90 s; the leader brakes after 5 s
    road.act()
    brakes = k * step > 5 and leader.speed > 0
    leader.act({"acceleration": max(-3.0, -leader.speed / step) if brakes else 0, "steering": 0})
    road.step(step)
    speeds.append([car.speed for car in queue])
lowest = np.min(speeds, axis=0)
print("IDM cars, lowest speeds [m/s]:", *np.round(lowest, 1), "| collisions:",
      sum(car.crashed for car in queue))

action = {"type": "ContinuousAction", "lateral": False}
env = gym.make("highway-v0", config={"action": action, "duration": 30, "vehicles_count": 5})
env.reset(seed=1)
braked = []
for _ in range(20):
    reward = env.step(np.array([-1.0]))[1]
    braked.append((env.unwrapped.vehicle.speed, reward))
speed, reward = np.transpose(braked)
print("full braking, speeds [m/s]:", *np.round(speed).astype(int))
print("rewards:", *np.round(reward, 2))
same = lowest[0] < -0.2 and lowest[-1] < -2 and np.all(np.diff(lowest) < 0)
sys.exit(0 if same and speed[-1] < -39 and abs(reward[5] - reward[3]) < 1e-6 else 1)
EOF
