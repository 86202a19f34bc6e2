"""Capacity on paper: numbers worked out by hand, and the command that prints them."""

import dataclasses
import json
import re
from pathlib import Path

import pytest

from gvz import cli
from gvz.cluster import measure
from gvz.cluster.plan import RECORDED, Cluster, Costs, capacity
from gvz.core.errors import ConfigError
from gvz.run.config import RunConfig
from gvz.run.config_files import load_config

ROOT = Path(__file__).parents[2]
FRAME = 84 * 84 * 3
ASK = Cluster(
    hosts=1,
    cores=16,
    games_per_actor=4,
    frame_bytes=FRAME,
    step_bytes=0,
    params_bytes=27_000_000,
    replay_bytes=21_000_000_000,
    env_steps_per_update=4.0,
    gbit_per_s=1e6,
    updates_per_s=5_000.0,
)
COSTS = Costs(decision_s=3e-3, pack_s=1e-3 / 3, unpack_s=1e-12, ingest_s=1e-12, ratio=2.48, source="by hand")
"""300 decisions/s a core, and nothing else that limits"""


@pytest.mark.parametrize(
    ("hosts", "decisions", "raw", "compressed", "params", "devices"),
    [
        # 16 x 300; 4,800 x 21,168 x 8 bits; by 2.48; 27 MB x 8 bits a second; 4,800 / (5,000 x 4)
        (1, 4_800, 0.81, 0.33, 0.216, 1),
        (4, 19_200, 3.25, 1.31, 0.864, 1),
        (100, 480_000, 81.3, 32.8, 21.6, 24),
        (1000, 4_800_000, 813, 328, 216, 240),
    ],
)
def test_the_first_table_of_the_design(hosts, decisions, raw, compressed, params, devices):
    ask = dataclasses.replace(ASK, hosts=hosts, updates_per_s=None)
    found = capacity(ask, COSTS)
    assert found.decisions_per_s == pytest.approx(decisions)
    assert found.first == "actors"
    assert found.updates_per_s == pytest.approx(decisions / 4)
    assert found.records_gbit_per_s == pytest.approx(compressed, rel=0.01)
    assert found.params_gbit_per_s == pytest.approx(params)
    plain = capacity(dataclasses.replace(ask, compress=False), dataclasses.replace(COSTS, decision_s=1 / 300))
    assert plain.records_gbit_per_s == pytest.approx(raw, rel=0.01)
    assert capacity(dataclasses.replace(ASK, hosts=hosts), COSTS).devices_wanted == devices


@pytest.mark.parametrize(
    ("changes", "costs", "first", "decisions"),
    [
        ({"hosts": 4}, {}, "actors", 19_200),
        ({"hosts": 8}, {}, "learner's devices", 20_000),  # 5,000 x 4, where the actors would play 38,400
        ({"hosts": 8, "devices": 3}, {}, "actors", 38_400),
        ({"hosts": 4, "gbit_per_s": 1.0}, {}, "network", 125e6 / (FRAME / 2.48)),  # 14,644
        ({"hosts": 4, "gbit_per_s": 1.0, "step_bytes": 44}, {}, "network", 125e6 / (FRAME / 2.48 + 44)),
        ({"hosts": 4}, {"unpack_s": 5e-5, "ingest_s": 5e-5}, "learner's core", 10_000),
        ({"hosts": 4, "compress": False}, {"unpack_s": 5e-5, "ingest_s": 6.25e-5}, "learner's core", 16_000),
    ],
)
def test_the_limit_that_comes_first(changes, costs, first, decisions):
    found = capacity(dataclasses.replace(ASK, **changes), dataclasses.replace(COSTS, **costs))
    assert (found.first, found.decisions_per_s) == (first, pytest.approx(decisions))
    assert list(found.limits.values()) == sorted(found.limits.values())


def test_parameters_age_and_memory():
    found = capacity(dataclasses.replace(ASK, hosts=4, gbit_per_s=8.64, step_bytes=32), COSTS)
    # 4 x 27 MB at 1.08 GB/s take 0.1 s; then a second until the next come
    assert found.params_age_s == pytest.approx(0.6)
    assert found.params_max_age_s == pytest.approx(1.1)
    # 4 hosts with 16 rings of 64 records and 2 batches of 512, at 19,200 records/s
    assert found.record_age_s == pytest.approx(4 * 2_048 / 19_200)
    assert found.host_shm_bytes == 64 * 11_000_000
    # 16 actors with parameters twice, 64 engines, two batches of 512 records
    assert found.host_memory_bytes == 16 * 324_000_000 + 64 * 31_000_000 + 1_024 * 21_200
    assert found.learner_memory_bytes == 700_000_000 + 21_000_000_000 + 4 * 1_024 * 21_200
    slow = capacity(dataclasses.replace(ASK, hosts=4, gbit_per_s=0.432), COSTS)
    assert slow.params_max_age_s == pytest.approx(4.0), "2 s to send, and the next only then"
    assert slow.params_gbit_per_s == pytest.approx(0.432)


@pytest.mark.parametrize(
    ("flags", "name", "got"),
    [
        (["--hosts", "0", "--cores", "16"], "hosts", "0"),
        (["--hosts", "4", "--cores", "-1"], "cores", "-1"),
        (["--hosts", "4", "--cores", "16", "--gbit-per-s", "0"], "gbit-per-s", "0"),
        (["--hosts", "4", "--cores", "16", "--updates-per-s", "-5"], "updates-per-s", "-5"),
    ],
)
def test_what_cannot_be_is_refused(flags, name, got, refusal):
    assert f"--{name}: got {got}, want more than 0" in refusal("cluster", "plan", *flags)


def test_an_agent_without_a_replay_has_no_plan(refusal):
    said = refusal(*"cluster plan --hosts 4 --cores 16 --config ppo_quick".split())
    assert "--config: got ppo_quick, whose agent ppo learns on-policy; the plan is for" in said


def test_the_time_of_a_decision_is_that_of_the_committed_record():
    record = json.loads((ROOT / "results" / "performance" / "acting.json").read_text())
    rows = {row["name"]: row["median"] for row in record["rows"] if row["kind"] == "measured"}
    begin = "processor time a decision, actor pool, full network, 8 games an actor, noise of each decision: "
    assert RECORDED.decision_s * 1e6 == pytest.approx(rows[begin + "engines"] + rows[begin + "Python"])


def test_constants_are_above_zero():
    with pytest.raises(ConfigError, match="ratio: got 0, want more than 0"):
        dataclasses.replace(COSTS, ratio=0)


def test_the_command_prints_the_plan_and_where_its_constants_are_from(capsys):
    flags = ["cluster", "plan", "--hosts", "4", "--cores", "16", "--updates-per-s", "5000"]
    assert cli.main(flags) == 0
    out = capsys.readouterr().out
    assert cli.main([*flags, "--json"]) == 0
    row = json.loads(capsys.readouterr().out)
    assert row["first"] == min(row["limits"], key=row["limits"].get)
    assert f"first: {row['first']} {row['limits'][row['first']]:,.0f}" in out
    assert "21,168 bytes a frame" in out
    assert RECORDED.source in out
    assert row["costs"]["source"] == RECORDED.source
    assert row["limits"]["actors"] == pytest.approx(64 / (RECORDED.decision_s + RECORDED.pack_s))
    assert cli.main([*flags, *"--devices 3 --gbit-per-s 2 --publish-period-s 5 --json".split()]) == 0
    other = json.loads(capsys.readouterr().out)
    changed = {what: other["limits"][what] / rate for what, rate in row["limits"].items()}
    assert changed == pytest.approx({"actors": 1, "learner's core": 1, "network": 0.2, "learner's devices": 3})
    assert row["params_max_age_s"] < 5 < other["params_max_age_s"]


def test_the_page_says_how_far_hosts_go(capsys):
    page = (ROOT / "docs" / "CLUSTER.md").read_text()
    rows = re.findall(r"^\| (\d+) \| (yes|no) \| (.*) \|$", page, flags=re.MULTILINE)
    assert len(rows) == 5
    for hosts, plain, cells in rows:
        flags = ["--no-compress"] if plain == "yes" else []
        assert cli.main(["cluster", "plan", "--hosts", hosts, "--cores", "16", "--json", *flags]) == 0
        found = json.loads(capsys.readouterr().out)
        rates = f"{found['limits'][found['first']]:,.0f} | {found['updates_per_s']:,.0f}"
        assert cells == f"{rates} | {found['records_gbit_per_s']:.2f} | {found['first']}"


def test_actors_of_a_plan_act_by_themselves_as_those_of_hosts_have_to(capsys, monkeypatch):
    """Where the device acts, a decision of an actor has no network."""
    assert cli.main("cluster plan --hosts 4 --cores 16 --config rainbow_general_gpu".split()) == 0
    assert "hosts play only with --actors.inference actors; rainbow_general_gpu has device" in capsys.readouterr().out

    def assembled(config: RunConfig, _: Path) -> None:
        raise ConfigError(f"measured with {config.actors.inference}")

    monkeypatch.setattr(measure, "assemble", assembled)
    with pytest.raises(ConfigError, match="measured with actors"):
        measure.measure(load_config("rainbow_general_gpu"))


@pytest.mark.e2e
@pytest.mark.engine
def test_this_machine_can_be_measured_instead(capsys, monkeypatch):
    monkeypatch.setattr(measure, "PLAY_S", 3.0)
    flags = ["cluster", "plan", "--hosts", "2", "--cores", "2", "--config", "dqn_quick", "--measure", "--json"]
    assert cli.main(flags) == 0
    costs = json.loads(capsys.readouterr().out)["costs"]
    assert "records of dqn_quick, one core of" in costs["source"]
    assert 1e-5 < costs["decision_s"] < 1
    assert 1e-7 < costs["unpack_s"] < costs["pack_s"] < 1e-1
    assert 1 < costs["ratio"] < 100
    assert 1e-8 < costs["ingest_s"] < 1e-1
