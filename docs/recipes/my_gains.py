"""Gains of one's own controller by Optuna, on training windows of 60 s: docs/your_car.md."""

import numpy as np
import optuna
from my_car import Follow

import lcc_rl
from lcc_rl.results.intervals import saving

CAR = ["energy._target_=my_car.MyCar"]  # of all runs; harder brakes: "scenario.max_braking=6"
# Windows of the training recordings; the evaluation's are set aside.
TRAINING = [*CAR, "split.tuning=true", "evaluation.drivers=24", "evaluation.baselines=[]"]
TRIALS = 40


def growth(gains):
    """Growth of the speed's deviation along eight cars, in the worst of three waves."""
    waves = [15.0 + 3.0 * np.sin(np.arange(3000) / x) for x in (32, 64, 128)]  # 20, 40, 80 s
    steps = lcc_rl.simulate(waves, "automated*8", Follow(**gains), overrides=CAR).steps
    steps = steps[steps["time_s"] > 100.0]  # once the cars have settled
    deviation = steps.groupby(["episode", "vehicle"])["speed_mps"].std().unstack()
    return (deviation[8] / deviation[0]).max()


def cost(trial):
    gains = {"time_gap": trial.suggest_float("time_gap", 0.8, 2.0)}
    for name, low, high in (("gain", 0.02, 0.5), ("damping", 0.2, 2.0)):
        gains[name] = trial.suggest_float(name, low, high, log=True)
    rivals = {"own": Follow(**gains), "known": "idm_acc"}
    table = lcc_rl.compare(rivals, overrides=TRAINING).table.set_index("strategy")
    own, known = table.loc["own"], table.loc["known"]
    if own["collisions"]:  # its measures are NaN
        return np.inf
    short = [1.0 - own["flow_vph"] / known["flow_vph"], own["share_ttc_unsafe"] - 0.01]
    short.append(growth(gains) - 1.0)
    return own["path_energy_kj_per_km"] * (1.0 + 10.0 * sum(max(x, 0.0) for x in short))


def held_out(gains):
    """Print the flow in held-out windows, relative to that of the tuned IDM."""
    rivals = {"start": Follow(), "tuned": Follow(**gains), "known": "idm_acc"}
    rows = lcc_rl.compare(rivals, overrides=[*CAR, "evaluation.baselines=[]"]).rows
    flow = rows.groupby(["profile", "strategy"])["flow_vph"].mean().unstack()
    for name in ("start", "tuned"):
        less = saving(flow[[name]], flow[["known"]])
        print(f"{name}: flow {-less.value:+.1%} ({-less.high:+.1%} … {-less.low:+.1%})")


if __name__ == "__main__":
    study = optuna.create_study(storage="sqlite:///gains.db", study_name="own", load_if_exists=True)
    study.sampler = optuna.samplers.TPESampler(seed=len(study.trials))
    study.optimize(cost, n_trials=max(TRIALS - len(study.trials), 0))
    settings = "".join(f"{name}: {value:.4g}\n" for name, value in study.best_params.items())
    with open("tuned.yaml", "w") as file:
        file.write(f"_target_: my_car.Follow\n{settings}")
    print(settings + f"growth: {growth(study.best_params):.3f}")
    held_out(study.best_params)
