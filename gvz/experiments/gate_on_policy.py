"""A gate: replay against learning on-policy, at equal processor time."""

from gvz.experiments.base import Experiment

EXPERIMENT = Experiment(
    name="gate_on_policy",
    title="Gate: replay or on-policy learning",
    source="docs/EXPERIMENTS.md, Gates",
    question="At equal processor time, which agent plays tasks best that were not trained on: Rainbow, PQN or PPO?",
    configs=("rainbow_quick", "pqn_quick", "ppo_quick"),
    variants={"plain": {}},  # named, so that gate_sight and this gate share their runs of Rainbow
    scenarios=("dodge_projectiles", "health_gathering"),
    trainings=("train8",),
    seeds=(1111, 2222),
    total_updates=60_000,
    max_processor_s=400.0,
    num_checkpoints=1,
    episodes=20,
    evaluate_on="gate",
    table_checkpoints=1,
    columns="config",
    notes=("Rainbow has 16 games at once, PQN and PPO have 8: each config as it is.",),
)
