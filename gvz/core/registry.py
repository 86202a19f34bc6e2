"""Discovery by file name: the modules of a package are its registry."""

import pkgutil
from importlib import import_module
from types import ModuleType


def discover(package: str) -> dict[str, ModuleType]:
    """Imports every module directly inside `package`.

    Adding a scenario or an agent is adding a file; no list of names is kept by hand. A module that registers
    something says so by a constant that the caller looks for (`SCENARIO`, ...).

    Args:
        package: dotted name, for example "gvz.scenarios".

    Returns:
        File name without suffix -> module, in alphabetical order. Sub-packages are left out.

    Raises:
        ImportError: the package or one of its modules cannot be imported.
        ValueError: `package` names a module that is not a package.
    """
    parent = import_module(package)
    if not hasattr(parent, "__path__"):
        raise ValueError(f"discover: {package!r} is a module, want a package")
    names = sorted(info.name for info in pkgutil.iter_modules(parent.__path__) if not info.ispkg)
    return {name: import_module(f"{package}.{name}") for name in names}
