"""A file that an engine cannot start on is found out in a sub-process, with the engine's own words."""

import shutil
import sys
from pathlib import Path

import pytest
import vizdoom

from gvz.core import janitor
from gvz.core.errors import EngineError
from gvz.engine.probe import ensure_loads, probe_wad
from gvz.wad.lumps import Lump, read_wad, write_wad

pytestmark = pytest.mark.engine

STOCK_WAD = Path(vizdoom.scenarios_path) / "defend_the_center.wad"


def with_decorate(path: Path, text: str) -> Path:
    """The stock map with other class definitions."""
    others = [lump for lump in read_wad(STOCK_WAD.read_bytes()) if lump.name != "DECORATE"]
    path.write_bytes(write_wad([Lump("DECORATE", text.encode()), *others]))
    return path


def test_a_good_file_loads_and_its_log_is_returned():
    log = probe_wad(STOCK_WAD)
    assert f"adding {STOCK_WAD}" in log
    assert log.count("map01 - ") == 2, "one map at the start, one for the episode"


def test_a_file_that_crashes_the_engine_is_an_error_with_its_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    tmp_path.chmod(0o700)
    monkeypatch.setenv("GVZ_RUNTIME_DIR", str(tmp_path))
    wad = with_decorate(tmp_path / "bad.wad", "ACTOR Foo : NoSuchParent { }")
    with pytest.raises(EngineError, match=r"bad\.wad: the engine crashed .*Script error(.|\n)*NoSuchParent"):
        probe_wad(wad)
    assert not list(janitor.runtime_dir().glob("*.json")), "the crashed client's engine was not cleared away"


def test_files_of_the_working_directory_are_not_executed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Python would import the user's random.py instead of its own."""
    (tmp_path / "random.py").write_text("raise SystemExit('the one of the working directory')")
    monkeypatch.chdir(tmp_path)
    assert "adding" in probe_wad(STOCK_WAD)


def test_gvz_is_found_where_the_program_found_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """In a notebook, sys.path may be the only one that knows the place."""
    (tmp_path / "sitecustomize.py").write_text(f"open({str(tmp_path / 'found')!r}, 'w').close()")
    monkeypatch.syspath_prepend(str(tmp_path))
    probe_wad(STOCK_WAD)
    assert (tmp_path / "found").exists()


@pytest.mark.parametrize(
    ("decorate", "message"),
    [
        ("ACTOR Foo\n{\n  Health\n}", r'DECORATE" line 4:; SC_GetNumber: Bad numeric constant "}"'),
        ("ACTOR Foo : Health\n{\n  Inventory.Amont 3\n}", r'line 3:; "inventory.amont" is an unknown actor property'),
    ],
)
def test_a_syntax_error_in_decorate_is_told_in_the_engines_words(tmp_path: Path, decorate: str, message: str):
    with pytest.raises(EngineError, match=rf'bad\.wad: the engine crashed .*: Script error, "bad\.wad:.*{message}'):
        probe_wad(with_decorate(tmp_path / "bad.wad", decorate))


def test_a_file_that_is_loaded_with_complaints_is_an_error(tmp_path: Path):
    decorate = next(lump.data for lump in read_wad(STOCK_WAD.read_bytes()) if lump.name == "DECORATE").decode()
    wad = with_decorate(tmp_path / "odd.wad", decorate + "\nACTOR Foo { }\nACTOR Foo { }\n")
    with pytest.raises(EngineError, match="cannot be played: Tried to register class 'Foo' more than once"):
        probe_wad(wad)


def test_the_place_of_a_file_is_no_complaint(tmp_path: Path):
    place = tmp_path / "unknown" / "no map not found"
    place.mkdir(parents=True)
    assert "adding" in probe_wad(Path(shutil.copy(STOCK_WAD, place)))


def test_a_file_without_the_map_is_an_error(tmp_path: Path):
    wad = tmp_path / "other.wad"
    names = {"MAP01": "MAP77"}
    lumps = [Lump(names.get(lump.name, lump.name), lump.data) for lump in read_wad(STOCK_WAD.read_bytes())]
    wad.write_bytes(write_wad(lumps))
    with pytest.raises(EngineError, match=r"other\.wad: no map MAP01, only DECORATE, MAP77"):
        probe_wad(wad)


@pytest.mark.parametrize(("content", "message"), [(b"nonsense", "want b'IWAD' or b'PWAD'"), (None, "No such file")])
def test_what_is_not_a_wad_is_an_error(tmp_path: Path, content: bytes | None, message: str):
    wad = tmp_path / "x.wad"
    if content is not None:
        wad.write_bytes(content * 10)
    with pytest.raises(EngineError, match=f"not a scenario file: .*{message}"):
        probe_wad(wad)


def test_an_engine_that_takes_too_long_is_an_error():
    with pytest.raises(EngineError, match=r"not loaded within 0\.2 s"):
        probe_wad(STOCK_WAD, timeout_s=0.2)


def test_a_file_is_probed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    wad = tmp_path / "map.wad"
    wad.write_bytes(STOCK_WAD.read_bytes())
    ensure_loads(wad)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "no-python"))  # a second probe could not start
    ensure_loads(wad)


def test_a_failure_is_not_remembered(tmp_path: Path):
    wad = with_decorate(tmp_path / "map.wad", "ACTOR Foo : NoSuchParent { }")
    for _ in range(2):
        with pytest.raises(EngineError, match="NoSuchParent"):
            ensure_loads(wad)
