"""Double DQN of Tianshou 2 with n-step returns, several games at once.

python examples/tianshou_dqn.py --epochs 20   (how to install: docs/how-to/use-your-own-agent.md)
"""

import tyro
from tianshou.algorithm.modelfree.dqn import DQN, DiscreteQLearningPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, VectorReplayBuffer
from tianshou.trainer import OffPolicyTrainerParams
from torch import Tensor, as_tensor, nn

import gvz
from gvz.vector.adapters.tianshou import TianshouVectorEnv


def make_games(task: str, games: int) -> TianshouVectorEnv:
    """Observations are stacks of 4 frames, u8[games, 4, 84, 84, 1]."""
    return TianshouVectorEnv(gvz.make_vec(task, games, batch_size=1, autoreset_mode="Disabled", grayscale=True))


class QNetwork(nn.Module):
    """u8[B, 4, 84, 84, 1] -> f32[B, A]; Tianshou passes numpy arrays and expects a recurrent state in return."""

    def __init__(self, num_actions: int):
        super().__init__()
        convs = (nn.Conv2d(4, 32, 8, 4), nn.ReLU(), nn.Conv2d(32, 64, 4, 2), nn.ReLU(), nn.Flatten())
        self.layers = nn.Sequential(*convs, nn.Linear(64 * 81, 512), nn.ReLU(), nn.Linear(512, num_actions))

    def forward(self, obs, state=None, info=None) -> tuple[Tensor, None]:
        return self.layers(as_tensor(obs)[..., 0] / 255), None


def main(task: str = "seek_and_kill/default", games: int = 2, epochs: int = 2, epoch_steps: int = 2_000):
    """Trains; plays test episodes between epochs."""
    training, test = make_games(task, games), make_games(task, 1)
    space = training.action_space[0]
    policy = DiscreteQLearningPolicy(model=QNetwork(int(space.n)), action_space=space, eps_training=0.1)
    dqn = DQN(policy=policy, optim=AdamOptimizerFactory(lr=1e-4), n_step_return_horizon=3, target_update_freq=500)
    result = dqn.run_training(
        OffPolicyTrainerParams(
            training_collector=Collector(dqn, training, VectorReplayBuffer(20_000, games), exploration_noise=True),
            test_collector=Collector(dqn, test),
            max_epochs=epochs,
            epoch_num_steps=epoch_steps,
            collection_step_num_env_steps=8 * games,
            update_step_num_gradient_steps_per_sample=0.25,
            test_step_num_episodes=1,
            batch_size=32,
        )
    )
    training.close()
    test.close()
    print(f"best reward of a test episode: {result.best_reward:.2f}")


if __name__ == "__main__":
    tyro.cli(main)
