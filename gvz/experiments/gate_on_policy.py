"""A gate: replay against learning on-policy, at equal processor time."""

from gvz.experiments.gate import Gate

EXPERIMENT = Gate(
    name="gate_on_policy",
    title="Gate: replay or on-policy learning",
    question="At equal processor time, which agent plays tasks best that were not trained on: Rainbow, PQN or PPO?",
    configs=("rainbow_quick", "pqn_quick", "ppo_quick"),
    variants={"plain": {}},  # named, so that gate_sight and this gate share their runs of Rainbow
    scenarios=("dodge_projectiles", "health_gathering"),
    notes=("Rainbow has 16 games at once, PQN and PPO have 8: each config as it is.",),
)
