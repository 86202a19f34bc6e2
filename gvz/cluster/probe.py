"""Asks a Ray cluster who it is: `python -m gvz.cluster.probe HOST:PORT`, one line of JSON.

A process of its own, because Ray's C++ client ends its process, or waits for minutes, where an address or a token is
wrong.
"""

import json
import sys
from typing import Any


def ask(address: str) -> dict[str, Any]:
    """`ray` and `python` (versions), `nodes` (addresses of those alive); or `refused`, for want of the right token."""
    from ray._raylet import GcsClient  # pyright: ignore[reportAttributeAccessIssue]  # compiled
    from ray.exceptions import AuthenticationError

    try:
        client = GcsClient(address=address)
        known = json.loads(client.internal_kv_get(b"CLUSTER_METADATA", b"cluster", timeout=30) or b"{}")
        nodes = client.get_all_node_info(timeout=30).values()
    except AuthenticationError:
        return {"refused": True}
    alive = [node.node_manager_address for node in nodes if node.state == 0]
    return {"ray": known.get("ray_version"), "python": known.get("python_version"), "nodes": alive}


if __name__ == "__main__":
    print(json.dumps(ask(sys.argv[1])))
