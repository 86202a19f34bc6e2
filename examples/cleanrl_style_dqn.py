"""DQN in one file in the style of CleanRL: PyTorch, one environment, a replay of numpy arrays.

python examples/cleanrl_style_dqn.py --steps 200000   (how to install: docs/how-to/use-your-own-agent.md)
"""

import numpy as np
import torch
import tyro
from gymnasium.wrappers import FrameStackObservation
from torch import nn

import gvz


def q_network(num_actions: int) -> nn.Module:
    """f32[B, 4, 84, 84] in [0, 1] -> f32[B, A]."""
    convs = [nn.Conv2d(4, 32, 8, 4), nn.ReLU(), nn.Conv2d(32, 64, 4, 2), nn.ReLU(), nn.Conv2d(64, 64, 3, 1), nn.ReLU()]
    return nn.Sequential(*convs, nn.Flatten(), nn.Linear(3136, 512), nn.ReLU(), nn.Linear(512, num_actions))


def main(task: str = "defend_the_center/default", steps: int = 20_000, capacity: int = 20_000, warmup: int = 1_000):
    """Does a gradient step at every fourth decision; prints the score of every episode."""
    torch.manual_seed(1)
    rng = np.random.default_rng(1)
    env = FrameStackObservation(gvz.make(task, grayscale=True), 4)  # u8[4, 84, 84, 1], newest frame last
    online, target = q_network(env.action_space.n), q_network(env.action_space.n)
    optimizer = torch.optim.Adam(online.parameters(), lr=1e-4)
    frames = np.zeros((2, capacity, 4, 84, 84), np.uint8)  # obs_tm1 and obs_t
    actions, rewards, discounts = np.zeros(capacity, np.int64), *np.zeros((2, capacity), np.float32)
    obs, _ = env.reset(seed=1)
    for step in range(steps):
        if step % 1_000 == 0:
            target.load_state_dict(online.state_dict())
        epsilon = max(0.05, 1 - step / (steps / 2))
        with torch.no_grad():
            greedy = online(torch.from_numpy(obs[None, ..., 0]) / 255).argmax().item()
        action = rng.integers(env.action_space.n) if rng.random() < epsilon else greedy
        obs_t, reward, terminated, truncated, info = env.step(action)
        i = step % capacity
        frames[:, i] = obs[..., 0], obs_t[..., 0]
        actions[i], rewards[i], discounts[i] = action, reward, 0.0 if terminated else 0.99  # bootstrap across time-outs
        obs = obs_t
        if terminated or truncated:
            print(f"decision {step}: score {info['score']:.0f} of {info['upper_bound']:.0f}, epsilon {epsilon:.2f}")
            obs, _ = env.reset()
        if step >= warmup and step % 4 == 0:
            j = rng.integers(min(step + 1, capacity), size=32)
            batch = frames[0, j], frames[1, j], actions[j], rewards[j], discounts[j]
            obs_tm1, obs_t, a_tm1, r_t, discount_t = map(torch.from_numpy, batch)
            y = r_t + discount_t * target(obs_t / 255).amax(1).detach()
            loss = nn.functional.smooth_l1_loss(online(obs_tm1 / 255).gather(1, a_tm1[:, None])[:, 0], y)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    env.close()


if __name__ == "__main__":
    tyro.cli(main)
