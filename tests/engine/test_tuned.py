"""The builder of the tuned engine says what is wrong before it builds; the tuned engine plays the same games."""

import hashlib
import subprocess
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import vizdoom

from gvz.engine.engine import Engine, EngineConfig
from gvz.engine.tuned import build_vizdoom, describe_engine
from gvz.engine.tuned.build_vizdoom import BuildError, apply_patch, check_installed, check_tools, fetch_source

PATCH = """Why it is changed.

diff --git a/src/file.cpp b/src/file.cpp
--- a/src/file.cpp
+++ b/src/file.cpp
@@ -1,3 +1,3 @@
 int main() {
-    return 1;
+    return 0;
 }
"""
RELEASED = {
    (1, False): "3f90b2fdbeb0a5e9",
    (4, False): "ee9425def9ede4f4",
    (33, False): "de907459e551318f",
    (4, True): "71e2aae287f00a33",
}
"""(frame skip, with all buffers) -> what `digest` gives with ViZDoom 1.3.2 as released on PyPI"""


def program(directory: Path, name: str, text: str) -> None:
    (directory / name).write_text(f"#!/bin/sh\n{text}\n")
    (directory / name).chmod(0o755)


def test_a_source_of_other_bytes_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = tmp_path / "vizdoom-1.3.2.tar.gz"
    monkeypatch.setenv(build_vizdoom.SDIST_VARIABLE, str(file))
    with pytest.raises(BuildError, match="there is no such file, want the source distribution of ViZDoom"):
        fetch_source(tmp_path)
    file.write_bytes(b"")
    nothing = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    with pytest.raises(BuildError, match=f"SHA-256 {nothing}, want {build_vizdoom.SHA256}: not the source of ViZDoom"):
        fetch_source(tmp_path)
    monkeypatch.setattr(build_vizdoom, "SHA256", nothing)
    assert fetch_source(tmp_path) == file


def test_another_installed_version_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(build_vizdoom, "VERSION", version("vizdoom").partition("+")[0])
    check_installed()
    monkeypatch.setattr(build_vizdoom, "VERSION", "9.9.9")
    with pytest.raises(
        BuildError, match=r"vizdoom [\d.]+ is installed and the patches fit 9\.9\.9; keep it as released"
    ):
        check_installed()


def test_what_is_missing_is_named_with_the_packages_that_have_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(build_vizdoom, "VERSION", version("vizdoom").partition("+")[0])
    monkeypatch.setenv("PATH", str(tmp_path))
    assert build_vizdoom.main() == 2
    wanted = "error: missing c++, cc, make, git; on Debian or Ubuntu, as root: apt-get install g++ gcc make git\n"
    assert capsys.readouterr().err == wanted
    for name in ("cc", "make", "git"):
        program(tmp_path, name, "exit 0")
    program(tmp_path, "c++", 'read line; case "$line" in *SDL2*) exit 1;; esac')
    with pytest.raises(
        BuildError, match=r"missing SDL2/SDL\.h; on Debian or Ubuntu, as root: apt-get install libsdl2-dev"
    ):
        check_tools()
    program(tmp_path, "c++", "exit 0")
    check_tools()


def test_a_patch_that_does_not_fit_is_refused_and_changes_nothing(tmp_path: Path):
    subprocess.run(
        ["git", "init", "--quiet", tmp_path], check=True
    )  # in which `git apply` would skip what it does not know
    patch, source = tmp_path / "0001-zero.patch", tmp_path / "below" / "vizdoom-1.3.2"
    file = source / "src" / "file.cpp"
    file.parent.mkdir(parents=True)
    patch.write_text(PATCH)
    file.write_text("int main() {\n    return 1;\n}\n")
    apply_patch(patch, source)
    assert file.read_text() == "int main() {\n    return 0;\n}\n"
    message = r"0001-zero\.patch does not fit the source of ViZDoom 1\.3\.2: error: patch failed: src/file\.cpp:1"
    with pytest.raises(BuildError, match=message):
        apply_patch(patch, source)
    assert file.read_text() == "int main() {\n    return 0;\n}\n"


def test_the_patches_say_why_and_set_the_version():
    assert [patch.name[:4] for patch in build_vizdoom.PATCHES] == [
        f"{n:04}" for n in range(1, 1 + len(build_vizdoom.PATCHES))
    ]
    for patch in build_vizdoom.PATCHES:
        why, _, changes = patch.read_bytes().decode().partition("diff --git ")
        assert len(why.splitlines()) >= 3, patch.name
        assert changes.startswith("a/"), patch.name
    suffix = build_vizdoom.TUNED_VERSION.removeprefix(build_vizdoom.VERSION)
    assert f'+set(ViZDoom_VERSION_SUFFIX "{suffix}")' in build_vizdoom.PATCHES[-1].read_text()


def test_an_engine_is_described():
    assert describe_engine("1.3.2") == "1.3.2, as released"
    assert describe_engine("1.3.2+gvz.1") == "1.3.2+gvz.1, tuned"


def digest(frame_skip: int, buffers: bool) -> str:
    """Of everything that 400 random decisions in ViZDoom's own Defend the Center show."""
    config = EngineConfig(
        wad=Path(vizdoom.scenarios_path) / "defend_the_center.wad",
        buttons=("TURN_LEFT", "TURN_RIGHT", "ATTACK"),
        variables=("HEALTH", "AMMO2", "KILLCOUNT", "POSITION_X", "ANGLE", "HITCOUNT", "DAMAGE_TAKEN"),
        depth=buffers,
        labels=buffers,
        automap=buffers,
    )
    engine, rng, found = Engine(config), np.random.default_rng(frame_skip), hashlib.blake2b(digest_size=8)
    try:
        engine.new_episode(frame_skip)
        for number in range(400):
            state = engine.step([float(pressed) for pressed in rng.integers(2, size=3)], frame_skip)
            found.update(engine.screen.tobytes() + np.array([*engine.variables(), engine.tic()]).tobytes())
            if state is None:
                engine.new_episode(number)
            elif buffers:
                assert state.depth_buffer is not None
                assert state.labels_buffer is not None
                assert state.automap_buffer is not None
                found.update(
                    state.depth_buffer.tobytes() + state.labels_buffer.tobytes() + state.automap_buffer.tobytes()
                )
                found.update(
                    repr([(label.object_name, label.x, label.y, label.width) for label in state.labels]).encode()
                )
    finally:
        engine.close()
    return found.hexdigest()


@pytest.mark.engine
@pytest.mark.skipif(not version("vizdoom").startswith("1.3.2"), reason="recorded with ViZDoom 1.3.2")
@pytest.mark.parametrize(("frame_skip", "buffers"), RELEASED)
def test_games_are_those_of_the_released_engine(frame_skip: int, buffers: bool):
    """With the tuned engine installed: nothing changed. `python -m benchmarks.engines equal` compares all tasks."""
    assert digest(frame_skip, buffers) == RELEASED[frame_skip, buffers]
