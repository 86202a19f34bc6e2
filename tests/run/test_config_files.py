"""Config files: found by name or path, and what is wrong with one is said with its path."""

import re

import pytest

from gvz.core.errors import ConfigError
from gvz.launch import parse
from gvz.run.config_files import configs_directory, find_config_file, load_config
from gvz.tasks import scenarios
from learner.config import ValueConfig


def test_a_path_is_taken_as_a_path(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text("from gvz.run.config import RunConfig\nCONFIG = RunConfig(name='mine', seed=5)\n")
    assert load_config(str(file)).seed == 5
    with pytest.raises(ConfigError, match=r"no file '.*/other\.py'"):
        find_config_file(str(tmp_path / "other.py"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1", "got NoneType for CONFIG, want `CONFIG = RunConfig"),
        ("x = 1\n1 / 0", ", line 3: ZeroDivisionError: division by zero"),
        ("def (", "SyntaxError"),
        ("CONFIG = RunConfig(name='a b')", ", line 2: name: got 'a b'"),
        ("CONFIG = RunConfig(name='a', mode='asynch')", ", line 2: CONFIG.mode: got 'asynch'"),
        (
            "CONFIG = RunConfig(name='a', training_set=2)",
            "CONFIG.training_set: got 2, want one of 1, 4, 8, pairs, comp",
        ),
        ("CONFIG = RunConfig(name='a', env={'frame_skip': 2})", "CONFIG.env: got {'frame_skip': 2}, want EnvConfig"),
        ("CONFIG = RunConfig(name='a', learner=LearnerConfig)", "CONFIG.learner: got <class 'learner.config.Lear"),
        (
            "CONFIG = RunConfig(name='a', tasks='rockets/blue')",
            "CONFIG.tasks: got 'rockets/blue', want a list, such as",
        ),
        (
            "CONFIG = RunConfig(name='a', learner=LearnerConfig(batch_size=32.5))",
            "CONFIG.learner.batch_size: got 32.5, want int",
        ),
        *(
            (f"CONFIG = RunConfig(name='a')\nSCENARIO_SETTINGS = {settings}", message)
            for settings, message in (
                ({"seek_and_kil": {}}, "unknown scenario 'seek_and_kil' (did you mean 'seek_and_kill'"),
                ({"seek_and_kill": {"agent.discout": 1}}, "settings: got agent.discout, want a field of RunConfig"),
                ({"seek_and_kill": {"agent.discount": "a"}}, "settings.agent.discount: got 'a', want"),
            )
        ),
    ],
)
def test_a_broken_config_file_is_named(tmp_path, text, message):
    file = tmp_path / "broken.py"
    file.write_text(f"from gvz.run.config import LearnerConfig, RunConfig\n{text}")
    with pytest.raises(ConfigError, match=re.escape(str(file)) + ".*" + re.escape(message)):
        load_config(str(file), "seek_and_kill")


def test_settings_of_a_scenario_hold_for_runs_that_play_it_alone_and_flags_come_after_them(tmp_path):
    file = tmp_path / "mine.py"
    settings = {
        "seek_and_kill": {"agent.discount": 0.5, "replay.capacity": 50_000},
        "find_the_key": {"agent.discount": 0.75},
    }
    file.write_text(
        f"from gvz.run.config import RunConfig\nCONFIG = RunConfig(name='mine')\nSCENARIO_SETTINGS = {settings}\n"
    )

    def discount(flags: str) -> float:
        return parse(["--config", str(file), *flags.split()]).run.agent.discount

    assert load_config(str(file)).agent.discount == 0.99
    assert load_config(str(file), "seek_and_kill").agent.discount == 0.5
    assert discount("") == discount("--scenario health_gathering") == 0.99
    assert discount("--scenario seek_and_kill") == discount("--tasks seek_and_kill/red seek_and_kill/blue") == 0.5
    assert discount("--scenario seek_and_kill --agent.discount 0.9") == 0.9
    assert discount("--tasks find_the_key/default") == 0.75
    assert discount("--tasks seek_and_kill/red dodge_projectiles/city --env.action-set unified_v1") == 0.99
    assert discount("--scenario seek_and_kill --agent.name dqn") == 0.5


def test_a_config_file_is_run_once_for_a_command(tmp_path):
    """A program of the user's own may draw a number or write something."""
    file, log = tmp_path / "mine.py", tmp_path / "log"
    file.write_text(
        "from gvz.run.config import RunConfig\nCONFIG = RunConfig(name='mine')\n"
        f"with open({str(log)!r}, 'a') as log:\n    log.write('.')\n"
    )
    parse(["--config", str(file), "--tasks", "seek_and_kill/red"])
    assert log.read_text() == "."


def test_a_name_that_no_file_can_have_is_refused():
    with pytest.raises(ConfigError, match=r"--config: 'a+' cannot be read: File name too long"):
        find_config_file("a" * 300)


@pytest.mark.parametrize("name", ["rainbow\0", "./rainbow\0.py"])
def test_a_null_byte_is_in_no_name(name):
    with pytest.raises(ConfigError, match=r"--config: no (config|file) '"):
        find_config_file(name)


def test_a_near_miss_is_suggested():
    with pytest.raises(ConfigError, match="did you mean 'rainbow_4task'"):
        load_config("rainbow_4tasks")


def test_the_segmented_config_shifts_frames_in_one_scenario_and_looks_further_ahead_in_another():
    found = {}
    for scenario in scenarios():
        agent = load_config("rainbow_segmented", scenario).agent
        assert isinstance(agent, ValueConfig)
        found[scenario] = agent.augmentations, agent.discount
    assert found == {
        "defend_the_center": ((), 0.95),
        "dodge_projectiles": (("shift",), 0.95),
        "health_gathering": ((), 0.98),
        "seek_and_kill": ((), 0.95),
    }


def test_the_games_of_an_on_policy_config_do_not_depend_on_the_cores(monkeypatch):
    """They are settings of its learner: a rollout has a window for each."""
    games = []
    for cores in (1, 2, 32):
        monkeypatch.setattr("gvz.run.config.num_cores", lambda cores=cores: cores)
        configs = [load_config(file.stem) for file in configs_directory().glob("*_*.py") if file.stem != "__init__"]
        games.append({config.name: config.num_lanes for config in configs if config.agent.on_policy})
    assert games[0] == games[1] == games[2]
    assert games[0]["ppo_segmented"] == 16
