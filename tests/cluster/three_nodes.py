"""A Ray cluster on this machine, in a process of its own: `python three_nodes.py NODES CORES`, then a line a command.

Prints {"address": ...}. Commands: `kill` ends the newest node at once, as a power cut would; `add` starts one. Each is
answered by {"nodes": N}. The end of the input ends the cluster.
"""

import json
import sys

from ray.cluster_utils import Cluster

SMALL = {"include_dashboard": False, "object_store_memory": 100 * 2**20}


def main(num_nodes: int, num_cores: int) -> None:
    cluster = Cluster(initialize_head=True, head_node_args={**SMALL, "num_cpus": 0})
    nodes = [cluster.add_node(**SMALL, num_cpus=num_cores) for _ in range(num_nodes - 1)]
    try:
        print(json.dumps({"address": cluster.address}), flush=True)
        for line in sys.stdin:
            if line.strip() == "kill":
                cluster.remove_node(nodes.pop(), allow_graceful=False)
            else:
                nodes.append(cluster.add_node(**SMALL, num_cpus=num_cores))
            print(json.dumps({"nodes": 1 + len(nodes)}), flush=True)
    finally:
        cluster.shutdown()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
