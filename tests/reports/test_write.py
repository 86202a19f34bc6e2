"""The same document in four forms: nothing is lost, nothing is mistaken for something else."""

import csv
import dataclasses
import io

import pytest

from gvz.evaluation.statistics import Estimate
from gvz.reports.document import Block, Document, Figure, Link, Section, Table, missing, ours, theirs, words
from gvz.reports.write import leftovers, to_csv, to_html, to_latex, to_markdown, write_document
from tests.full_disk import full_disk

TABLE = Table(
    id="t",
    caption="100% of <this> & that_",
    columns=("scenario", "level 0"),
    rows=(
        (words("Seek | Kill"), ours(Estimate(value=12.34567, low=10.0, high=14.0), "2 of 3 seeds")),
        (words("Seek | Kill"), theirs(59.69, 2)),
        (words("*<b>*\n`Dodge`"), missing("0 of 3 seeds")),
    ),
    notes=("mind the_gap",),
)


def document(out) -> Document:
    figure = Figure(id="f", caption="A figure", svg=b"<svg xmlns='http://www.w3.org/2000/svg'/>")
    link = Link(text="rows.jsonl", target="../rows.jsonl")
    block = Block(heading="Head", text=("**Bold** <b>",), tables=(TABLE,), figures=(figure,), links=(link,))
    section = Section(id="s", title="Section", blocks=(block,))
    return Document(title="T & T", abstract=("a < b",), warnings=("mind",), sections=(section,), out=out, made_with="x")


def test_csv_has_value_interval_and_note_in_columns_of_their_own():
    rows = list(csv.DictReader(io.StringIO(to_csv(TABLE))))
    first, second, third = rows
    assert (first["level 0"], first["level 0 low"], first["level 0 high"]) == ("12.3457", "10.0000", "14.0000")
    assert first["level 0 note"] == "2 of 3 seeds"
    assert (second["level 0"], second["level 0 low"]) == ("59.6900", "")
    assert (third["level 0"], third["level 0 note"]) == ("", "0 of 3 seeds")


def test_a_column_of_csv_without_any_number_is_four_columns_too():
    table = dataclasses.replace(TABLE, rows=TABLE.rows[2:])
    assert to_csv(table).splitlines()[0] == "scenario,level 0,level 0 low,level 0 high,level 0 note"
    (row,) = csv.DictReader(io.StringIO(to_csv(table)))
    assert (row["level 0"], row["level 0 note"]) == ("", "0 of 3 seeds")


def test_latex_escapes_and_sets_published_numbers_in_italics():
    text = to_latex(TABLE)
    assert r"\caption{100\% of \textless{}this\textgreater{} \& that\_}" in text
    assert r"Seek \textbar{} Kill & 12.3 [10.0, 14.0] (2 of 3 seeds) \\" in text
    assert r"Seek \textbar{} Kill & \textit{59.69} \\" in text
    assert r"\par mind the\_gap" in text
    assert text.count(r"\\") == 4


def test_markdown_has_tables_figures_and_links(tmp_path):
    text = to_markdown(document(tmp_path))
    assert r"| Seek \| Kill | 12.3 [10.0, 14.0] (2 of 3 seeds) |" in text
    assert r"| Seek \| Kill | *59.69* |" in text
    assert r"| \*\<b>\* \`Dodge\` | - (0 of 3 seeds) |" in text
    assert "![A figure](figures/f.png)" in text
    assert "[rows.jsonl](../rows.jsonl)" in text
    assert "> **Mind:** mind" in text


def test_the_page_escapes_what_it_is_given_and_holds_its_figures(tmp_path):
    page = to_html(document(tmp_path))
    assert "<h1>T &amp; T</h1>" in page
    assert "<strong>Bold</strong> &lt;b&gt;" in page
    assert '<td class="theirs">59.69</td>' in page
    assert '<td class="missing">-<small>0 of 3 seeds</small></td>' in page
    assert '<img src="data:image/svg+xml;base64,PHN2' in page
    assert '<a href="#s">Section</a>' in page


def test_everything_is_written(tmp_path):
    written = write_document(document(tmp_path))
    assert [file.relative_to(tmp_path).as_posix() for file in written] == [
        "report.html",
        "report.md",
        "tables/t.csv",
        "tables/t.tex",
    ]
    assert all(file.stat().st_size for file in written)


def test_on_a_full_disk_the_report_of_before_stays_whole(tmp_path):
    before = {file: file.read_text() for file in write_document(document(tmp_path))}
    longer = dataclasses.replace(document(tmp_path), title="T" * 10_000)
    with full_disk(10_000), pytest.raises(OSError, match="File too large"):
        write_document(longer)
    assert {file: file.read_text() for file in tmp_path.rglob("*.*")} == before


def test_a_table_whose_rows_have_not_its_columns_is_a_mistake():
    with pytest.raises(AssertionError, match="table t: rows and columns differ"):
        Table(id="t", caption="", columns=("a", "b"), rows=((words("1"),),))


def test_tables_and_figures_of_an_earlier_report_are_found(tmp_path):
    (tmp_path / "figures").mkdir()
    write_document(document(tmp_path))
    assert leftovers(document(tmp_path)) == []
    others = [tmp_path / "tables" / "joint.csv", tmp_path / "figures" / "joint.png"]
    for file in (*others, tmp_path / "figures" / "notes.txt"):
        file.touch()
    assert leftovers(document(tmp_path)) == others
