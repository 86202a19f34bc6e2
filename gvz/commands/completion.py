"""`gvz completion`: completion of commands and flags in a shell."""

from dataclasses import dataclass
from typing import Literal

import tyro


@dataclass(frozen=True, kw_only=True)
class Completion:
    """Print a script that completes commands and flags in your shell.

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

        parse(["--tyro-write-completion", self.shell, "-"], train=Launch)
        return 0


COMMAND = Completion
