"""Shared memory segments: anonymous, proved on attaching, freed by the kernel whoever dies."""

import contextlib
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gvz.core.errors import ResourceError, TransportError
from gvz.transport.segment import Segment, hash_layout
from tests.full_disk import full_disk

PAYLOAD, LAYOUT = 1000, hash_layout("test", 1)


@pytest.fixture
def segment() -> Iterator[Segment]:
    made = Segment.create("gvz-test", PAYLOAD, layout_hash=LAYOUT)
    yield made
    made.close()


def attach(segment: Segment, payload_bytes: int = PAYLOAD) -> Segment:
    return Segment.attach(segment.descriptor, payload_bytes, layout_hash=LAYOUT)


def descriptors() -> list[str]:
    """What this process's file descriptors stand for."""
    found = []
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # the descriptor by which this directory is read
            found.append(str(link.readlink()))
    return sorted(found)


def test_both_sides_see_one_memory(segment: Segment):
    other = attach(segment)
    segment.payload[7] = 42
    assert other.payload[7] == 42
    assert len(other.payload) == PAYLOAD
    assert other.name == segment.name == "gvz-test"


def test_a_process_that_is_given_the_descriptor_sees_it_too(segment: Segment):
    code = f"""
import os, sys
from gvz.transport.segment import Segment
descriptor = int(sys.argv[1])
other = Segment.attach(descriptor, {PAYLOAD}, layout_hash={LAYOUT})
os.close(descriptor)
other.payload[3] = 17
"""
    command = [sys.executable, "-c", code, str(segment.descriptor)]
    subprocess.run(command, pass_fds=[segment.descriptor], timeout=60, check=True)
    assert segment.payload[3] == 17


def test_other_processes_do_not_inherit_it(segment: Segment):
    code = "import os, sys; os.fstat(int(sys.argv[1]))"
    command = [sys.executable, "-c", code, str(segment.descriptor)]
    done = subprocess.run(command, close_fds=False, capture_output=True, text=True, timeout=60, check=False)
    assert "Bad file descriptor" in done.stderr


def test_new_memory_is_poisoned(segment: Segment):
    assert np.isnan(np.frombuffer(segment.payload, np.float32)).all()


def test_it_is_no_file_of_dev_shm():
    segment = Segment.create("gvz-test", PAYLOAD, layout_hash=LAYOUT)
    assert str(Path(f"/proc/self/fd/{segment.descriptor}").readlink()).startswith("/memfd:gvz-test")
    segment.close()


def test_closing_frees_the_memory_and_can_be_repeated():
    def held() -> list[str]:
        maps = Path("/proc/self/maps").read_text().splitlines()
        return [line for line in (*maps, *descriptors()) if "gvz-test-closing" in line]

    segment = Segment.create("gvz-test-closing", PAYLOAD, layout_hash=LAYOUT)
    other = attach(segment)
    assert held()
    segment.close()
    segment.close()
    assert other.payload[0] == 0xFF, "who has attached it keeps it"
    other.close()
    assert held() == []


def test_views_outlive_close(segment: Segment):
    view = np.frombuffer(segment.payload, np.uint8)
    segment.close()
    assert view[0] == 0xFF


def test_its_size_cannot_be_changed(segment: Segment):
    """A file that shrinks under a mapping ends whoever touches it by SIGBUS."""
    for size in (0, 2 * PAYLOAD):
        with pytest.raises(PermissionError):
            os.ftruncate(segment.descriptor, size)


def test_memory_that_cannot_be_had_is_an_error_with_advice_and_leaves_no_descriptor():
    before = descriptors()
    with pytest.raises(ResourceError, match=r"got \d+ bytes of available memory, want \d+; lower actors"):
        Segment.create("gvz-test", 2**50, layout_hash=LAYOUT)
    assert descriptors() == before


def test_memory_that_the_kernel_refuses_is_an_error_and_leaves_no_descriptor():
    before = descriptors()
    with full_disk(0), pytest.raises(ResourceError, match="gvz-test: the kernel refused 1064 bytes: File too large"):
        Segment.create("gvz-test", PAYLOAD, layout_hash=LAYOUT)
    assert descriptors() == before


def test_too_many_open_files_are_an_error_with_advice():
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, limits[1]))
    try:
        with pytest.raises(ResourceError, match=r"Too many open files; raise the limit \(`ulimit -n`\), or lower"):
            Segment.create("gvz-test", 4096, layout_hash=LAYOUT)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_attach_to_no_descriptor():
    with pytest.raises(TransportError, match="segment of descriptor 987654: cannot be mapped: Bad file descriptor"):
        Segment.attach(987654, PAYLOAD, layout_hash=LAYOUT)


def test_attach_to_another_file_names_it(tmp_path: Path):
    with (tmp_path / "other").open("w+b") as file, pytest.raises(TransportError, match="segment other: got 0 bytes"):
        Segment.attach(file.fileno(), PAYLOAD, layout_hash=LAYOUT)


def test_attach_wants_the_right_size(segment: Segment):
    with pytest.raises(TransportError, match="segment gvz-test: got 1064 bytes, want 1065"):
        attach(segment, PAYLOAD + 1)


@pytest.mark.parametrize(("word", "field"), list(enumerate(["magic", "schema", "size", "layout hash"])))
def test_attach_wants_the_right_header(segment: Segment, word: int, field: str):
    os.pwrite(segment.descriptor, b"\x07" * 8, 8 * word)
    with pytest.raises(TransportError, match=f"got {field} 0x707070707070707, want"):
        attach(segment)


def test_layout_hashes_differ_with_their_parts():
    hashes = {hash_layout(*parts) for parts in [(), (1,), (1, 2), (12,), ("1",), ((1, 2),)]}
    assert len(hashes) == 6
    assert all(0 <= h < 2**64 for h in hashes)
