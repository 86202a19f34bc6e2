"""Rainbow on four Defend the Center tasks: default, gore, stone_wall, fast_enemies (thesis Tables 5.1, 5.2)."""

from gvz.run.config import RunConfig

CONFIG = RunConfig(name="rainbow_4task", scenario="defend_the_center", training_set=4)
