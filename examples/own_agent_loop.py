"""The plain Gymnasium loop with an agent of your own: REINFORCE with a linear softmax policy over 12x12 grey pixels.

python examples/own_agent_loop.py --task defend_the_center/gore --episodes 50
"""

import cv2
import numpy as np
import tyro

import gvz


def features(frame: np.ndarray) -> np.ndarray:
    """u8[84, 84, 1] -> f32[145]: the frame shrunk to 12x12 and centred, and a constant."""
    small = cv2.resize(frame, (12, 12), interpolation=cv2.INTER_AREA).astype(np.float32).ravel() / 255
    return np.append(small - small.mean(), 1.0)


def policy(weights: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Probabilities of the actions, f64[A]."""
    logits = weights @ x
    exponentials = np.exp(logits - logits.max())
    return exponentials / exponentials.sum()


def main(task: str = "defend_the_center/default", episodes: int = 20, learning_rate: float = 1e-3, seed: int = 1):
    """Plays and learns; prints the score of every episode."""
    env = gvz.make(task, grayscale=True)
    rng = np.random.default_rng(seed)
    weights = np.zeros((env.action_space.n, 145))
    baseline = 0.0
    for episode in range(episodes):
        frame, info = env.reset(seed=seed if episode == 0 else None)  # one seed for the whole sequence of episodes
        gradients, rewards = [], []
        over = False
        while not over:
            x = features(frame)
            probabilities = policy(weights, x)
            action = rng.choice(len(probabilities), p=probabilities)
            gradients.append(np.outer(np.eye(len(probabilities))[action] - probabilities, x))
            frame, reward, terminated, truncated, info = env.step(action)
            rewards.append(reward)
            over = terminated or truncated
        returns = np.cumsum(rewards[::-1])[::-1]
        for gradient, value in zip(gradients, returns, strict=True):
            weights += learning_rate * (value - baseline) * gradient
        baseline += 0.1 * (returns.mean() - baseline)
        print(f"episode {episode}: {info['score']:.0f} of {info['upper_bound']:.0f}, reward {sum(rewards):.2f}")
    env.close()


if __name__ == "__main__":
    tyro.cli(main)
