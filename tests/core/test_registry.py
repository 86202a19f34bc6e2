"""Discovery of modules by file name."""

import sys
from pathlib import Path

import pytest

from gvz.core.registry import discover


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "found_by_name"
    (folder / "inner").mkdir(parents=True)
    for file in ("__init__.py", "inner/__init__.py", "zebra.py", "ant.py"):
        (folder / file).write_text("NAME = __name__\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield folder
    for name in [name for name in sys.modules if name.startswith("found_by_name")]:
        del sys.modules[name]


@pytest.mark.usefixtures("package")
def test_every_module_is_found_under_its_file_name_in_alphabetical_order():
    found = discover("found_by_name")
    assert list(found) == ["ant", "zebra"]
    assert found["ant"].NAME == "found_by_name.ant"


def test_a_new_file_is_found_without_being_listed_anywhere(package: Path):
    (package / "mole.py").write_text("")
    assert "mole" in discover("found_by_name")


def test_a_module_that_cannot_be_imported_is_not_skipped(package: Path):
    (package / "broken.py").write_text("import nothing_of_that_name\n")
    with pytest.raises(ImportError, match="nothing_of_that_name"):
        discover("found_by_name")


def test_a_module_that_is_no_package_is_refused():
    with pytest.raises(ValueError, match=r"'gvz\.core\.registry' is a module, want a package"):
        discover("gvz.core.registry")
