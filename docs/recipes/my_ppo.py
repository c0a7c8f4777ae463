"""What the recipes share: networks, the loss and a loop of PPO, by TorchRL."""

import torch
from tensordict.nn import TensorDictModule
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss, ValueEstimators

STARTS = ["training.gap_range=[0.6,1.2]"]
SIZE = {"frames_per_batch": 19200, "total_frames": 768000}
SIZE |= {"auto_register_policy_transforms": True}


def networks(env, seen="observation"):
    torch.manual_seed(0)
    width = env.observation_spec[seen].shape[-1]
    actor = torch.nn.Sequential(MLP(width, 2, num_cells=[64, 64]), NormalParamExtractor())
    policy = ProbabilisticActor(
        TensorDictModule(actor, [seen], ["loc", "scale"]),
        spec=env.action_spec_unbatched,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    return policy, ValueOperator(MLP(width, 1, num_cells=[64, 64]), in_keys=[seen])


def loss_of(policy, critic, each=(), **keys):
    how = {"normalize_advantage": True, "normalize_advantage_exclude_dims": each}
    loss = ClipPPOLoss(policy, critic, entropy_coeff=1e-4, **how)
    loss.set_keys(**keys)
    loss.make_value_estimator(ValueEstimators.GAE, gamma=0.99, lmbda=0.95)
    return loss


def train(batches, loss, rows_of=lambda data: data.reshape(-1), reward="reward"):
    optimizer, rewards = torch.optim.Adam(loss.parameters(), lr=1e-3), []
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.1, 40)
    for data in batches:
        with torch.no_grad():
            loss.value_estimator(data, params=loss.critic_network_params)
        rows = rows_of(data)
        for _ in range(10):
            for part in torch.randperm(len(rows)).chunk(10):
                losses = loss(rows[part])
                optimizer.zero_grad()
                sum(losses[f"loss_{key}"] for key in ("objective", "critic", "entropy")).backward()
                torch.nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimizer.step()
        schedule.step()
        rewards.append(data["next", reward].mean().item())
    return rewards
