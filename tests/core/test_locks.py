"""Locks of record files, also on a file system that gives a reader no lock of a writer."""

import errno
import fcntl
import os

import pytest

from gvz.core import records
from gvz.core.errors import ResourceError


def test_a_lock_is_seen_by_who_may_only_read(tmp_path, monkeypatch):
    """NFS 4: an exclusive lock needs a file that is open for writing."""
    real = fcntl.flock

    def flock(file, how: int) -> None:
        if how & fcntl.LOCK_EX and not fcntl.fcntl(file, fcntl.F_GETFL) & 3:  # O_RDONLY
            raise OSError(errno.EBADF, "Bad file descriptor")
        real(file, how)

    monkeypatch.setattr(fcntl, "flock", flock)
    path = tmp_path / "log"
    assert not records.is_locked(path)
    with path.open("ab") as file:
        assert records.lock(file)
        assert records.is_locked(path)
    assert not records.is_locked(path)


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS])
def test_a_file_system_without_locks_is_an_error_that_names_the_file(tmp_path, monkeypatch, number):
    def flock(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", flock)
    said = (
        rf"{tmp_path}/log cannot be locked: {os.strerror(number)}; want a file system with locks, .* mount it so that"
    )
    with (tmp_path / "log").open("ab") as file, pytest.raises(ResourceError, match=said):
        records.lock(file)
    with pytest.raises(ResourceError, match=said):
        records.is_locked(tmp_path / "log")
