"""Faults in a run of the real command with real engines: noticed, mended within a budget, and nothing lost."""

import contextlib
import json
import signal
import subprocess
import time
from collections import Counter
from pathlib import Path

import numpy as np
import psutil
import pytest
from command import (
    ENV_STEPS_PER_UPDATE,
    TIMEOUT_S,
    alive,
    arguments,
    arrays_of,
    descendants,
    engines,
    faults,
    finish,
    launch,
    num_updates,
    rows,
)
from streams import check_streams

from gvz import cli
from gvz.core import janitor
from gvz.core.durable import saved_steps
from gvz.run import doctor
from gvz.transport import ring
from gvz.transport.ring import WriterState
from gvz.transport.segment import HEADER_BYTES
from learner.checkpoint import verify
from tests.waiting import wait_until

pytestmark = [pytest.mark.e2e, pytest.mark.engine, pytest.mark.timeout(1800), pytest.mark.usefixtures("nothing_left")]

HERE = Path(__file__).parent
SYNC = "--mode sync --actors.num-actors 1 --actors.games-per-actor 4".split()


def mischief(rules: dict[str, dict]) -> dict[str, str]:
    """The environment of a run whose games do what tests/e2e/mischief/sitecustomize.py says."""
    return {"PYTHONPATH": str(HERE / "mischief"), "MISCHIEF": json.dumps(rules)}


def rings(run: subprocess.Popen[str], number: int) -> list[Path]:
    """The learner's descriptors of an actor's ring; none before it is made."""
    found = []
    for link in Path(f"/proc/{run.pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # closed since
            if link.readlink().name.startswith(f"memfd:gvz-ring-{number} "):
                found.append(link)
    return found


def writer(run: subprocess.Popen[str], number: int) -> tuple[int, WriterState]:
    """Process id and state of an actor, from its ring."""
    words = np.frombuffer(rings(run, number)[0].read_bytes()[HEADER_BYTES:], "<u8", 8)
    return int(words[ring._PID]), WriterState(words[ring._STATE])


def actor(run: subprocess.Popen[str], number: int) -> psutil.Process:
    """The present process of an actor, once it plays."""

    def plays() -> bool:
        pid, state = writer(run, number)
        if state != WriterState.ACTING or janitor.process_start(pid) is None:
            return False
        return len(engines(psutil.Process(pid))) == 2  # else it has attached to the ring but not begun to say its own

    wait_until(lambda: rings(run, number), "the rings", TIMEOUT_S)
    wait_until(plays, f"actor {number} to play", TIMEOUT_S)
    return psutil.Process(writer(run, number)[0])


def suspend_acting(run: subprocess.Popen[str], number: int) -> psutil.Process:
    """Stops an actor between two episodes' beginnings, whose engines may take longer."""
    while True:
        stopped = actor(run, number)
        stopped.suspend()
        if writer(run, number)[1] == WriterState.ACTING:
            return stopped
        stopped.resume()


def await_fault(run_dir: Path, since: int, kind: str, number: int) -> dict:
    """The row of faults.jsonl that tells of it, among those after the first `since`."""

    def found() -> list[dict]:
        return [row for row in faults(run_dir)[since:] if (row["kind"], row["actor"]) == (kind, number)]

    try:
        return wait_until(found, f"a fault {kind} of actor {number}", TIMEOUT_S)[0]
    except AssertionError as error:
        raise AssertionError(f"{error}; there are {faults(run_dir)}") from None


def test_a_run_goes_through_every_fault_of_its_actors_and_engines_and_loses_nothing(tmp_path):
    run, slow = tmp_path / "run", tmp_path / "slow"
    slow.touch()  # until it is taken away the games last long enough for all this
    rules = {
        "*": {"sleep_s": 0.1, "while": str(slow)},
        "gore": {"raise_at": 10, "once": str(tmp_path / "raised")},
    }
    flags = "--learner.total-updates 600 --replay.capacity 12000 --actors.heartbeat-timeout-s 20".split()
    flags += ["--learner.warmup-steps", "100"]  # slow games take 15 s for 300
    process = launch(run, *flags, environment=mischief(rules))
    seconds = {}

    told = await_fault(run, 0, "exception", 0)
    assert told["message"] == "RuntimeError: this step was meant to fail"
    assert "sitecustomize.py" in told["traceback"]
    assert "exited with code 1; restart 1 of 20" in await_fault(run, 0, "died", 0)["message"]

    victim = actor(process, 1)
    before, start = len(faults(run)), time.monotonic()
    victim.kill()
    assert "actor 1 was ended by SIGKILL; restart 1 of 20" in await_fault(run, before, "died", 1)["message"]
    seconds["actor killed"] = time.monotonic() - start

    victim = engines(actor(process, 0))[0]
    before, start = len(faults(run)), time.monotonic()
    victim.kill()
    assert "a new one is started" in await_fault(run, before, "engine_crash", 0)["message"]
    seconds["engine killed"] = time.monotonic() - start

    stopped_engine = engines(actor(process, 0))[0]
    wait_until(lambda: num_updates(run) >= 20, "training", TIMEOUT_S)
    before, start = len(faults(run)), time.monotonic()
    stopped_actor = suspend_acting(process, 1)
    stopped_engine.suspend()
    assert "no answer within 10 s, killed" in await_fault(run, before, "engine_crash", 0)["traceback"]
    seconds["engine stopped"] = time.monotonic() - start
    assert "actor 1 gave no sign of life for " in await_fault(run, before, "stuck", 1)["message"]
    seconds["actor stopped"] = time.monotonic() - start

    late = 0  # engines that had given their first frame before they were found, on a busy machine
    while True:
        before, start = len(faults(run)), time.monotonic()
        starting: list[psutil.Process] = []
        while not starting:  # of the process that takes the place of the stopped one
            assert time.monotonic() - start < 600
            pid, _ = writer(process, 1)
            starting = [] if pid == stopped_actor.pid else engines(psutil.Process(pid))
        starting[0].send_signal(signal.SIGSEGV)
        wait_until(lambda before=before: any(row["actor"] == 1 for row in faults(run)[before:]), "it", TIMEOUT_S)
        told = next(row for row in faults(run)[before:] if row["actor"] == 1)
        if told["kind"] != "engine_crash" or late == 10:
            break
        late += 1
        stopped_actor = actor(process, 1)
        stopped_actor.kill()
        await_fault(run, before, "died", 1)
    # an engine that dies before its first frame takes its client along: ViZDoom reads a null pointer
    assert (told["kind"], "actor 1 was ended by SIGSEGV" in told["message"]) == ("died", True)
    seconds["engine killed at its start"] = time.monotonic() - start
    actor(process, 1)

    slow.unlink()
    code, err = finish(process)
    assert code == 0, err
    print(*(f"{what}: {s:.1f} s" for what, s in seconds.items()), sep="\n")
    assert max(seconds.values()) < 120, seconds
    wanted = Counter({("exception", 0): 1, ("died", 0): 1, ("died", 1): 2, ("engine_crash", 0): 2, ("stuck", 1): 1})
    wanted.update({("engine_crash", 1): late, ("died", 1): late})
    assert Counter((row["kind"], row["actor"]) for row in rows(run, "faults.jsonl")) == wanted

    streams = check_streams(run, num_lanes=4, num_tasks=4)
    assert rows(run, "metrics.jsonl")[-1]["num_updates"] == 600
    cut = [row for row in streams.rows if row["cut"]]
    assert sorted(row["lane"] // 2 for row in cut) == [0, 0, *[1] * late], (
        "an episode whose engine died is recorded as cut"
    )
    assert all(row["truncated"] and not row["terminated"] for row in cut)
    ends = Counter(row["actor"] for row in rows(run, "faults.jsonl") if row["kind"] in ("died", "stuck"))
    for lane, missing in enumerate(streams.unrecorded):
        assert missing <= ends[lane // 2], "only the episodes of an actor that died have no row"
    for row in rows(run, "metrics.jsonl"):
        assert abs(row["actors/env_steps"] - 100 - ENV_STEPS_PER_UPDATE * row["num_updates"]) <= 256 + 64


@pytest.mark.slow
def test_a_spent_budget_ends_the_run_with_a_checkpoint_and_the_stack_of_the_stuck_actor(tmp_path):
    run = tmp_path / "run"
    flags = "--learner.total-updates 1000000 --actors.heartbeat-timeout-s 5 --actors.max-restarts 1".split()
    process = launch(run, *flags, environment=mischief({"gore": {"hang_at": 30}}))
    actor(process, 1)
    children = descendants(process)
    code, err = finish(process)
    assert code == 1
    message = err[err.rindex("error: actor 0 ") :]
    assert "gave no sign of life for " in message
    assert "that was end 2 within 600 s, and actors.max_restarts allows 1 restarts. The end of " in message
    assert f"The end of {run / 'work' / 'actor_0.log'}:\n" in message
    assert 'sitecustomize.py", line' in message, "where it hangs, by faulthandler"
    assert not alive(children)
    assert [row["kind"] for row in rows(run, "faults.jsonl")] == ["stuck", "gave_up"]
    assert all("sitecustomize.py" in row["traceback"] for row in rows(run, "faults.jsonl"))
    saved = saved_steps(run / "checkpoints")[-1]
    assert saved > 0
    verify(run / "checkpoints" / str(saved))


def test_a_killed_launcher_takes_everything_along_and_the_doctor_cleans_up_after_dead_runs_only(
    tmp_path, monkeypatch, capsys
):
    dead = launch(tmp_path / "dead", "--learner.total-updates", "1000000")
    wait_until(lambda: num_updates(tmp_path / "dead") >= 20, "training", TIMEOUT_S)
    living = launch(tmp_path / "living", "--learner.total-updates", "1000000")
    wait_until(lambda: len(engines(living)) == 4, "the engines of the second run", TIMEOUT_S)
    for engine in engines(dead)[:2]:
        engine.suspend()
    children = descendants(dead)
    assert len(children) == 7  # 2 actors, 4 engines, the watchdog
    kill_and_wait(dead, children)

    monkeypatch.setattr(doctor, "CHECKS", (doctor.check_leftovers,))
    before = set(janitor.runtime_dir().glob("*.json"))
    assert cli.main(["doctor", "--clean"]) == 0
    out = capsys.readouterr().out
    assert out.count("removed directory") == 4
    assert out.count("removed shared memory ViZDoom") == 12
    left = [json.loads(file.read_text()) for file in janitor.runtime_dir().glob("*.json")]
    assert left
    assert {record["owner_pid"] for record in left} <= {living.pid, *(p.pid for p in descendants(living))}
    assert len(before) > len(left)
    wait_until(lambda: num_updates(tmp_path / "living") >= 20, "the second run to train on", TIMEOUT_S)
    kill_and_wait(living, descendants(living))
    janitor.clean_dead_instances()


def kill_and_wait(process: subprocess.Popen[str], children: list[psutil.Process]) -> None:
    process.kill()
    finish(process)
    start = time.monotonic()
    wait_until(lambda: not alive(children), "actors and engines to end", 10)
    print(f"{len(children)} processes were gone after {time.monotonic() - start:.2f} s")


@pytest.mark.parametrize("moment", ["actors.worker", "gvz.engine.probe", "+viz_instance_id"])
def test_a_launcher_killed_while_it_starts_leaves_nothing(tmp_path, moment):
    cache = {"GVZ_CACHE_DIR": str(tmp_path / "cache")} if moment == "gvz.engine.probe" else {}
    process = launch(tmp_path / "run", environment=cache)
    wait_until(lambda: any(moment in arguments(p) for p in descendants(process)), moment, TIMEOUT_S)
    kill_and_wait(process, descendants(process))
    janitor.clean_dead_instances()
    assert janitor.dead_instances() == []


@pytest.mark.slow
@pytest.mark.parametrize("pause_s", [10.0, 30.0])
def test_stalls_lose_nothing_and_restart_nobody(tmp_path, pause_s):
    """The learner stops for a while, one actor is a hundred times slower than the other, one game never ends."""
    run = tmp_path / "run"
    rules = {"default": {"sleep_s": 0.3}, "fast_enemies": {"endless": True}}
    flags = "--learner.total-updates 500 --replay.capacity 36000".split()
    process = launch(run, *flags, environment=mischief(rules))
    wait_until(lambda: num_updates(run) >= 100, "update 100", TIMEOUT_S)
    process.send_signal(signal.SIGSTOP)
    time.sleep(pause_s)
    process.send_signal(signal.SIGCONT)
    code, err = finish(process)
    assert code == 0, err
    metrics = rows(run, "metrics.jsonl")
    for row in metrics:
        assert abs(row["actors/env_steps"] - 300 - ENV_STEPS_PER_UPDATE * row["num_updates"]) <= 256 + 64
    assert metrics[-1]["num_updates"] == 500
    assert metrics[-1]["actors/restarts"] == 0
    assert max(row["actors/wait_share"] for row in metrics) > 0.2, "the actors waited for the learner, and said so"
    warning = "defend_the_center/fast_enemies has ended no episode in "
    (fault,) = rows(run, "faults.jsonl")
    assert fault["kind"] == "warning"
    assert fault["message"].startswith(warning)
    assert f"warning: {warning}" in err
    assert check_streams(run, num_lanes=4, num_tasks=4).unrecorded == [0, 0, 0, 0]


def test_a_checkpoint_that_cannot_be_written_is_reported_tried_again_and_at_last_an_error(tmp_path):
    run = tmp_path / "run"
    for step in (100, 300):  # a file where a directory should be: stops root too, as permissions would not
        (run / "policies" / str(step)).parent.mkdir(parents=True, exist_ok=True)
        (run / "policies" / str(step)).touch()
    flags = (*SYNC, "--learner.total-updates", "300", "--learner.env-steps-per-update", "16")
    code, err = finish(launch(run, *flags, patch="gvz.run.saver.SAVE_RETRY_S = 0.0"))
    assert code == 1, err
    assert f"checkpoint failed, tried again within 0 s: checkpoint {run / 'policies' / '100'} could not be" in err
    assert 100 < saved_steps(run / "policies")[0] < 200, "the first one was tried again soon"
    assert "error: the last checkpoint, at update 300, could not be written: " in err
    assert f"{run / 'policies' / '300'} could not be written: NotADirectoryError" in err
    assert "The newest one is of update 200; mend this and give the same command to go on from there" in err
    assert saved_steps(run / "checkpoints")[1:] == [200]
    first, *last = rows(run, "faults.jsonl")
    assert {row["kind"] for row in (first, *last)} == {"checkpoint"}
    assert 100 <= first["num_updates"] < 200, "it is told of once the writing has ended"
    assert len(last) >= 2, "the last one is tried again"
    assert {row["num_updates"] for row in last} == {300}

    (run / "policies" / "300").unlink()
    code, err = finish(launch(run, *flags))
    assert code == 0, err
    assert "goes on from update 200" in err
    assert saved_steps(run / "checkpoints") == [200, 300]


def test_numbers_that_go_wrong_end_the_run_and_are_in_no_checkpoint(tmp_path):
    run = tmp_path / "run"
    agent = ("--agent.name", str(HERE / "fused_agent.py"))
    code, err = finish(launch(run, *SYNC, *agent, "--log.period-updates", "10000", "--learner.total-updates", "300"))
    assert code == 1, err
    message = err[err.rindex("error: ") :]
    assert "8 of 8 losses are NaN or infinite" in message
    (batch,) = run.glob("nonfinite_batch_*.npz")
    assert str(batch) in message
    update = int(batch.stem.rpartition("_")[2])
    assert 100 < update < 200
    assert saved_steps(run / "checkpoints") == saved_steps(run / "policies") == [100]
    for folder in ("checkpoints", "policies"):
        verify(run / folder / "100")
        arrays = arrays_of(run / folder / "100")
        assert not [name for name, array in arrays.items() if array.dtype.kind == "f" and np.isnan(array).any()]
    with np.load(batch) as saved:
        assert np.isnan(saved["loss"]).all()


def test_a_learner_to_whom_nothing_comes_says_so(tmp_path):
    process = launch(tmp_path / "run", patch="gvz.run.train.NO_RECORDS_TIMEOUT_S = 1.0")  # actors take longer to start
    code, err = finish(process)
    assert code == 1, err
    message = err[err.rindex("error: ") :]
    assert "learner waited 1 s for the actors' next step record; their logs are in " in message
