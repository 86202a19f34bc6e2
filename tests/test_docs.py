"""The Python examples in the README and in docs/ run as they stand; commands there have the flags they are given."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from gvz import cli, launch

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("**/*.md"))]
RECORDS = sorted((ROOT / "results").glob("**/README.md"))
REPORTS = sorted((ROOT / "results").glob("*/report/report.md"))
EXAMPLES = [
    pytest.param(block, id=f"{page.name}-{number}")
    for page in PAGES
    for number, block in enumerate(re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL))
]


def command_lines(page: Path) -> list[list[str]]:
    """The lines of the page's shell blocks as words, without comments, redirections, and variables set before them."""
    lines = []
    for block in re.findall(r"```bash\n(.*?)```", page.read_text(), flags=re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line.partition(" > ")[0], comments=True)
            while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
                del words[0]
            lines.append(words)
    return [words for words in lines if words]


def headings(page: Path) -> set[str]:
    """What links call the headings of the page."""
    lines = re.findall(r"^#+ (.*)", page.read_text(), flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", line.lower()).replace(" ", "-") for line in lines}


@pytest.mark.engine
@pytest.mark.parametrize("example", EXAMPLES)
def test_an_example_runs(example, tmp_path):
    (tmp_path / "example.py").write_text(example)
    done = subprocess.run(
        [sys.executable, "example.py"], cwd=tmp_path, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.glob("_vizdoom*"))


@pytest.mark.parametrize("page", [*PAGES, *RECORDS], ids=lambda page: f"{page.parent.name}/{page.name}")
def test_commands_have_the_flags_they_are_given(page, tmp_path, monkeypatch):
    """Parsed, not run, in a directory with the agent's file that docs/AGENTS.md writes."""
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "AGENTS.md").read_text(), flags=re.DOTALL)
    (tmp_path / "munchausen.py").write_text(example)
    monkeypatch.chdir(tmp_path)
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
    for words in command_lines(page):
        if words[0] == "make":
            assert words[1] in targets
        train = 2 if words[:2] == ["gvz", "train"] else 3 if words[:3] == ["python", "-m", "gvz.launch"] else None
        if train is not None and "--help" in words:
            with pytest.raises(SystemExit, match=r"^0$"):
                launch.parse(words[train:])
        elif train is not None:
            launch.parse(words[train:])
        elif train is None and words[0] == "gvz":
            command = cli.parse(words[1:])
            if words[1:3] in (["experiment", "plan"], ["experiment", "run"]):
                assert command.action.ask.plan().runs()


def test_the_index_of_records_has_every_folder():
    folders = {path.name for path in (ROOT / "results").iterdir() if path.is_dir()}
    assert set(re.findall(r"\[(\w+)\]\(", (ROOT / "results" / "README.md").read_text())) == folders


@pytest.mark.parametrize(
    "page", [ROOT / "CHANGELOG.md", *PAGES, *RECORDS, *REPORTS], ids=lambda page: str(page.relative_to(ROOT))
)
def test_links_lead_somewhere(page):
    for target, heading in re.findall(r"\]\((?!https?://)([^)#]*)#?([^)]*)\)", page.read_text()):
        file = page.parent / target if target else page
        assert file.exists(), f"{page.name} links to {target}, which is not there"
        assert not heading or heading in headings(file), f"{page.name} links to {target}#{heading}, which is not there"
