"""What goes wrong in the games of a run under test. Python imports this by itself where the folder is on its path.

MISCHIEF is JSON: the name of a task, or "*" -> what `DoomEnv.step` of its games does.
sleep_s: takes so much longer; with `while`, as long as that file exists. endless: its episodes go on for ever.
hang_at, raise_at: at that decision of the game in each process; with `once`, if that file does not exist yet.
"""

import json
import os
import sys
import time
from pathlib import Path

if "actors.worker" in sys.orig_argv:
    from gvz.env import DoomEnv

    RULES = json.loads(os.environ["MISCHIEF"])
    true_step = DoomEnv.step

    def step(self, action):
        rule = RULES.get("*", {}) | RULES.get(self.task.id.split("/")[1], {})
        self.num_steps = getattr(self, "num_steps", 0) + 1
        if "while" not in rule or Path(rule["while"]).exists():
            time.sleep(rule.get("sleep_s", 0.0))
        if self.num_steps in (rule.get("hang_at"), rule.get("raise_at")) and first_time(rule):
            if "raise_at" in rule:
                raise RuntimeError("this step was meant to fail")
            time.sleep(3600)
        result = true_step(self, action)
        if rule.get("endless") and (result[2] or result[3]):
            frame, info = self.reset()
            return frame, result[1], False, False, info
        return result

    def first_time(rule):
        try:
            Path(rule["once"]).touch(exist_ok=False)
        except FileExistsError:
            return False
        except KeyError:
            return True
        return True

    DoomEnv.step = step
