"""What a report consists of, as data: sections of text, tables and figures.

`gvz.reports.write` writes a document as HTML, Markdown, CSV and LaTeX.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gvz.evaluation.statistics import Estimate

Kind = Literal["text", "ours", "theirs", "missing"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Cell:
    """One cell of a table."""

    kind: Kind = "text"
    text: str
    estimate: Estimate | None = None
    """the numbers behind the text"""
    note: str = ""
    """small print: how many of the required seeds there are"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Table:
    """A table with its caption. Every row has a cell for each column."""

    id: str
    """names its files and its anchor"""
    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        assert all(len(row) == len(self.columns) for row in self.rows), f"table {self.id}: rows and columns differ"


@dataclass(frozen=True, kw_only=True, slots=True)
class Figure:
    """A picture with its caption; its files are `figures/<id>.svg`, `.pdf` and `.png`."""

    id: str
    caption: str
    svg: bytes
    wide: bool = False
    """takes a row of its own"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Link:
    """A file beside the report."""

    text: str
    target: str
    """relative to the report"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Block:
    """Part of a section: a heading with what stands under it, in this order."""

    heading: str = ""
    text: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()
    links: tuple[Link, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class Section:
    """A chapter of the report."""

    id: str
    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Document:
    """The whole report."""

    title: str
    abstract: tuple[str, ...]
    """what was run, with which budget, who has more points"""
    warnings: tuple[str, ...]
    """what the numbers cannot show"""
    sections: tuple[Section, ...]
    out: Path
    """the directory it is written to"""
    made_with: str
    """the versions of what made it"""


def count(number: int, what: str) -> str:
    """ "1 run", "2 runs"."""
    return f"{number:,} {what}" if number == 1 else f"{number:,} {what}s"


def words(text: str) -> Cell:
    """A cell of text."""
    return Cell(text=text)


def theirs(value: float, digits: int = 1) -> Cell:
    """A number that others published."""
    return Cell(kind="theirs", text=f"{value:.{digits}f}", estimate=Estimate(value=value, low=value, high=value))


def missing(note: str = "") -> Cell:
    """A number that is not there."""
    return Cell(kind="missing", text="-", note=note)


def ours(estimate: Estimate, note: str = "", digits: int = 1) -> Cell:
    """A number of ours with its interval."""
    text = f"{estimate.value:.{digits}f} [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"
    return Cell(kind="ours", text=text, estimate=estimate, note=note)
