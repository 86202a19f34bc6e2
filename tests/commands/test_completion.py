"""gvz completion: the shells themselves complete by what it prints."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gvz.core.registry import discover

# what bash does at Tab: the words, the cursor's, and the function that `complete` named for them
ASK = """
source {script}
COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
COMP_LINE="${{COMP_WORDS[*]}}"; COMP_POINT=${{#COMP_LINE}}
function=$(complete -p gvz | sed 's/.*-F \\([^ ]*\\).*/\\1/')
$function gvz "${{COMP_WORDS[COMP_CWORD]}}" "${{COMP_WORDS[COMP_CWORD - 1]}}"
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


def script(shell: str) -> str:
    command = [sys.executable, "-m", "gvz.cli", "completion", shell]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert done.stderr == ""
    return done.stdout


@pytest.fixture(scope="module")
def bash(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("completion") / "gvz"
    file.write_text(script("bash"))
    return file


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        ("gvz ev", {"evaluate"}),
        ("gvz experiment st", {"status"}),
        ("gvz evaluate --epi", {"--episodes"}),
        ("gvz train --learner.total", {"--learner.total-updates"}),
        ("gvz evaluate --player scr", {"scripted"}),
    ],
)
def test_bash_completes(bash, words, wanted):
    ask = ASK.format(script=bash, words=" ".join(f"'{word}'" for word in words.split()))
    done = subprocess.run(["bash", "-c", ask], capture_output=True, text=True, timeout=60, check=False)
    assert done.stderr == ""
    assert set(done.stdout.split()) == wanted


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_get_a_script_that_names_every_command(shell, tmp_path):
    text = script(shell)
    assert all(name in text for name in discover("gvz.commands"))
    if shutil.which(shell):
        file = tmp_path / "script"
        file.write_text(text)
        subprocess.run([shell, "-n", str(file)], check=True, timeout=60)
