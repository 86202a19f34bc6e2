"""gvz completion: the shells themselves complete by what it prints."""

import re
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
        ("gvz evaluate --pl", {"--player"}),  # whose help has two lines
    ],
)
def test_bash_completes(bash, words, wanted):
    ask = ASK.format(script=bash, words=" ".join(f"'{word}'" for word in words.split()))
    done = subprocess.run(["bash", "-c", ask], capture_output=True, text=True, timeout=60, check=False)
    assert done.stderr == ""
    assert set(done.stdout.split()) == wanted


@pytest.mark.parametrize("words", ["evaluate run", "evaluate --player idle --out run", "report r zoo:p run"])
def test_bash_itself_completes_paths(bash, words):
    """It does with `-o default`, and only if the function has found nothing: not even an empty completion."""
    asked = ASK.format(script=bash, words=f"gvz {words}")
    ask = f'{asked}\ncomplete -p gvz\necho "${{#COMPREPLY[@]}} found"'
    done = subprocess.run(["bash", "-c", ask], capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.split("\n")[-3:] == ["complete -o default -F _tyro_gvz gvz", "0 found", ""]


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_complete_paths_where_nothing_else_fits(shell):
    """Their scripts ask Python for the completions, and complete paths if it says so."""
    begin, end = {"zsh": ("<< 'PYTHON_EOF'\n", "\nPYTHON_EOF"), "fish": ('set -l pycode "', '"\n    set')}[shell]
    program = script(shell).partition(begin)[2].partition(end)[0]
    if shell == "fish":
        program = re.sub(r'\\([\\"$])', r"\1", program)
    ask = [sys.executable, "-", "gvz", "evaluate"]
    for word, wanted in (("run", ["__TYRO_COMPLETE_FILES__"]), ("--pl", ["--player"])):
        done = subprocess.run([*ask, word, "2"], input=program, capture_output=True, text=True, timeout=60, check=True)
        assert [line.partition("\t")[0] for line in done.stdout.splitlines()] == wanted


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_get_a_script_that_names_every_command(shell, tmp_path):
    text = script(shell)
    assert all(name in text for name in discover("gvz.commands"))
    if shutil.which(shell):
        file = tmp_path / "script"
        file.write_text(text)
        subprocess.run([shell, "-n", str(file)], check=True, timeout=60)
