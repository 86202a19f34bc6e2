"""A Ray cluster on this machine, in a process of its own: `python three_nodes.py NODES CORES`, then a line a command.

Prints {"address": ...}. `add` starts a node; `kill PID` ends the node whose raylet has this process id, and all that
runs on it, at once, as a power cut would. Each is answered by {"nodes": N}. The end of the input ends the cluster.
"""

import contextlib
import json
import sys
from typing import Any

import psutil
from ray.cluster_utils import Cluster

SMALL = {"include_dashboard": False, "object_store_memory": 100 * 2**20}


def main(num_nodes: int, num_cores: int) -> None:
    cluster = Cluster(initialize_head=True, head_node_args={**SMALL, "num_cpus": 0})
    nodes = [cluster.add_node(**SMALL, num_cpus=num_cores) for _ in range(num_nodes - 1)]
    try:
        print(json.dumps({"address": cluster.address}), flush=True)
        for line in sys.stdin:
            command, *pid = line.split()
            if command == "kill":
                (node,) = [node for node in nodes if raylet(node) == int(pid[0])]
                killed = psutil.Process(raylet(node))
                for process in [killed, *killed.children(recursive=True)]:
                    with contextlib.suppress(psutil.NoSuchProcess):  # it has ended because of one before it
                        process.kill()
                nodes.remove(node)
                cluster.remove_node(node, allow_graceful=False)
            else:
                nodes.append(cluster.add_node(**SMALL, num_cpus=num_cores))
            print(json.dumps({"nodes": 1 + len(nodes)}), flush=True)
    finally:
        cluster.shutdown()


def raylet(node: Any) -> int:
    (started,) = node.all_processes["raylet"]
    return started.process.pid


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
