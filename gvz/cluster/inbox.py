"""What the dispatcher's thread has for the learner's."""

import threading
from collections import Counter, deque
from dataclasses import dataclass, field

from gvz.cluster.supervised import SupervisedHost
from gvz.transport.messages import Message, StepBlock


@dataclass(kw_only=True, slots=True)
class Inbox:
    """Both threads hold `changed` when they touch it, or what a `SupervisedHost` plays next."""

    changed: threading.Condition = field(default_factory=threading.Condition)
    batches: deque[tuple[SupervisedHost, StepBlock]] = field(default_factory=deque[tuple[SupervisedHost, StepBlock]])
    """what the learner has not taken, in the order it came"""
    messages: list[Message] = field(default_factory=list[Message])
    failure: Exception | None = None
    """why the dispatcher has ended"""
    counts: Counter[str] = field(default_factory=Counter[str])
    """received_bytes, dropped_records, cut_episodes, host_restarts"""
