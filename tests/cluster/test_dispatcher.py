"""What the thread that speaks with the hosts says, without a cluster."""

from types import SimpleNamespace
from typing import Any

import pytest
from fake_env import config

from actors.pool import lanes_to_begin_with
from gvz.cluster.backend import Machine
from gvz.cluster.config import ClusterConfig
from gvz.cluster.dispatcher import Dispatcher
from gvz.cluster.hello import Hello
from gvz.cluster.supervised import SupervisedHost
from gvz.core.errors import ConfigError


def test_hosts_that_give_no_answer_are_named_at_the_start(tmp_path):
    """As where jobs of others hold a node's cores: Ray starts the host when they are free."""

    backend: Any = SimpleNamespace(
        machines=lambda: [Machine(id="1", name="n1", cpus=8, has_learner=False)],
        start=lambda *_: SimpleNamespace(greet=lambda _: "call", kill=lambda: None),
        wait=lambda *_: [],
    )
    pool, cluster = config(tmp_path, {}), ClusterConfig(address="h:1", hosts=1)
    host = SupervisedHost(0, pool, lanes_to_begin_with(pool, None), cluster)
    dispatcher = Dispatcher(backend, [host], cluster, Hello(versions={}, code="", schemas=(0, 0), maps={}))
    dispatcher._round()
    with pytest.raises(ConfigError, match=r"0 of 1 hosts came to play within 0 s, .*; no answer yet from n1; do other"):
        dispatcher.begin(0.0)
