"""Discovery of modules by file name."""

import sys
from pathlib import Path

import pytest

from gvz.core.errors import ConfigError
from gvz.core.registry import discover, find, named


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


def test_with_a_constant_only_modules_that_set_it_are_imported(package: Path):
    (package / "fox.py").write_text('TITLE: str = "a fox"\n')
    (package / "heavy.py").write_text("import nothing_of_that_name  # TITLE = \n\n\ndef f():\n    TITLE = 1\n")
    assert list(discover("found_by_name", "TITLE")) == ["fox"]


def test_a_module_that_cannot_be_imported_is_not_skipped(package: Path):
    (package / "broken.py").write_text("import nothing_of_that_name\n")
    with pytest.raises(ConfigError, match=r"broken\.py, line 1: ModuleNotFoundError: No module named 'nothing_of_that"):
        discover("found_by_name")
    (package / "broken.py").write_text("raise ImportError('initialization failed')\n")  # as an interrupted library
    with pytest.raises(ImportError, match="initialization failed"):
        discover("found_by_name")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("KIND = (\n", r"hen\.py: SyntaxError: '\(' was never closed"),
        ("\nKIND = dict(1)\n", r"hen\.py, line 2: TypeError: 'int' object is not iterable$"),
        ("from gvz.tasks import parse_task\n\nKIND = parse_task('x')\n", r"hen\.py, line 3: task: got 'x', want"),
        ("KIND = 3\n", r"hen\.py: got KIND with id None, want 'hen', the name of its file"),
    ],
)
def test_what_a_module_raises_is_told_in_one_line(package: Path, text: str, message: str):
    (package / "hen.py").write_text(text)
    with pytest.raises(ConfigError, match=message):
        named("found_by_name", "KIND", "id")


def test_an_error_of_a_module_that_another_one_imports_is_told_with_its_own_line(package: Path):
    (package / "broken.py").write_text("\nKIND = dict(1)\n")
    (package / "ant.py").write_text("from found_by_name.broken import KIND\n")
    with pytest.raises(ConfigError, match=r"broken\.py, line 2: TypeError: 'int' object is not iterable$"):
        discover("found_by_name")


def test_a_module_that_is_no_package_is_refused():
    with pytest.raises(ValueError, match=r"'gvz\.core\.registry' is a module, want a package"):
        discover("gvz.core.registry")


@pytest.mark.usefixtures("package")
def test_a_constant_is_found_by_the_name_of_its_module():
    assert find("found_by_name", "NAME", "zebra", "zoo.animal") == "found_by_name.zebra"


@pytest.mark.usefixtures("package")
def test_a_name_that_no_module_has_is_refused_with_the_nearest():
    with pytest.raises(
        ConfigError, match=r"zoo\.animal: got 'zebar' \(did you mean 'zebra'\?\), want one of ant, zebra"
    ):
        find("found_by_name", "NAME", "zebar", "zoo.animal")


def test_what_a_module_sets_has_the_name_of_its_file(package: Path):
    (package / "fox.py").write_text("from types import SimpleNamespace\n\nKIND = SimpleNamespace(id='fox')\n")
    assert list(named("found_by_name", "KIND", "id")) == ["fox"]
    (package / "hen.py").write_text((package / "fox.py").read_text())
    with pytest.raises(
        ConfigError, match=r"found_by_name: hen\.py: got KIND with id 'fox', want 'hen', the name of its"
    ):
        named("found_by_name", "KIND", "id")


def test_a_module_without_the_constant_is_not_offered(package: Path):
    (package / "helper.py").write_text("")
    with pytest.raises(ConfigError, match=r"got 'helper', want one of ant, zebra, or the path of a file"):
        find("found_by_name", "NAME", "helper", "zoo.animal")


@pytest.mark.usefixtures("package")
def test_a_file_is_found_by_its_path_and_executed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = tmp_path / "mine.py"
    file.write_text("NAME = object()\n")
    monkeypatch.chdir(tmp_path)
    assert find("found_by_name", "NAME", "./mine.py", "zoo.animal") is find("", "NAME", str(file), "zoo.animal")


def test_a_file_that_is_missing_or_does_not_set_the_constant_is_refused(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"zoo\.animal: no file .*/other\.py; give a path from here, or an absolute"):
        find("", "NAME", str(tmp_path / "other.py"), "zoo.animal")
    (tmp_path / "empty.py").write_text("")
    with pytest.raises(ConfigError, match=r"empty\.py does not set NAME, want a line `NAME = \.\.\.` at its end"):
        find("", "NAME", str(tmp_path / "empty.py"), "zoo.animal")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("NAME = (", r"mine\.py: SyntaxError: '\(' was never closed"),
        ("raise ValueError('so')", r"mine\.py, line 1: ValueError: so$"),
        (
            "import no_such_module_anywhere",
            r"mine\.py, line 1: ModuleNotFoundError: No module named 'no_such_module_an",
        ),
        ("import json\n\njson.loads('')", r"mine\.py, line 3: JSONDecodeError: Expecting value: line 1 column 1"),
    ],
)
def test_what_a_file_raises_is_told_in_one_line_and_the_file_can_be_mended(tmp_path: Path, text: str, message: str):
    file = tmp_path / "mine.py"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message):
        find("zoo", "NAME", str(file), "zoo.animal")
    file.write_text("NAME = 1")
    assert find("zoo", "NAME", str(file), "zoo.animal") == 1


@pytest.mark.parametrize("value", ["3", "'text'", "lambda x: x", "lambda x, config, more: x"])
def test_a_constant_that_cannot_be_called_with_its_arguments_is_refused(tmp_path: Path, value: str):
    file = tmp_path / "mine.py"
    file.write_text(f"NAME = {value}\n")
    said = r"agent\.encoder: .*mine\.py sets NAME to .*, want something to call as NAME\(x, config\)"
    with pytest.raises(ConfigError, match=said):
        find("zoo", "NAME", str(file), "agent.encoder", "x", "config")


@pytest.mark.parametrize("value", ["lambda *any: any", "lambda x, config, more=0: x", "divmod", "dict"])
def test_one_that_can_is_taken_also_if_it_does_not_say_its_arguments(tmp_path: Path, value: str):
    file = tmp_path / "mine.py"
    file.write_text(f"NAME = {value}\n")
    assert callable(find("zoo", "NAME", str(file), "agent.encoder", "x", "config"))
