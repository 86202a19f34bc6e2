"""The examples for Slurm and Kubernetes: read by ShellCheck and by a parser of YAML; the array script is also run."""

import os
import shutil
import signal
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

from tests.waiting import wait_until

EXAMPLES = Path(__file__).parents[2] / "examples" / "cluster"
BIN = Path(sys.executable).parent
SCRIPTS = sorted(EXAMPLES.glob("*.sbatch"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_shellcheck_finds_nothing(script):
    done = subprocess.run([BIN / "shellcheck", script], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (0, "")


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_a_job_is_requeued_and_told_of_its_end_in_time(script):
    options = [line.removeprefix("#SBATCH ") for line in script.read_text().splitlines() if line.startswith("#SBATCH")]
    assert {"--requeue", "--signal=B:TERM@300", "--open-mode=append"} <= set(options)
    assert all(option.startswith("--") for option in options)


def test_each_node_of_ray_in_slurm_has_the_cores_that_it_gives_away():
    """Since Slurm 22.05 `srun` takes --cpus-per-task no more from the job, and a step may get one core."""
    steps = [part.split("&\n")[0] for part in (EXAMPLES / "slurm_ray.sbatch").read_text().split("srun --nodes")[1:]]
    nodes = [step for step in steps if "ray start" in step]
    assert len(nodes) == 2
    assert all('--cpus-per-task="$SLURM_CPUS_PER_TASK"' in step.split("ray start")[0] for step in nodes)


@pytest.mark.parametrize(
    ("of_its_name", "all_of_it", "head_ip"),
    [
        ("10.0.0.7", "172.17.0.1 10.0.0.7 ", "10.0.0.7"),
        ("127.0.1.1", "10.0.0.7 172.17.0.1 fd00::7 ", "10.0.0.7"),
        ("::1 127.0.1.1", "fd00::7 10.0.0.7 ", "10.0.0.7"),
    ],
)
def test_the_head_of_a_ray_cluster_in_slurm_has_an_address_that_other_nodes_reach(
    of_its_name, all_of_it, head_ip, tmp_path
):
    lines = (EXAMPLES / "slurm_ray.sbatch").read_text().split("head_ip=", 1)[1].split("\naddress=", 1)[0]
    for name, does in (
        ("srun", 'shift 3; exec "$@"'),
        ("hostname", f'[ "$1" = --ip-address ] && echo "{of_its_name}" || echo "{all_of_it}"'),
    ):
        (tmp_path / name).write_text(f"#!/bin/sh\n{does}\n")
        (tmp_path / name).chmod(0o700)
    script = f'set -euo pipefail\nhead_host=n1\nhead_ip={lines}\necho "$head_ip"'
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(["bash", "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == f"{head_ip}\n"


def test_an_experiment_in_slurm_waits_until_the_head_is_a_node(tmp_path):
    """Ray's head takes connections seconds before it is one, and until then `gvz` refuses this machine."""
    loop = (EXAMPLES / "slurm_ray.sbatch").read_text().split("\nfor _ in", 1)[1].split("\ndone", 1)[0]
    calls = tmp_path / "calls"
    python = f"""echo "$@" >>{calls}
case $(wc -l <{calls}) in
  1) exit 1 ;;
  2) echo '{{"nodes": ["127.0.0.10"]}}' ;;
  3) echo '{{"nodes": ["127.0.0.10", "127.0.0.1"]}}' ;;
esac"""
    for name, does in (("sleep", "exit 0"), ("python", python)):
        (tmp_path / name).write_text(f"#!/bin/sh\n{does}\n")
        (tmp_path / name).chmod(0o700)
    script = f"set -euo pipefail\nhead_ip=127.0.0.1\naddress=$head_ip:1\nfor _ in{loop}\ndone"
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    subprocess.run(["bash", "-c", script], env=environment, check=True)
    assert calls.read_text() == 3 * "-m gvz.cluster.probe 127.0.0.1:1\n"


@pytest.mark.e2e
@pytest.mark.engine
@pytest.mark.slow
def test_an_array_task_that_is_out_of_time_saves_its_run_and_goes_back_into_the_queue(tmp_path):
    queue = tmp_path / "bin"
    queue.mkdir()
    (queue / "scontrol").write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/requeued\n')  # Slurm's; there is none here
    (queue / "scontrol").chmod(0o700)
    environment = {
        **os.environ,
        "PATH": f"{queue}:{BIN}:{os.environ['PATH']}",
        "RESULTS": str(tmp_path / "results"),
        "SLURM_ARRAY_JOB_ID": "7",
        "SLURM_ARRAY_TASK_ID": "3",
    }
    bash = shutil.which("bash")
    assert bash is not None
    command = [bash, str(EXAMPLES / "slurm_array.sbatch"), "rainbow_evaluation", "--scale", "0.001"]
    task = subprocess.Popen(command, env=environment, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    directory = tmp_path / "results" / "runs" / "rainbow_4task" / "defend_the_center" / "train4" / "seed_1111"
    try:
        wait_until((directory / "metrics.jsonl").exists, "the first updates", 150, process=task)
        task.send_signal(signal.SIGTERM)
        said = task.communicate(timeout=120)[1]
    finally:
        task.kill()
    assert task.returncode == 143, said
    assert (tmp_path / "requeued").read_text() == "requeue 7_3\n"
    assert list((directory / "checkpoints").iterdir())


def test_the_kubernetes_cluster_asks_for_a_token_shares_results_and_has_shared_memory():
    claim, cluster = yaml.safe_load_all((EXAMPLES / "kuberay.yaml").read_text())
    assert (claim["kind"], claim["spec"]["accessModes"]) == ("PersistentVolumeClaim", ["ReadWriteMany"])
    assert (cluster["apiVersion"], cluster["kind"]) == ("ray.io/v1", "RayCluster")
    spec = cluster["spec"]
    assert spec["authOptions"] == {"mode": "token"}
    assert f"ray=={spec['rayVersion']}" in (EXAMPLES.parents[1] / "requirements.lock").read_text().splitlines()
    groups = [spec["headGroupSpec"], *spec["workerGroupSpecs"]]
    assert all(isinstance(value, str) for group in groups for value in group["rayStartParams"].values())
    for pod in (group["template"]["spec"] for group in groups):
        (container,) = pod["containers"]
        assert pod["securityContext"]["fsGroup"] == 1000  # of the Dockerfile's user, for the results
        assert container["image"] == f"registry.example.com/gvizdoom:{version('gvizdoom')}"
        assert {"name": "RAY_USAGE_STATS_ENABLED", "value": "0"} in container["env"]
        mounts = {mount["mountPath"]: mount["name"] for mount in container["volumeMounts"]}
        volumes = {volume["name"]: volume for volume in pod["volumes"]}
        assert volumes[mounts["/dev/shm"]]["emptyDir"]["medium"] == "Memory"
        assert volumes[mounts["/results"]]["persistentVolumeClaim"]["claimName"] == claim["metadata"]["name"]


def test_the_kubernetes_pods_have_probes_that_need_no_dashboard_agent():
    """KubeRay adds those that are missing, and asks the agent for HTTP, which plain `ray` does not have."""
    spec = list(yaml.safe_load_all((EXAMPLES / "kuberay.yaml").read_text()))[1]["spec"]
    (head,) = spec["headGroupSpec"]["template"]["spec"]["containers"]
    (worker,) = spec["workerGroupSpecs"][0]["template"]["spec"]["containers"]
    for probe in ("readinessProbe", "livenessProbe"):
        assert head[probe]["tcpSocket"] == {"port": head["ports"][0]["containerPort"]}
        assert worker[probe]["exec"] == worker["livenessProbe"]["exec"]
    *shell, asked = worker["livenessProbe"]["exec"]["command"]
    for name, code in (("raylet", 0), ("rayle", 1)):
        named = ["bash", "-c", f"echo {name} >/proc/$$/comm && echo ready && read -r"]
        with subprocess.Popen(named, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
            of_it = asked.replace("[0-9]*", str(process.pid))  # other tests have nodes, too
            assert subprocess.run([*shell, of_it], timeout=60, check=False).returncode == code
            process.kill()
