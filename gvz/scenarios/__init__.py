"""Tier 1. Scenarios: one file each, discovered by its SCENARIO; the compiler that makes maps of their tasks.

To add something is to add data. An attribute is an entry in its scenario's `attributes`, a named task a word in its
`tasks`, a scenario a file beside this one. The same works from outside without a change of any file:

>>> import dataclasses
>>> from gvz.scenarios.base import Attribute, Content, Task, Textures
>>> from gvz.scenarios.compiler import compile_task
>>> from gvz.scenarios.defend_the_center import SCENARIO
>>> ice = Textures("FLAT14", "FWATER1", "CEIL4_3")
>>> on_ice = Attribute(name="on_ice", groups=("textures",), content=Content(textures=ice))
>>> scenario = dataclasses.replace(SCENARIO, attributes=(*SCENARIO.attributes, on_ice))
>>> task = Task(scenario, ("on_ice", "gore", "fast"))
>>> task.id, task.level
('defend_the_center/fast_enemies+gore+on_ice', 3)
>>> compile_task(task).wad_path.suffix
'.wad'
"""
