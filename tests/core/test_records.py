"""Record files: who may write to them. What is read of them is in tests/run/test_rundir.py."""

import io
import signal

import pytest

from gvz.core import records


def test_a_record_file_that_was_replaced_before_it_was_locked_is_not_written_to(tmp_path):
    writer = records.Writer(tmp_path / "evaluation.jsonl")
    writer.append({"episode": 0})
    (tmp_path / "new").write_text("")
    (tmp_path / "new").replace(tmp_path / "evaluation.jsonl")
    assert not writer.lock()
    writer.close()


def test_a_row_is_written_once_where_a_signal_comes_when_it_has_just_been_written(tmp_path):
    class Interrupted(io.FileIO):
        def write(self, data):
            written = super().write(data)
            signal.raise_signal(signals.pop())
            return written

    signals = [signal.SIGINT]

    writer = records.Writer(tmp_path / "evaluation.jsonl")
    writer._file = Interrupted(tmp_path / "evaluation.jsonl", "ab")
    with pytest.raises(KeyboardInterrupt):
        writer.append({"episode": 0})
    assert writer.waiting_bytes == 0
    writer.close()
    assert [row["episode"] for row in records.read(tmp_path / "evaluation.jsonl")[0]] == [0]
