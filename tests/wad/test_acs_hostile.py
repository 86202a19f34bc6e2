"""The ACS compiler under garbage: whatever the text, the answer is an object file or an AcsError with its place."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvz.core.errors import AcsError
from gvz.wad.acs import compile_acs
from gvz.wad.acs.lexer import tokenize
from gvz.wad.lumps import read_maps, read_wad
from gvz.wad.stock import scenario_wad

SOURCES = [
    read_maps(read_wad(scenario_wad(f"{name}.wad")))["MAP01"]["SCRIPTS"].decode("latin-1")
    for name in ("defend_the_center", "defend_the_line", "basic_notifications", "predict_position")
]
WORDS = sorted(
    {token.text for source in SOURCES for token in tokenize(source) if token.text}
    | set("switch case default do until continue break return terminate #define static DISCONNECT".split())
    | {"0x7fffffff", "2147483647", "0.0", '"', '"x"', "'", "/*", "*/", "//", "\n", "\\", "??", "<<="}
)


def compile_or_refuse(source: str) -> bool:
    """Whether `source` compiles. Anything but bytes and AcsError is the failure these tests look for."""
    try:
        behavior = compile_acs(source, actor_classes=["MarineChainsawVzd"])
    except AcsError as error:
        refusal = error
    else:
        assert behavior.startswith(b"ACS\0")
        return True
    lines = source.split("\n")
    assert 1 <= refusal.line <= len(lines)
    assert 1 <= refusal.column <= len(lines[refusal.line - 1]) + 1
    return False


@settings(max_examples=300)
@given(st.text(max_size=200))
def test_any_text_compiles_or_is_refused(source: str):
    compile_or_refuse(source)


@settings(max_examples=300)
@given(st.lists(st.sampled_from(WORDS), max_size=60))
def test_any_words_compile_or_are_refused(words: list[str]):
    compile_or_refuse(" ".join(words))


@settings(max_examples=300)
@given(st.lists(st.sampled_from(WORDS), max_size=40))
def test_any_statements_compile_or_are_refused(words: list[str]):
    compile_or_refuse("global int 0:reward; int newid; script 1 OPEN { int i; " + " ".join(words) + " }")


@pytest.mark.parametrize("seed", range(8))
def test_damaged_sources_compile_or_are_refused(seed: int):
    rng = random.Random(seed)
    outcomes = set()
    for _ in range(60):
        source = rng.choice(SOURCES)
        for _ in range(rng.randint(1, 3)):
            start = rng.randrange(len(source))
            end = min(len(source), start + rng.choice((0, 1, 1, 5, 40, 400)))
            put = rng.choice(("", rng.choice(WORDS), chr(rng.randrange(256)), source[start:end] * 2))
            source = source[:start] + put + source[end:]
        outcomes.add(compile_or_refuse(source))
    assert outcomes == {True, False}  # the damage is neither always harmless nor always fatal


def test_a_source_cut_off_anywhere_compiles_or_is_refused():
    source = SOURCES[0]
    compiled = [end for end in range(len(source)) if compile_or_refuse(source[:end])]
    # Whole up to the end of a declaration, and nowhere else.
    assert all(source[:end].rstrip() == "" or source[:end].rstrip()[-1] in ';}"/' for end in compiled)
