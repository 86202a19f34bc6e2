"""Policies of the zoo: packed, unpacked, played."""

import dataclasses
import errno
import json
import re
import shutil
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from gvz import cli
from gvz.commands import zoo as zoo_command
from gvz.core import janitor
from gvz.core.env_config import EnvConfig
from gvz.core.errors import ConfigError, ResourceError
from gvz.core.files import written_whole
from gvz.core.registry import OwnFiles
from gvz.evaluation import zoo
from gvz.evaluation.episode_log import RecordFile, read_rows
from gvz.evaluation.trained import find_checkpoints, read_params, read_run_config, trained_player
from gvz.evaluation.zoo import pack, run_directory, zoo_names
from gvz.run.config_files import config_to_dict
from gvz.segmentation import segmenter_file
from tests.evaluation.policies import CONFIG, write_policy
from tests.processes import run_until_killed
from tests.test_segmentation import write_network

SHIPPED = zoo.ZOO_DIRECTORY


@pytest.fixture(autouse=True)
def empty_zoo(tmp_path, monkeypatch):
    monkeypatch.setattr(zoo, "ZOO_DIRECTORY", tmp_path / "zoo")
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path / "cache"))


def test_a_packed_policy_is_the_runs_rounded(run):
    exact_player = trained_player(run, read_run_config(run), 20).identity
    (run / "evaluation.jsonl").write_text(json.dumps({"schema": 1, "task": "t", "episode": 0, **exact_player}) + "\n")
    packed = pack(run, "one", "20")
    assert (packed.num_updates, packed.num_episodes) == (20, 0), "no episode of the exact parameters"
    assert zoo_names() == ["one"]
    directory = run_directory("zoo:one")
    assert read_run_config(directory).run_dir is None
    assert read_run_config(directory).agent == read_run_config(run).agent
    (_, before), (_, after) = (read_params(path, CONFIG, 20) for path in (run, directory))
    import jax

    for exact, rounded in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        np.testing.assert_allclose(rounded, exact, rtol=2.0**-8)
        assert (rounded.view(np.uint32) % 2**16 == 0).all()
    row = {"schema": 1, "task": "t", "episode": 0, **trained_player(directory, CONFIG, 20).identity}
    rows = (json.dumps(row | {"base_seed": seed}) + "\n" for seed in (0, 1))
    (directory / "evaluation.jsonl").write_text("".join(rows))
    assert pack(directory, "one").num_episodes == 1, "scores are published of base seed 0"
    _, twice = read_params(run_directory("zoo:one"), CONFIG, 20)
    assert all(np.array_equal(*pair) for pair in zip(jax.tree.leaves(after), jax.tree.leaves(twice), strict=True))


def test_a_packed_policy_has_the_network_of_its_segmented_frames(tmp_path):
    network = write_network(tmp_path / "fresh.onnx")
    env = EnvConfig(frames="segmented", segmenter=str(network), frame_height=24, frame_width=42)
    config, run = dataclasses.replace(CONFIG, env=env), tmp_path / "run"
    write_policy(run, config, 20)
    pack(run, "one")
    network.unlink()
    packed = run_directory("zoo:one")
    found = read_run_config(packed)
    kept = segmenter_file("defend_the_center", found.env)
    assert kept.is_relative_to(packed)
    assert str(tmp_path / "fresh.onnx") not in (packed / "config.json").read_text(), "no path of this machine"
    identity = trained_player(packed, found, 20).identity
    pack(packed, "two")
    again = read_run_config(run_directory("zoo:two"))
    assert trained_player(run_directory("zoo:two"), again, 20).identity == identity
    kept.write_bytes(kept.read_bytes() + b"another network")
    assert trained_player(packed, found, 20).identity != identity, "these would be episodes of another player"


def test_a_policy_that_is_being_written_is_not_listed(run):
    pack(run, "one")
    with written_whole(zoo.ZOO_DIRECTORY / "two.zip"):
        assert zoo_names() == ["one"]


def test_files_that_the_cache_lost_are_unpacked_again(run):
    pack(run, "one")
    directory = run_directory("zoo:one")
    before = {path: path.read_bytes() for path in directory.rglob("*") if path.is_file()}
    played = directory / "evaluation.jsonl"
    played.write_text('{"schema": 1}\n')
    (directory / "episode.gif").touch()
    for path in before:  # a purge of old files
        if path != played:
            path.unlink()
    assert run_directory("zoo:one") == directory
    assert played.read_text() == '{"schema": 1}\n', "what the user has played"
    assert all(path.read_bytes() == content for path, content in before.items() if path != played)
    shutil.rmtree(directory / "policies")
    played.unlink()
    (directory / "config.json").write_bytes(bytes(len(before[directory / "config.json"])))  # after a power cut
    run_directory("zoo:one")
    assert {path: path.read_bytes() for path in before} == before
    assert (directory / "episode.gif").exists()
    assert find_checkpoints(directory, ["newest"]) == [100]
    assert [path.name for path in directory.parent.iterdir()] == ["one"]


def test_what_a_process_that_was_killed_had_unpacked_goes_with_the_next_start(tmp_path, monkeypatch):
    tmp_path.chmod(0o700)
    monkeypatch.setenv("GVZ_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "here").mkdir()
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path / "here" / ".." / "cache"))
    code = (
        "import zipfile\nfrom gvz.evaluation.zoo import run_directory, zoo_names\n"
        "extract = zipfile.ZipFile.extractall\n"
        "zipfile.ZipFile.extractall = lambda *given: extract(*given) or print('half', flush=True) or input()\n"
        "run_directory(f'zoo:{zoo_names()[0]}')\n"
    )
    assert run_until_killed(code) == "half"
    assert len(list((tmp_path / "cache").rglob("config.json"))) == 1
    (done,) = janitor.clean_dead_instances()
    assert done.startswith(f"directory {tmp_path / 'cache' / 'zoo'}")
    assert [path for path in (tmp_path / "cache").rglob("*") if path.is_file() or janitor.PREFIX in path.name] == []


@pytest.mark.parametrize(("record", "most"), [("metrics.jsonl", 100), ("episodes.jsonl", 4_000)])
@pytest.mark.parametrize(("times", "more"), [(0, 0), (0, 3), (1, 1), (5, 1)])
def test_a_packed_policy_has_few_rows_of_training_and_the_last_one(run, record, most, times, more):
    num_rows = times * most + more
    (run / record).write_text("".join(f'{{"num_updates": {n}}}\n' for n in range(num_rows)))
    pack(run, "one")
    text = (run_directory("zoo:one") / record).read_text()
    rows = [json.loads(line)["num_updates"] for line in text.splitlines()]
    assert rows[-1:] == list(range(num_rows))[-1:]
    assert len(set(np.diff(rows))) < 2
    assert min(num_rows, most // 2) <= len(rows) <= most


@pytest.mark.engine
def test_it_is_evaluated_recorded_exported_and_listed_with_its_score_card(run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pack(run, "one")
    task = "defend_the_center/gore+mossy_bricks"
    assert cli.main(["evaluate", "zoo:one", "--tasks", task, "--episodes", "2", "--workers", "1"]) == 0
    assert cli.main(["zoo", "--add", "zoo:one", "--name", "one"]) == 0
    rows = read_rows(run_directory("zoo:one") / "evaluation.jsonl")
    assert [row["task"] for row in rows] == [task] * 2
    assert cli.main(["export", "zoo:one", "--out", "tables"]) == 0
    assert (tmp_path / "tables" / "evaluation.csv").read_text().count(task) == 2
    capsys.readouterr()
    assert cli.main(["zoo"]) == 0
    _, line, *_ = capsys.readouterr().out.splitlines()
    assert line.split() == "zoo:one screen 4 tasks 100 1 of 7 tasks evaluated".split()
    assert cli.main(["zoo", "one"]) == 0
    shown = capsys.readouterr().out
    with closing(
        RecordFile(run_directory("zoo:one") / "evaluation.jsonl")
    ) as file:  # as by `gvz evaluate zoo:one --seeds 1`
        file.append({name: value for name, value in rows[0].items() if name != "schema"} | {"base_seed": 1})
    assert cli.main(["zoo", "one"]) == 0
    assert capsys.readouterr().out == shown, "the score card is of base seed 0"
    assert shown.startswith("zoo:one: small, seed 7, 100 updates\ntrained on defend_the_center/default, ")
    assert task in shown
    assert cli.main(["record", "zoo:one", "--out", "episode.gif", "--seconds", "0.5"]) == 0
    assert (tmp_path / "episode.gif").stat().st_size > 1000


def test_a_policy_takes_the_place_of_another_only_if_that_is_wanted(run, capsys):
    add = ["zoo", "--add", str(run), "--name", "one"]
    assert cli.main(add) == 0
    assert cli.main([*add, "--replace", "--checkpoint", "all"]) == 2
    assert "--checkpoint: got 'all', want newest, or one of " in capsys.readouterr().err
    assert cli.main([*add, "--checkpoint", "20"]) == 2
    assert "--name: the zoo has a policy one already; give another name, or --replace" in capsys.readouterr().err
    assert find_checkpoints(run_directory("zoo:one"), ["newest"]) == [100]
    assert cli.main(["zoo", "--add", "zoo:one", "--name", "one"]) == 0  # with its new score card
    assert cli.main([*add, "--checkpoint", "20", "--replace"]) == 0
    assert find_checkpoints(run_directory("zoo:one"), ["newest"]) == [20]


def test_an_unknown_policy_is_named(run):
    pack(run, "dodge_projectiles")
    with pytest.raises(
        ConfigError, match=r"zoo:dodge_projectile: no such policy \(did you mean 'dodge_projectiles'\?\); want one of"
    ):
        run_directory("zoo:dodge_projectile")
    with pytest.raises(ConfigError, match=r"no such file or directory; did you mean zoo:dodge_projectiles\?"):
        run_directory(Path("dodge_projectiles"))
    with pytest.raises(ConfigError, match="zoo: got name 'a/b', want letters, digits, _ and -"):
        pack(run, "a/b")


def test_a_list_says_of_a_policy_that_cannot_be_read_why_and_shows_the_others(run, tmp_path, capsys, refusal):
    source = tmp_path / "theirs.py"
    source.write_text(
        "from learner.agents.configs.rainbow import CONFIG as CONFIG\n"
        "from learner.agents.rainbow import AGENT as AGENT\n"
    )
    pack(run, "plain")
    config = dataclasses.replace(CONFIG, agent=dataclasses.replace(CONFIG.agent, name=str(source)))
    (run / "config.json").write_text(json.dumps(config_to_dict(config)))
    pack(run, "theirs", own_files=OwnFiles(agent=source))
    whole = (zoo.ZOO_DIRECTORY / "plain.zip").read_bytes()
    (zoo.ZOO_DIRECTORY / "cut.zip").write_bytes(whole[: len(whole) // 2])
    assert cli.main(["zoo"]) == 0
    _, cut, plain, theirs, *_ = capsys.readouterr().out.splitlines()
    assert plain.split() == "zoo:plain screen 4 tasks 100 0 of 7 tasks evaluated".split()
    assert cut.startswith(f"zoo:cut     error: {zoo.ZOO_DIRECTORY / 'cut.zip'} is damaged: File is not a zip")
    assert theirs.startswith("zoo:theirs  error: ")
    assert "its agent is a Python file" in theirs
    for name in ([], ["theirs"]):
        assert cli.main(["zoo", *name, "--agent", str(source)]) == 0
        assert "its agent is a Python file" not in capsys.readouterr().out
    assert "cut.zip is damaged: File is not a zip file; install GViZDoom again, or add" in refusal("zoo", "cut")


def test_a_file_with_damaged_contents_is_told(run):
    pack(run, "one")
    file = zoo.ZOO_DIRECTORY / "one.zip"
    data = bytearray(file.read_bytes())
    start = data.index(b"BZh")
    for first in (start, start + 40):  # no bzip2 at all, or another checksum
        (damaged := data.copy())[first : first + 8] = bytes(8)
        file.write_bytes(damaged)
        with pytest.raises(ResourceError, match=r"one\.zip is damaged: .*; install GViZDoom again, or add the policy"):
            run_directory("zoo:one")


def test_a_policy_that_is_too_large_is_not_added(run, monkeypatch):
    monkeypatch.setattr(zoo, "MAX_BYTES", 999)
    with pytest.raises(ConfigError, match=r"one would have [\d,]+ bytes, want at most 999; train a smaller network"):
        pack(run, "one")
    assert zoo_names() == []


def test_a_policy_that_cannot_be_written_leaves_the_one_before(run, monkeypatch):
    pack(run, "one")
    before, copy = (zoo.ZOO_DIRECTORY / "one.zip").read_bytes(), shutil.copy

    def full(source, target):
        copy(source, target)
        if zoo.ZOO_DIRECTORY in (target, *target.parents):
            (target / source.name if target.is_dir() else target).write_bytes(b"half")
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(shutil, "copy", full)
    with pytest.raises(OSError, match="No space left"):
        pack(run, "one", "20")
    assert [file.read_bytes() for file in zoo.ZOO_DIRECTORY.iterdir()] == [before]


def test_the_example_of_the_help_adds_a_policy_of_a_new_name():
    (name,) = re.findall(r"gvz zoo --add \S+ --name (\S+)", zoo_command.Zoo.__doc__)
    assert not (SHIPPED / f"{name}.zip").exists()
