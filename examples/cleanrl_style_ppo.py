"""PPO in one file in the style of CleanRL: PyTorch, and the games of gvz.make_vec.

python examples/cleanrl_style_ppo.py --steps 500000   (how to install: docs/how-to/use-your-own-agent.md)
"""

import torch
import tyro
from torch import nn
from torch.distributions import Categorical

import gvz
from gvz.tasks import named_tasks


def act(network: nn.Module, stack: torch.Tensor) -> tuple[Categorical, torch.Tensor]:
    """u8[B, 4, 84, 84], the newest frame last -> (distribution of actions, values f32[B])."""
    outputs = network(stack / 255)
    return Categorical(logits=outputs[:, :-1]), outputs[:, -1]


def main(scenario: str = "defend_the_center", steps: int = 100_000, num_envs: int = 8, num_steps: int = 128):
    """Trains on the training set of 4 tasks; prints the score of every episode."""
    envs = gvz.make_vec(named_tasks(scenario, split="train4"), num_envs, grayscale=True, autoreset_mode="SameStep")
    convs = (nn.Conv2d(4, 32, 8, 4), nn.ReLU(), nn.Conv2d(32, 64, 4, 2), nn.ReLU(), nn.Flatten())
    network = nn.Sequential(*convs, nn.Linear(5184, 512), nn.ReLU(), nn.Linear(512, envs.single_action_space.n + 1))
    optimizer = torch.optim.Adam(network.parameters(), lr=2.5e-4, eps=1e-5)
    stacks = torch.zeros(num_steps, num_envs, 4, 84, 84, dtype=torch.uint8)
    actions, (log_probs, r, v, gamma, advantages) = stacks[..., 0, 0, 0].long(), torch.zeros(5, num_steps, num_envs)
    stack = torch.from_numpy(envs.reset(seed=1)[0])[:, None, ..., 0].repeat(1, 4, 1, 1)
    for _ in range(steps // (num_steps * num_envs)):
        for t in range(num_steps):
            policy, value = act(network, stack)
            stacks[t], actions[t], v[t] = stack, policy.sample(), value.detach()
            log_probs[t] = policy.log_prob(actions[t]).detach()
            obs, rewards, terminated, truncated, infos = envs.step(actions[t].numpy())
            stack = torch.cat([stack[:, 1:], torch.from_numpy(obs)[:, None, ..., 0]], dim=1)
            for i in (terminated | truncated).nonzero()[0]:
                print(f"{infos['task'][i]}: score {infos['final_info']['score'][i]:.0f}", flush=True)
                stack[i, 3] = torch.from_numpy(infos["final_obs"][i])[..., 0]
                rewards[i] += 0.99 * truncated[i] * act(network, stack[i : i + 1])[1].item()  # a time-out is no end
                stack[i] = torch.from_numpy(obs[i])[..., 0]
            r[t], gamma[t] = torch.from_numpy(rewards), torch.from_numpy(0.99 * ~(terminated | truncated))
        v_t, advantage = act(network, stack)[1].detach(), 0
        for t in reversed(range(num_steps)):  # generalized advantage estimation
            advantages[t] = advantage = r[t] + gamma[t] * (v_t + 0.95 * advantage) - v[t]
            v_t = v[t]
        rollout = (stacks, actions, log_probs, advantages, advantages + v)
        for batch in torch.stack([torch.randperm(v.numel()) for _ in range(4)]).view(16, -1):
            obs, action, log_prob, gain, target = (array.flatten(0, 1)[batch] for array in rollout)
            policy, value = act(network, obs)
            ratio, gain = (policy.log_prob(action) - log_prob).exp(), (gain - gain.mean()) / (gain.std() + 1e-8)
            gain = torch.min(ratio * gain, ratio.clamp(0.9, 1.1) * gain) + 0.01 * policy.entropy()
            optimizer.zero_grad()
            (0.5 * (value - target).square() - gain).mean().backward()
            optimizer.step()


if __name__ == "__main__":
    tyro.cli(main)
