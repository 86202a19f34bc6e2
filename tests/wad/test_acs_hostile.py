"""The ACS compiler under programs that are almost right; tests/fuzz has damaged ones."""

from hypothesis import given, settings
from hypothesis import strategies as st

from gvz.wad.acs.lexer import tokenize
from gvz.wad.lumps import read_maps, read_wad
from gvz.wad.stock import scenario_wad
from tests.fuzz.maps import compiles

SOURCES = [
    read_maps(read_wad(scenario_wad(f"{name}.wad")))["MAP01"]["SCRIPTS"].decode("latin-1")
    for name in ("defend_the_center", "defend_the_line", "basic_notifications", "predict_position")
]
WORDS = sorted(
    {token.text for source in SOURCES for token in tokenize(source) if token.text}
    | set("switch case default do until continue break return terminate #define static DISCONNECT".split())
    | {"0x7fffffff", "2147483647", "0.0", '"', '"x"', "'", "/*", "*/", "//", "\n", "\\", "??", "<<="}
)


@settings(max_examples=300)
@given(st.lists(st.sampled_from(WORDS), max_size=40))
def test_any_statements_compile_or_are_refused(words: list[str]):
    compiles("global int 0:reward; int newid; script 1 OPEN { int i; " + " ".join(words) + " }")


def test_a_source_cut_off_anywhere_compiles_or_is_refused():
    source = SOURCES[0]
    compiled = [end for end in range(len(source)) if compiles(source[:end])]
    # Whole up to the end of a declaration, and nowhere else.
    assert all(source[:end].rstrip() == "" or source[:end].rstrip()[-1] in ';}"/' for end in compiled)
