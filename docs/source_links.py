"""Hook of mkdocs: pages link to files of the repository, as on a code host; the site gets a copy of each as text."""

import re
from os.path import relpath
from pathlib import Path

from mkdocs.structure.files import File

ROOT = Path(__file__).parent.parent


def on_page_markdown(markdown, *, page, config, files):
    """Links that leave docs/ lead to the copy; those to directories become plain text."""

    def replace(link):
        text, target = link.groups()
        file = (Path(page.file.abs_src_path).parent / target).resolve()
        if file.is_relative_to(config.docs_dir) or not file.exists():  # mkdocs says so itself
            return link[0]
        if file.is_dir():
            return text
        uri = f"source/{file.relative_to(ROOT)}.txt"
        if uri not in files.src_uris:
            files.append(File.generated(config, uri, abs_src_path=str(file)))
        return f"[{text}]({relpath(uri, Path(page.file.src_uri).parent)})"

    return re.sub(r"\[([^\]]+)\]\((\.\.?/[^)#\s]+)(?:#[^)\s]*)?\)", replace, markdown)
