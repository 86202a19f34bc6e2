"""`gvz completion`: completion of commands and flags in a shell."""

import contextlib
import io
from dataclasses import dataclass
from typing import Literal

import tyro

_CHANGES = {
    "for completion in completions:": "for completion in completions or ['__TYRO_COMPLETE_FILES__']:",
    'COMPREPLY=($(compgen -f -- "$cur"))': "COMPREPLY=()",  # bash itself does more: / behind a directory, quotes
    "complete -F": "complete -o default -F",
}
"""of tyro's scripts, which complete paths as the values of flags alone; with these, where nothing else fits"""


@dataclass(frozen=True, kw_only=True)
class Completion:
    """Print a script that completes commands, flags and paths in your shell.

    bash: gvz completion bash > ~/.local/share/bash-completion/completions/gvz

    zsh: gvz completion zsh > DIR/_gvz, with DIR in $fpath

    fish: gvz completion fish > ~/.config/fish/completions/gvz.fish
    """

    shell: tyro.conf.Positional[Literal["bash", "zsh", "fish"]]
    """which one"""

    def run(self) -> int:
        """Prints it, with the flags of `gvz train` among the others."""
        from gvz.cli import parse
        from gvz.launch import Launch

        with contextlib.redirect_stdout(io.StringIO()) as printed, contextlib.suppress(SystemExit):
            parse(["--tyro-write-completion", self.shell, "-"], train=Launch)
        script = printed.getvalue()
        for old, new in _CHANGES.items():
            script = script.replace(old, new)
        print(script, end="")
        return 0


COMMAND = Completion
