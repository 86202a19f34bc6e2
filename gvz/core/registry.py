"""Discovery by file name: the modules of a package are its registry."""

import inspect
import pkgutil
import re
import sys
import traceback
from functools import cache
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from gvz.core.errors import ConfigError, GvzError, nearest


class OwnFiles(NamedTuple):
    """Python files outside the package that a run is made of. They are executed, so only the user names them."""

    agent: Path | None = None
    """the Python file of a run's agent, if it is in a file of its own: it is executed"""
    encoder: Path | None = None
    """likewise, of its encoder"""


NO_OWN_FILES = OwnFiles()


def discover(package: str, constant: str | None = None) -> dict[str, ModuleType]:
    """Imports every module directly inside `package`, a dotted name such as "gvz.scenarios".

    With `constant`, only modules with a line `constant = ...` are imported: the other ones take time that `--help`
    does not have (numpy, OpenCV).

    Adding a scenario or an agent is adding a file; no list of names is kept by hand. A module that registers
    something says so by a constant that the caller looks for (`SCENARIO`, ...).

    Returns: file name without suffix -> module, in alphabetical order. Sub-packages are left out.

    Raises:
        ConfigError: one of its modules cannot be imported; names the file and its line.
        ImportError: the package cannot be imported, or a library that a module needs, as when it is interrupted.
        ValueError: `package` names a module that is not a package.
    """
    parent = import_module(package)
    if not hasattr(parent, "__path__"):
        raise ValueError(f"discover: {package!r} is a module, want a package")
    names = sorted(info.name for info in pkgutil.iter_modules(parent.__path__) if not info.ispkg)
    if constant is not None:
        names = [name for name in names if _sets(f"{package}.{name}", constant)]
    return {name: _imported(f"{package}.{name}") for name in names}


def named(package: str, constant: str, attribute: str) -> dict[str, Any]:
    """The constants of a package's modules by file name, where each has its file's name as an attribute, too.

    Raises:
        ConfigError: one has another name, or as `discover`.
    """
    found = {name: getattr(module, constant) for name, module in discover(package, constant).items()}
    for name, one in found.items():
        if (got := getattr(one, attribute, None)) != name:
            raise ConfigError(
                f"{package}: {name}.py: got {constant} with {attribute} {got!r}, want {name!r}, the name of its file"
            )
    return found


def find(package: str, constant: str, name: str, field: str, *arguments: str) -> Any:
    """What `name` names: the constant of a module of `package`, or of a Python file anywhere.

    A file is executed once in a process: whoever asks again gets the same object.

    Args:
        package: dotted name, for example "learner.encoders".
        constant: what such a module sets, for example "ENCODER".
        name: a module's file name without suffix, or a path that ends in .py.
        field: the field of the configuration that `name` was read from; errors begin with it.
        *arguments: names of the arguments that the constant is called with, if it is.

    Raises:
        ConfigError: no such module or file, the file cannot be executed, it does not set the constant, or sets it to
            something that does not take the arguments.
    """
    if name.endswith(".py"):
        file = Path(name).resolve()
        if not file.is_file():
            raise ConfigError(f"{field}: no file {file}; give a path from here, or an absolute one")
        module = _module_in_file(file)
        if not hasattr(module, constant):
            raise ConfigError(f"{field}: {file} does not set {constant}, want a line `{constant} = ...` at its end")
        found = getattr(module, constant)
        try:
            if arguments:
                inspect.signature(found).bind(*arguments)
        except TypeError as error:
            raise ConfigError(
                f"{field}: {file} sets {constant} to {found!r}, want something to call as "
                f"{constant}({', '.join(arguments)}) ({error})"
            ) from error
        except ValueError:  # C code, which does not say what it takes
            pass
        return found
    found = {n: getattr(m, constant) for n, m in discover(package, constant).items()}
    if name not in found:
        raise ConfigError(
            f"{field}: got {name!r}{nearest(name, found)}, want one of {', '.join(found)}, or the path of a file, "
            "./mine.py"
        )
    return found[name]


def _sets(module: str, constant: str) -> bool:
    return re.search(rf"^{constant}\b.*=", _file(module).read_text(encoding="utf-8"), re.MULTILINE) is not None


def _file(module: str) -> Path:
    spec = find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin)


def _imported(module: str) -> ModuleType:
    try:
        return import_module(module)
    except Exception as error:
        if isinstance(error, ImportError) and error.name is None:  # a library's own, as when it is interrupted
            raise
        raise failed(error, _file(module)) from error


@cache
def _module_in_file(file: Path) -> ModuleType:
    name = f"file_{file.stem}"
    spec = spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[name] = module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise failed(error, file) from error
    return module


def failed(error: Exception, file: Path) -> ConfigError:
    """The error of a file that was executed: it is the user's own program, and anything may come out of it.

    It names the number of the file's line that `error` came from, if there is one. If the file imported another one of
    its folder, which failed, it names that one.
    """
    frames = traceback.extract_tb(error.__traceback__)
    imported = [f.filename for f in frames if f.name == "<module>" and Path(f.filename).parent == file.parent]
    file = Path(imported[-1]) if imported else file
    lines = [frame.lineno for frame in frames if frame.filename == str(file)]
    where = f"{file}, line {lines[-1]}" if lines else str(file)
    return ConfigError(
        f"{where}: {error}" if isinstance(error, GvzError) else f"{where}: {type(error).__name__}: {error}"
    )
