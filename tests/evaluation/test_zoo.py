"""Policies of the zoo: packed, unpacked, played."""

import dataclasses
import json
import shutil
from contextlib import closing

import numpy as np
import pytest

from gvz import cli
from gvz.core.env_config import EnvConfig
from gvz.core.errors import ConfigError
from gvz.evaluation import zoo
from gvz.evaluation.episode_log import RecordFile, read_rows
from gvz.evaluation.trained import find_checkpoints, read_params, read_run_config, trained_player
from gvz.evaluation.zoo import pack, run_directory, zoo_names
from gvz.run.rundir import RunDir
from gvz.segmentation import segmenter_file
from tests.evaluation.policies import CONFIG, write_policy
from tests.test_segmentation import write_network


@pytest.fixture(autouse=True)
def empty_zoo(tmp_path, monkeypatch):
    monkeypatch.setattr(zoo, "ZOO_DIRECTORY", tmp_path / "zoo")
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path / "cache"))


def test_a_packed_policy_is_the_runs_rounded(run):
    packed = pack(run, "one", "20")
    assert packed.num_updates == 20
    assert zoo_names() == ["one"]
    directory = run_directory("zoo:one")
    assert read_run_config(directory).run_dir is None
    assert read_run_config(directory).agent == read_run_config(run).agent
    (_, before), (_, after) = (read_params(path, CONFIG, 20) for path in (run, directory))
    import jax

    for exact, rounded in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        np.testing.assert_allclose(rounded, exact, rtol=2.0**-8)
        assert (rounded.view(np.uint32) % 2**16 == 0).all()
    pack(directory, "one")
    _, twice = read_params(run_directory("zoo:one"), CONFIG, 20)
    assert all(np.array_equal(*pair) for pair in zip(jax.tree.leaves(after), jax.tree.leaves(twice), strict=True))


def test_a_packed_policy_has_the_network_of_its_segmented_frames(tmp_path):
    network = write_network(tmp_path / "fresh.onnx")
    env = EnvConfig(frames="segmented", segmenter=str(network), frame_height=24, frame_width=42)
    config, run = dataclasses.replace(CONFIG, env=env), tmp_path / "run"
    with RunDir(run) as directory:
        directory.write_config(config)
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
    (directory / "config.json").write_text("")
    run_directory("zoo:one")
    assert {path: path.read_bytes() for path in before} == before
    assert (directory / "episode.gif").exists()
    assert find_checkpoints(directory, ["newest"]) == [100]
    assert [path.name for path in directory.parent.iterdir()] == ["one"]


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
def test_it_is_evaluated_recorded_and_listed_with_its_score_card(run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pack(run, "one")
    task = "defend_the_center/gore+mossy_bricks"
    assert cli.main(["evaluate", "zoo:one", "--tasks", task, "--episodes", "2", "--workers", "1"]) == 0
    assert cli.main(["zoo", "--add", "zoo:one", "--name", "one"]) == 0
    rows = read_rows(run_directory("zoo:one") / "evaluation.jsonl")
    assert [row["task"] for row in rows] == [task] * 2
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
    assert "--checkpoint: got all, want one of " in capsys.readouterr().err
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
    with pytest.raises(ConfigError, match="zoo: got name 'a/b', want letters, digits, _ and -"):
        pack(run, "a/b")
