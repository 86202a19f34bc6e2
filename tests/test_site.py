"""The documentation as a site: it builds without a warning, and every page and linked source file is there."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}  # an advertisement of another program
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=280, check=False)
    assert done.returncode == 0, done.stderr
    return out


def test_every_page_of_docs_is_a_page_of_the_site(site):
    for page in (ROOT / "docs").rglob("*.md"):
        name = page.relative_to(ROOT / "docs").with_suffix("")
        assert (site / ("" if name.name == "index" else name) / "index.html").exists(), name


def test_links_to_source_files_lead_to_their_text(site):
    page = (site / "BENCHMARK" / "index.html").read_text()
    assert 'href="../source/gvz/scenarios/seek_and_kill.py.txt"' in page
    copy = site / "source" / "gvz" / "scenarios" / "seek_and_kill.py.txt"
    assert copy.read_text() == (ROOT / "gvz" / "scenarios" / "seek_and_kill.py").read_text()


def test_the_reference_has_the_docstrings(site):
    page = (site / "reference" / "benchmark" / "index.html").read_text()
    assert "One game of a task." in page
    assert 'id="gvz.env.DoomEnv.reset"' in page
    assert "_begin" not in page.partition("<details")[0]
