"""Writes a document: one self-contained HTML page, Markdown, and every table as CSV and LaTeX."""

import base64
import csv
import io
import re
from collections.abc import Iterable
from pathlib import Path

import jinja2
from markupsafe import Markup, escape

from gvz.core.files import written_whole
from gvz.reports.document import Cell, Document, Figure, Table

_TEMPLATES = Path(__file__).parent / "templates"

_LATEX = {
    "\\": r"\textbackslash{}",
    **{c: f"\\{c}" for c in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
}


def write_document(document: Document) -> list[Path]:
    """Writes all of it into `document.out`: report.html, report.md, tables/. The figures are there already.

    Returns: the files.
    """
    tables = [table for section in document.sections for block in section.blocks for table in block.tables]
    assert len({table.id for table in tables}) == len(tables), "two tables of one id"
    files = {"report.html": to_html(document), "report.md": to_markdown(document)}
    for table in tables:
        files[f"tables/{table.id}.csv"] = to_csv(table)
        files[f"tables/{table.id}.tex"] = to_latex(table)
    (document.out / "tables").mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        with written_whole(document.out / name) as writing:
            writing.write_text(text)
    return [document.out / name for name in files]


def leftovers(document: Document) -> list[Path]:
    """Tables and figures in `document.out` that are not this document's: those of an earlier one, with other agents."""
    blocks = [block for section in document.sections for block in section.blocks]
    own = {"tables": {t.id for b in blocks for t in b.tables}, "figures": {f.id for b in blocks for f in b.figures}}
    return [
        file
        for folder, suffixes in (("tables", (".csv", ".tex")), ("figures", (".svg", ".pdf", ".png")))
        for file in sorted((document.out / folder).iterdir())
        if file.suffix in suffixes and file.stem not in own[folder]
    ]


def to_html(document: Document) -> str:
    """The page. Nothing in it is loaded from elsewhere."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["data_uri"] = _data_uri
    environment.filters["strong"] = _strong
    environment.filters["breakable"] = _breakable
    return environment.get_template("report.html.j2").render(document=document)


def _data_uri(figure: Figure) -> str:
    return f"data:image/svg+xml;base64,{base64.b64encode(figure.svg).decode()}"


def _strong(text: str) -> Markup:
    """**bold** as in Markdown; everything else is escaped."""
    escaped = str(escape(text))
    return Markup(re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", escaped))


def _breakable(text: str) -> Markup:
    """Names of tasks, agents, runs and settings may take several lines; everything is escaped."""
    return Markup(re.sub(r"[_+/]|\.(?=[a-z])", r"\g<0><wbr>", str(escape(text))))


def to_markdown(document: Document) -> str:
    """The report as text, with the figures by name."""
    parts = [f"# {document.title}", *document.abstract]
    parts += [f"> **Mind:** {text}" for text in document.warnings]
    for section in document.sections:
        parts.append(f"## {section.title}")
        for block in section.blocks:
            parts += [f"### {block.heading}"] if block.heading else []
            parts += block.text
            for table in block.tables:
                parts += [f"**{table.caption}**", _markdown_table(table), *(f"*{note}*" for note in table.notes)]
            parts += [f"![{figure.caption}](figures/{figure.id}.png)" for figure in block.figures]
            parts += ["\n".join(f"- [{link.text}]({link.target})" for link in block.links)] if block.links else []
    return "\n\n".join([*parts, document.made_with]) + "\n"


def _markdown_table(table: Table) -> str:
    def line(cells: Iterable[str]) -> str:
        return f"| {' | '.join(cells)} |"

    def text(cell: Cell) -> str:
        shown = f"*{_markdown(cell.text)}*" if cell.kind == "theirs" else _markdown(cell.text)
        return f"{shown} ({cell.note})" if cell.note else shown

    rows = [line(map(text, row)) for row in table.rows]
    return "\n".join([line(map(_markdown, table.columns)), "|" + "---|" * len(table.columns), *rows])


def _markdown(text: str) -> str:
    """A name as it is: a player's may hold what would be a tag, another row or another column."""
    return re.sub(r"([\\`*<|])", r"\\\1", " ".join(text.split()))


def to_csv(table: Table) -> str:
    """The table for programs: a column with numbers is four, the value, the ends of its interval, and the note.

    A missing cell is empty; a published number has no interval.
    """
    columns = [[row[n] for row in table.rows] for n in range(len(table.columns))]
    numeric = [any(cell.estimate for cell in cells) or {c.kind for c in cells} == {"missing"} for cells in columns]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    head = []
    for name, is_number in zip(table.columns, numeric, strict=True):
        head += [name, f"{name} low", f"{name} high", f"{name} note"] if is_number else [name]
    writer.writerow(head)
    for row in table.rows:
        line: list[str] = []
        for cell, is_number in zip(row, numeric, strict=True):
            line += _csv_numbers(cell) if is_number else [cell.text]
        writer.writerow(line)
    return out.getvalue()


def _csv_numbers(cell: Cell) -> list[str]:
    if cell.estimate is None:
        return ["", "", "", cell.note]
    e = cell.estimate
    interval = ["", ""] if cell.kind == "theirs" else [f"{e.low:.4f}", f"{e.high:.4f}"]
    return [f"{e.value:.4f}", *interval, cell.note]


def to_latex(table: Table) -> str:
    """A table environment for the package booktabs; published numbers in italics."""

    def text(cell: Cell) -> str:
        shown = _latex(cell.text)
        shown = f"\\textit{{{shown}}}" if cell.kind == "theirs" else shown
        return f"{shown} ({_latex(cell.note)})" if cell.note else shown

    lines = [
        "\\begin{table}",
        "\\centering\\small",
        f"\\caption{{{_latex(table.caption)}}}",
        f"\\label{{tab:{table.id}}}",
        f"\\begin{{tabular}}{{{'l' * len(table.columns)}}}",
        "\\toprule",
        " & ".join(map(_latex, table.columns)) + " \\\\",
        "\\midrule",
        *(" & ".join(map(text, row)) + " \\\\" for row in table.rows),
        "\\bottomrule",
        "\\end{tabular}",
        *(f"\\par {_latex(note)}" for note in table.notes),
        "\\end{table}",
    ]
    return "\n".join(lines) + "\n"


def _latex(text: str) -> str:
    return "".join(_LATEX.get(c, c) for c in text)
