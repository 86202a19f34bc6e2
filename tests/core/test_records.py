"""Record files: who may write to them. What is read of them is in tests/run/test_rundir.py."""

from gvz.core import records


def test_a_record_file_that_was_replaced_before_it_was_locked_is_not_written_to(tmp_path):
    writer = records.Writer(tmp_path / "evaluation.jsonl")
    writer.append({"episode": 0})
    (tmp_path / "new").write_text("")
    (tmp_path / "new").replace(tmp_path / "evaluation.jsonl")
    assert not writer.lock()
    writer.close()
