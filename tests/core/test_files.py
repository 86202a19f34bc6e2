"""Files below a directory, by links, too; and files that are written whole."""

import errno
from pathlib import Path

import av.error
import pytest

from gvz.core import records
from gvz.core.errors import ConfigError
from gvz.core.files import files_below, written_whole
from tests.full_disk import full_disk


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


def test_a_file_appears_when_it_is_whole(tmp_path):
    file = tmp_path / "new" / "report.md"
    for text in ("long before", "now"):
        with written_whole(file) as writing:
            writing.write_text(text)
            assert not file.exists() or file.read_text() == "long before"
        assert file.read_text() == text
    assert list(file.parent.iterdir()) == [file]


def test_a_full_disk_leaves_what_was_there_before(tmp_path):
    file = tmp_path / "report.md"
    file.write_text("before")
    with pytest.raises(OSError, match="File too large") as caught, full_disk(3), written_whole(file) as writing:
        writing.write_text("after")
    assert caught.value.filename == str(file)
    with pytest.raises(OSError, match="no room"), written_whole(file):
        raise av.error.OSError(errno.ENOSPC, "no room")  # whose file name cannot be set
    assert [(path, path.read_text()) for path in tmp_path.iterdir()] == [(file, "before")]


def test_an_interruption_while_it_is_made_leaves_nothing(tmp_path, monkeypatch):
    file, lock = tmp_path / "report.md", records.lock

    def interrupted(opened):
        monkeypatch.setattr(records, "lock", lock)  # once
        lock(opened)
        raise KeyboardInterrupt

    monkeypatch.setattr(records, "lock", interrupted)
    with pytest.raises(KeyboardInterrupt), written_whole(file):
        pass
    assert list(tmp_path.iterdir()) == []
    with written_whole(file) as writing:
        writing.write_text("ours")
        monkeypatch.setattr(records, "lock", interrupted)
        with pytest.raises(KeyboardInterrupt), written_whole(file):
            pass
        assert writing.exists(), "another process writes it"
    assert file.read_text() == "ours"


def test_an_interruption_as_soon_as_it_exists_leaves_nothing(tmp_path, monkeypatch):
    open_file = Path.open

    def interrupted(path, mode):
        monkeypatch.setattr(Path, "open", open_file)  # once
        path.open(mode).close()
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "open", interrupted)
    with pytest.raises(KeyboardInterrupt), written_whole(tmp_path / "report.md"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_one_process_at_a_time_writes_a_file(tmp_path):
    file = tmp_path / "report.md"
    with written_whole(file) as writing:
        writing.write_text("ours")
        with pytest.raises(ConfigError, match=r"report\.md is being written by another process"), written_whole(file):
            pass
    assert file.read_text() == "ours"


def test_what_a_killed_process_left_is_written_over(tmp_path):
    (tmp_path / ".writing-report.md").write_text("half of something long")
    with written_whole(tmp_path / "report.md") as writing:
        assert writing.read_text() == ""
        writing.write_text("whole")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("report.md", "whole")]


def test_a_place_that_cannot_be_written_is_an_error(tmp_path):
    (tmp_path / "file").touch()
    with (
        pytest.raises(ConfigError, match=r"b\.md cannot be written: File exists; give"),
        written_whole(tmp_path / "file" / "b.md"),
    ):
        pass
    with pytest.raises(ConfigError, match="is a directory; want the name of a file"), written_whole(tmp_path):
        pass
