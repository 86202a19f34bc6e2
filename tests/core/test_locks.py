"""Locks of record files, also on a file system that gives a reader no lock of a writer."""

import errno
import fcntl

from gvz.core import records


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
