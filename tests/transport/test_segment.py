"""Shared memory segments: made once, proved on attaching, gone afterwards."""

import os
import secrets
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvz import janitor
from gvz.errors import ResourceError, TransportError
from gvz.transport.segment import HEADER_BYTES, Segment, hash_layout

PAYLOAD, LAYOUT = 1000, hash_layout("test", 1)


@pytest.fixture
def name() -> str:
    return f"gvz-test-{secrets.token_hex(6)}"


@pytest.fixture
def segment(name: str) -> Iterator[Segment]:
    made = Segment.create(name, PAYLOAD, layout_hash=LAYOUT)
    yield made
    made.close()


def file_of(segment: Segment) -> Path:
    assert segment.name is not None
    return Path("/dev/shm") / segment.name


def test_both_sides_see_one_memory(segment: Segment, name: str):
    other = Segment.attach(name, PAYLOAD, layout_hash=LAYOUT)
    segment.payload[7] = 42
    assert other.payload[7] == 42
    assert len(other.payload) == PAYLOAD


def test_new_memory_is_poisoned(segment: Segment):
    assert np.isnan(np.frombuffer(segment.payload, np.float32)).all()


def test_memory_without_a_name_has_no_file():
    before = set(Path("/dev/shm").iterdir())
    segment = Segment.create(None, PAYLOAD, layout_hash=LAYOUT)
    assert len(segment.payload) == PAYLOAD
    assert set(Path("/dev/shm").iterdir()) == before
    segment.close()


def test_a_segment_is_private_to_the_user(segment: Segment):
    assert stat.S_IMODE(file_of(segment).stat().st_mode) == 0o600


def test_closing_removes_the_file_once_and_only_by_the_owner(name: str):
    owner = Segment.create(name, PAYLOAD, layout_hash=LAYOUT)
    other = Segment.attach(name, PAYLOAD, layout_hash=LAYOUT)
    other.close()
    assert file_of(owner).exists()
    owner.close()
    assert not file_of(owner).exists()
    successor = Segment.create(name, PAYLOAD, layout_hash=LAYOUT)
    owner.close()
    assert file_of(successor).exists(), "closing again must not remove what another made since"
    successor.close()


def test_views_outlive_close(segment: Segment):
    view = np.frombuffer(segment.payload, np.uint8)
    segment.close()
    assert view[0] == 0xFF


def test_a_taken_name_is_refused(segment: Segment, name: str):
    with pytest.raises(TransportError, match="the name is taken"):
        Segment.create(name, PAYLOAD, layout_hash=LAYOUT)
    assert file_of(segment).exists()


@pytest.mark.parametrize("bad", ["", "../tmp/x", "a/b", ".hidden", "x\0y"])
def test_a_name_cannot_leave_the_directory(bad: str):
    with pytest.raises(ValueError, match="segment name: got"):
        Segment.create(bad, PAYLOAD, layout_hash=LAYOUT)


def test_no_room_is_an_error_with_advice_and_leaves_nothing(name: str):
    records = set(janitor.runtime_dir().iterdir())
    with pytest.raises(ResourceError, match=r"/dev/shm has no room for \d+ bytes .* --shm-size"):
        Segment.create(name, 2**50, layout_hash=LAYOUT)
    assert not (Path("/dev/shm") / name).exists()
    assert set(janitor.runtime_dir().iterdir()) == records


def test_attach_to_nothing(name: str):
    with pytest.raises(TransportError, match="cannot be attached: No such file"):
        Segment.attach(name, PAYLOAD, layout_hash=LAYOUT)


def test_attach_does_not_follow_a_link(segment: Segment, name: str):
    link = Path("/dev/shm") / f"{name}-link"
    link.symlink_to(file_of(segment))
    try:
        with pytest.raises(TransportError, match="cannot be attached: Too many levels of symbolic links"):
            Segment.attach(link.name, PAYLOAD, layout_hash=LAYOUT)
    finally:
        link.unlink()


@pytest.mark.usefixtures("segment")
def test_attach_wants_our_own_file(name: str, monkeypatch: pytest.MonkeyPatch):
    other_user = os.geteuid() + 1
    monkeypatch.setattr(os, "geteuid", lambda: other_user)
    with pytest.raises(TransportError, match=f"got owner {os.getuid()}, want our own {other_user}"):
        Segment.attach(name, PAYLOAD, layout_hash=LAYOUT)


@pytest.mark.usefixtures("segment")
def test_attach_wants_the_right_size(name: str):
    with pytest.raises(TransportError, match=f"{name}: got 1064 bytes, want 1065"):
        Segment.attach(name, PAYLOAD + 1, layout_hash=LAYOUT)


@pytest.mark.parametrize(("word", "field"), list(enumerate(["magic", "schema", "size", "layout hash"])))
def test_attach_wants_the_right_header(segment: Segment, name: str, word: int, field: str):
    with file_of(segment).open("r+b") as file:
        file.seek(8 * word)
        file.write(b"\x07" * 8)
    with pytest.raises(TransportError, match=f"got {field} 0x707070707070707, want"):
        Segment.attach(name, PAYLOAD, layout_hash=LAYOUT)


@settings(max_examples=200, deadline=None)
@given(header=st.binary(min_size=32, max_size=32))
def test_random_headers_are_refused(header: bytes):
    segment = Segment.create(f"gvz-test-{secrets.token_hex(6)}", PAYLOAD, layout_hash=LAYOUT)
    assert segment.name is not None
    try:
        with file_of(segment).open("r+b") as file:
            right = file.read(32)
            file.seek(0)
            file.write(header)
        if header != right:
            with pytest.raises(TransportError, match="want 0x"):
                Segment.attach(segment.name, PAYLOAD, layout_hash=LAYOUT)
    finally:
        segment.close()


def test_the_next_start_removes_what_a_killed_owner_left(name: str):
    code = f"""
import os, signal
from gvz.transport.segment import Segment
segment = Segment.create({name!r}, 100, layout_hash=1)
os.kill(os.getpid(), signal.SIGKILL)
"""
    assert subprocess.run([sys.executable, "-c", code], timeout=30, check=False).returncode == -9
    path = Path("/dev/shm") / name
    assert path.stat().st_size == 100 + HEADER_BYTES
    janitor.clean_dead_instances()
    assert not path.exists()


def test_layout_hashes_differ_with_their_parts():
    hashes = {hash_layout(*parts) for parts in [(), (1,), (1, 2), (12,), ("1",), ((1, 2),)]}
    assert len(hashes) == 6
    assert all(0 <= h < 2**64 for h in hashes)
