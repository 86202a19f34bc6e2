"""One thread at a time in the calls of an object: see also tests/test_env_crashes.py, with an engine."""

import subprocess
import sys

FORK = """
import os, threading, warnings
from gvz.one_thread import one_thread

class Thing:
    @one_thread
    def wait(self, entered, until):
        entered.set()
        until.wait()

    @one_thread
    def end(self):
        pass

warnings.simplefilter("ignore")  # Python 3.12 warns of any fork beside threads
thing, entered, until = Thing(), threading.Event(), threading.Event()
threading.Thread(target=thing.wait, args=(entered, until)).start()
entered.wait()
if child := os.fork():
    until.set()
    assert os.waitpid(child, 0)[1] == 0
else:
    thing.end()
    os._exit(0)
"""


def test_a_fork_may_call_what_a_thread_of_its_parent_is_in():
    done = subprocess.run([sys.executable, "-c", FORK], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
