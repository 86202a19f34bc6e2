"""Every fuzz target there is. A target's parsers are imported when it is made."""

from importlib import import_module
from pathlib import Path

from tests.fuzz.target import Target

TARGETS = {
    name: module
    for module, names in {
        "maps": "wad udmf texture_lump decorate acs",
        "names": "task_name command_line config_name checkpoint_choice",
        "peers": "message channel batch ring parameter_queue segment_header",
        "files": "saved_config records evaluation_records run_directory plan janitor_record",
        "checkpoints": "checkpoint_manifest checkpoint_files",
    }.items()
    for name in names.split()
}
"""name -> module of this directory that has the function which makes it"""


def make_target(name: str, directory: Path) -> Target:
    """Makes the target, with a private directory for its files."""
    return getattr(import_module(f"tests.fuzz.{TARGETS[name]}"), name)(directory)
