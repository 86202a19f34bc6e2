"""One target under libFuzzer: `python -m tests.fuzz.child TARGET DIRECTORY [libFuzzer's flags]`.

Our packages are instrumented when the target imports them, so that the fuzzer sees which branches an input takes.
"""

import sys
from pathlib import Path

import atheris

from tests.fuzz.target import attempt
from tests.fuzz.targets import make_target

MAX_WORD = 64
"""bytes of a word that libFuzzer takes"""


def main() -> None:
    """Fuzzes until libFuzzer ends the process."""
    name, directory, *flags = sys.argv[1:]
    home = Path(directory)
    files, corpus, words = home / "files", home / "corpus", home / "words"
    for folder in (files, corpus):
        folder.mkdir(parents=True)
    with atheris.instrument_imports(include=["gvz", "actors", "learner"]):
        target = make_target(name, files)
    examples = [*target.seeds, *target.once_broken]
    for number, data in enumerate(examples):
        (corpus / f"example-{number}").write_bytes(data)
    words.write_text("".join(map(quoted, target.words)))

    def try_one(data: bytes) -> None:
        attempt(target, data)

    max_len = max(target.max_bytes, *map(len, examples))
    atheris.Setup([sys.argv[0], *flags, f"-max_len={max_len}", f"-dict={words}", str(corpus)], try_one)
    atheris.Fuzz()


def quoted(word: bytes) -> str:
    """A line of libFuzzer's dictionary; nothing for a word longer than it takes."""
    letters = "".join(f"\\x{byte:02x}" for byte in word)
    return f'"{letters}"\n' if 0 < len(word) <= MAX_WORD else ""


if __name__ == "__main__":
    main()
