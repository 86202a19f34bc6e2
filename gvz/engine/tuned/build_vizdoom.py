"""Builds the tuned ViZDoom: the source distribution of one version, and the patches beside this file.

It is pip's build backend for this directory (PEP 517): `pip install ./gvz/engine/tuned`. As a program, which is what
`make engine` runs, it first checks that the build can succeed, shows pip's progress, and reports in one line what went
wrong. Standard library only, because pip runs it where nothing of ours is installed.
"""

import hashlib
import importlib
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections import deque
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

VERSION = "1.3.2"
"""of ViZDoom: the patches fit this one"""
SHA256 = "10eef8c2a65111c774ed1311438d95949719d1ac41dc1f7010936dc544f70de2"
"""of its source distribution on PyPI"""
REVISION = 1
"""of our patches; increased when one of them changes"""
TUNED_VERSION = f"{VERSION}+gvz.{REVISION}"
HERE = Path(__file__).resolve().parent
PATCHES = sorted((HERE / "patches").glob("*.patch"))
SDIST_VARIABLE = "GVZ_VIZDOOM_SDIST"
"""absolute path of a file that is taken instead of a download"""
_HEADERS = {
    "boost/interprocess/ipc/message_queue.hpp": "libboost-dev",
    "boost/filesystem.hpp": "libboost-filesystem-dev",
    "boost/thread.hpp": "libboost-thread-dev",
    "boost/date_time/posix_time/posix_time.hpp": "libboost-date-time-dev",
    "boost/chrono.hpp": "libboost-chrono-dev",
    "boost/regex.hpp": "libboost-regex-dev",
    "boost/iostreams/stream.hpp": "libboost-iostreams-dev",
    "SDL2/SDL.h": "libsdl2-dev",
    "AL/al.h": "libopenal-dev",
}
"""what the build includes -> the package of Debian and Ubuntu that has it"""
_PROGRAMS = {"c++": "g++", "cc": "gcc", "make": "make", "git": "git"}
"""what the build runs -> the package that has it; pip brings CMake"""


class BuildError(Exception):
    """The tuned engine cannot be built; the message says why and what to do."""


def build_wheel(
    wheel_directory: str, config_settings: dict[str, Any] | None = None, metadata_directory: str | None = None
) -> str:
    """PEP 517: builds the wheel into the directory and returns its file name.

    Raises:
        BuildError: a program or library is missing, the source is another, or a patch does not fit.
    """
    check_tools()
    with tempfile.TemporaryDirectory(prefix="gvz-vizdoom-") as directory:
        source = unpack(fetch_source(Path(directory)), Path(directory))
        for patch in PATCHES:
            apply_patch(patch, source)
        os.chdir(source)
        backend = importlib.import_module("setuptools.build_meta")
        name: str = backend.build_wheel(wheel_directory, config_settings, metadata_directory)
        os.chdir(HERE)
    return name


def prepare_metadata_for_build_wheel(
    metadata_directory: str,
    config_settings: dict[str, Any] | None = None,  # noqa: ARG001 pip passes it by position
) -> str:
    """PEP 517: the metadata of the released version with our version number, so that pip need not build for it."""
    with tempfile.TemporaryDirectory(prefix="gvz-vizdoom-") as directory:
        source = unpack(fetch_source(Path(directory)), Path(directory))
        text = (source / "PKG-INFO").read_text()
    info = Path(metadata_directory) / f"vizdoom-{TUNED_VERSION}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(re.sub(r"^Version: .*$", f"Version: {TUNED_VERSION}", text, count=1, flags=re.M))
    (info / "WHEEL").write_text("Wheel-Version: 1.0\nGenerator: gvz\nRoot-Is-Purelib: false\nTag: py3-none-any\n")
    return info.name


def check_tools() -> None:
    """Raises BuildError, with the command that installs them, if programs or headers are missing."""
    missing = {name: package for name, package in _PROGRAMS.items() if shutil.which(name) is None}
    if "c++" not in missing:
        missing |= {name: package for name, package in _HEADERS.items() if not _has_header(name)}
    if missing:
        packages = " ".join(dict.fromkeys(missing.values()))
        raise BuildError(f"missing {', '.join(missing)}; on Debian or Ubuntu, as root: apt-get install {packages}")


def _has_header(name: str) -> bool:
    command = ["c++", "-x", "c++", "-E", "-o", os.devnull, "-"]
    return subprocess.run(command, input=f"#include <{name}>\n".encode(), capture_output=True).returncode == 0


def fetch_source(directory: Path) -> Path:
    """The source distribution: the file that GVZ_VIZDOOM_SDIST names, or one that pip downloads into the directory.

    Raises:
        BuildError: there is none, or its SHA-256 is another.
    """
    given = os.environ.get(SDIST_VARIABLE)
    if given:
        file = Path(given)
    else:
        file = directory / f"vizdoom-{VERSION}.tar.gz"
        download = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
        options = ["--no-build-isolation", "--no-binary", "vizdoom", "--dest", str(directory), f"vizdoom=={VERSION}"]
        done = subprocess.run([*download, *options], capture_output=True, text=True, stdin=subprocess.DEVNULL)
        if done.returncode:
            last = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise BuildError(f"pip download vizdoom=={VERSION}: {last}; or name the file with {SDIST_VARIABLE}")
    if not file.is_file():
        raise BuildError(f"{file}: there is no such file, want the source distribution of ViZDoom {VERSION}")
    found = hashlib.sha256(file.read_bytes()).hexdigest()
    if found != SHA256:
        raise BuildError(f"{file}: SHA-256 {found}, want {SHA256}: not the source of ViZDoom {VERSION} on PyPI")
    return file


def unpack(archive: Path, directory: Path) -> Path:
    """Unpacks the source distribution and returns its root."""
    with tarfile.open(archive) as tar:
        tar.extractall(directory, filter="data")
    return directory / f"vizdoom-{VERSION}"


def apply_patch(patch: Path, source: Path) -> None:
    """Changes the source as the patch says.

    Raises:
        BuildError: a hunk of it does not fit; nothing was changed then.
    """
    # a repository that the directory happens to be in must not change what paths mean
    environment = {**os.environ, "GIT_CEILING_DIRECTORIES": str(source.parent)}
    command = ["git", "apply", "--whitespace=nowarn", str(patch)]
    done = subprocess.run(command, cwd=source, env=environment, capture_output=True, text=True)
    if done.returncode:
        first = (done.stderr.strip().splitlines() or ["no message"])[0]
        raise BuildError(f"{patch.name} does not fit the source of ViZDoom {VERSION}: {first}")


def check_installed() -> None:
    """Raises BuildError if another version of ViZDoom is installed than the one that the patches fit."""
    try:
        installed = version("vizdoom").partition("+")[0]
    except PackageNotFoundError:
        return
    if installed != VERSION:
        raise BuildError(f"vizdoom {installed} is installed and the patches fit {VERSION}; keep it as released")


def install() -> None:
    """Has pip build and install the tuned engine in place of the released one, and shows how far it is.

    Raises:
        BuildError: as build_wheel; or pip failed.
    """
    check_installed()
    check_tools()
    print(f"building vizdoom {TUNED_VERSION}: some five minutes on two cores", flush=True)
    options = ["--disable-pip-version-check", "--verbose", "--no-deps"]
    command = [sys.executable, "-m", "pip", "install", *options, str(HERE)]
    last: deque[str] = deque(maxlen=30)
    shown = 0
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as pip:
        assert pip.stdout is not None
        for line in pip.stdout:
            last.append(line)
            percent = re.match(r"\s*\[\s*(\d+)%\]", line)
            if percent and int(percent[1]) >= shown + 10:
                shown = int(percent[1])
                print(f"  {shown}%", flush=True)
    if pip.returncode:
        sys.stderr.writelines(last)
        named = [line.partition("BuildError: ")[2].strip() for line in last if "BuildError: " in line]
        raise BuildError(named[-1] if named else f"pip ended with code {pip.returncode}; its last lines are above")
    print(f"installed vizdoom {TUNED_VERSION}; back: pip install --force-reinstall --no-deps vizdoom=={VERSION}")


def main() -> int:
    """`python -m gvz.engine.tuned.build_vizdoom`; returns the exit code: 0 installed, 2 not possible."""
    try:
        install()
    except BuildError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
