"""Files below a directory, by links, too."""

from pathlib import Path

import pytest

from gvz.core.files import files_below


@pytest.fixture
def here(tmp_path: Path) -> Path:
    """A directory with a file in `runs/a` and `runs/b`."""
    for name in ("a", "b"):
        (tmp_path / "here" / "runs" / name).mkdir(parents=True)
        (tmp_path / "here" / "runs" / name / "config.json").touch()
    return tmp_path / "here"


def found(directory: Path, pattern: str = "*.json") -> list[str]:
    return [str(file.relative_to(directory)) for file in files_below(directory, pattern)]


BOTH = ["runs/a/config.json", "runs/b/config.json"]


def test_files_are_sorted_and_chosen_by_name(here):
    (here / "runs" / "a" / "other.txt").touch()
    (here / "runs" / "config.json").mkdir()
    assert found(here) == BOTH
    assert found(here, "config.json") == BOTH
    assert found(here, "other*") == ["runs/a/other.txt"]


def test_linked_directories_are_searched_under_their_own_names(here, tmp_path):
    (here / "runs" / "b").rename(tmp_path / "elsewhere")
    (here / "runs" / "b").symlink_to(tmp_path / "elsewhere")
    assert found(here) == BOTH, "one run is linked"
    (here / "runs").rename(tmp_path / "scratch")
    (here / "runs").symlink_to(tmp_path / "scratch")
    assert found(here) == BOTH, "all are, and one of them again"
    (tmp_path / "link").symlink_to(here)
    assert found(tmp_path / "link") == BOTH


def test_links_that_lead_back_end_the_search(here, tmp_path):
    (here / "runs" / "a" / "self").symlink_to(".")
    (here / "runs" / "a" / "top").symlink_to(here)
    (here / "runs" / "a" / "outside").symlink_to(tmp_path)
    (here / "runs" / "b" / "other").symlink_to(here / "runs" / "a")
    (here / "runs" / "b" / "nowhere").symlink_to(here / "nothing")
    (tmp_path / "config.json").touch()
    assert found(here) == BOTH


def test_a_second_name_of_a_run_does_not_take_its_place(here, tmp_path):
    (here / "best").symlink_to(here / "runs" / "a")
    assert found(here) == BOTH
    (here / "runs").rename(tmp_path / "scratch")
    (here / "runs").symlink_to(tmp_path / "scratch")
    assert found(here) == BOTH
    (tmp_path / "scratch" / "a").rename(tmp_path / "elsewhere")
    (here / "runs" / "a").symlink_to(tmp_path / "elsewhere")
    assert found(here) == BOTH
    (here / "best").unlink()
    (here / "best").symlink_to("runs/a")
    assert found(here) == BOTH
    (here / "best").unlink()
    (here / "best").symlink_to(tmp_path / "scratch" / "b")
    assert found(here) == BOTH
