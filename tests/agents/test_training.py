"""Training: deterministic, resumable bit for bit, and honest about what goes wrong."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import torch
from helpers import ACTION, REPLAYED, check_resuming, small_env, small_loop, string

from lcc_rl.agents.collecting import transitions
from lcc_rl.agents.loop import TrainingLoop, episode_statistics, still_colliding
from lcc_rl.errors import ResultsError


def make(folder, *overrides: str) -> TrainingLoop:
    return small_loop(folder, *REPLAYED, "training.episodes=20", *overrides)


def test_a_seed_is_one_training_whole_or_resumed(tmp_path) -> None:
    rows = check_resuming(lambda at: make(at, "agent.best_window=4", "seed=1"), tmp_path)
    other = make(tmp_path / "other").run()
    assert (other["episode_reward"] != rows["episode_reward"]).all()


# Everything that the paper's learner as printed differs in, at the size of a test.
LITERAL = (
    "training.environments=1",
    "training.segment=1",
    "scenario.horizon=20",
    "agent.updates_per_transition=1",
    "agent.learning_starts=60",
    "agent.tau=1",
    "agent.target_every={actor: 3, critic: 5}",
    "agent.mask_terminal=false",
    "agent.best_window=4",
    "agent.exploration={initial: 1, final: 0.1, decay_share: null, decay_per_update: 0.99}",
)


@pytest.mark.slow
def test_learning_starts_and_noise_falls_with_every_update(tmp_path) -> None:
    rows = make(tmp_path, *LITERAL).run()
    assert rows["updates"].tolist() == [max(0, 20 * n - 59) for n in range(1, 21)]
    done = [0, *rows["updates"].tolist()[:-1]]
    expected = [max(0.1, 0.99**count) for count in done]
    assert rows["exploration_sigma"].tolist() == pytest.approx(expected, rel=1e-12)
    assert min(expected) == 0.1 < max(expected)


@pytest.mark.parametrize(("window", "episodes", "seed"), [(4, 11, 0), (3, 6, 1)])
def test_the_best_policy_is_that_of_its_iteration(tmp_path, window, episodes, seed) -> None:
    words = f"agent.best_window={window}", f"training.episodes={episodes}", f"seed={seed}"
    trainer = make(tmp_path, *LITERAL, *words)
    seen = {}
    iterate = trainer.iterate

    def watched(collector):
        row = iterate(collector)
        seen[trainer.iteration] = {
            k: v.clone() for k, v in trainer.agent.policy.state_dict().items()
        }
        return row

    trainer.iterate = watched
    rows = trainer.run()
    # Windows of episodes that were played once learning had begun.
    since = rows["updates"].shift(window - 1) > 0
    scores = rows["episode_reward"].rolling(window).mean()[since]
    assert trainer.best["iteration"] == rows["iteration"][scores.idxmax()]
    assert trainer.best["score"] == pytest.approx(scores.max())
    best = seen[trainer.best["iteration"]]
    assert all(torch.equal(value, best[key]) for key, value in trainer.best["weights"].items())


def test_a_checkpoint_of_another_configuration_is_refused(tmp_path) -> None:
    make(tmp_path).run()
    with pytest.raises(ResultsError, match="another configuration"):
        make(tmp_path, "agent.gamma=0.8").load()


@pytest.mark.slow
@pytest.mark.parametrize("vehicles", ["automated human", "(automated human)*2"])
def test_torchrls_collector_gives_the_same_rows(tmp_path, vehicles) -> None:
    rows = [
        make(tmp_path / name, f"training.collector={name}", string(vehicles)).run()
        for name in ("string", "torchrl")
    ]
    pd.testing.assert_frame_equal(*rows, check_exact=True)


def test_every_vehicles_transition_is_learned_from() -> None:
    env = small_env("alcc", 3, [string("(automated human)*2"), "scenario.horizon=10"])
    data = env.rollout(10, break_when_any_done=False)
    rows = transitions(data)
    assert rows.shape == (3 * 10 * 2,)
    assert rows["observation"].shape == (60, 7)
    for key in ("reward", "done", "terminated"):
        assert rows["next", key].shape == (60, 1), key
    # Vehicles fastest, then steps; both of an episode end at once.
    assert torch.equal(rows["action"].view(3, 10, 2, 1), data[ACTION])
    done = data["next", "done"].unsqueeze(-2).expand(3, 10, 2, 1)
    assert torch.equal(rows["next", "done"].view(3, 10, 2, 1), done)
    assert done[:, -1].all()


def test_statistics_leave_out_what_follows_a_collision(tmp_path) -> None:
    trainer = make(tmp_path, "scenario.horizon=100")
    with torch.no_grad():
        trainer.agent.policy.module[0][-1].bias.fill_(9.0)  # full throttle into the leader
    batch = torch.cat(
        [next(segments) for segments in [iter(trainer.source())] for _ in range(10)], 1
    )
    row = episode_statistics(batch)
    assert row["collisions"] == 4
    assert row["reward_collision"] == -100.0
    terms = [value for key, value in row.items() if key.startswith("reward_")]
    assert row["episode_reward"] == pytest.approx(sum(terms), rel=1e-5)


@pytest.mark.slow
def test_collisions_at_the_end_of_a_training_are_said() -> None:
    number = np.arange(1.0, 21.0)
    record = pd.DataFrame({"iteration": number, "episodes": 64.0 * number, "collisions": 0.0})
    record.loc[:16, "collisions"] = 60.0
    assert still_colliding(record) == ""
    record.loc[18:, "collisions"] = 3.0, 1.0
    assert still_colliding(record).startswith("3.1 % of the last episodes ended in a collision")
    assert still_colliding(record[:9]) == ""


def test_learns_to_keep_going(tmp_path) -> None:
    # Behaviour, not numbers: after a few hundred updates the car earns more than at the start.
    trainer = make(
        tmp_path,
        "scenario.horizon=100",
        "training.episodes=160",
        "training.environments=16",
        "agent.batch_size=128",
        "agent.buffer_size=20000",
        "agent.hidden=[64,64]",
    )
    rows = trainer.run()
    assert rows["episode_reward"].tail(3).mean() > rows["episode_reward"].head(2).mean() + 10
