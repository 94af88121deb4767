"""What MkDocs makes besides docs/: pages of the files outside it, the API reference, and links between them.

The same Markdown is read in the repository and on the site. In the repository a link from `docs/data.md` to
`../ddgrasp/layout.py` leads to the file; here it leads to the module's place in the reference.
"""

import ast
import posixpath
import re
import tomllib
from functools import cache
from pathlib import Path, PurePosixPath

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
OUTSIDE = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "pretrained/README.md": "pretrained.md",
    "pretrained/ddg/README.md": "pretrained_ddg.md",
    "pretrained/d435/README.md": "pretrained_d435.md",
    "pretrained/table2/README.md": "pretrained_table2.md",
}
"""Pages that lie outside docs/: file in the repository, page of the site."""
_SOURCE = {page: file for file, page in OUTSIDE.items()}
_LINK = re.compile(r"(?P<text>!?\[(?:`[^`]*`|[^\]`])*\])\((?P<target>[^)\s]+)\)")
_FENCE = re.compile(r"^(```.*?^```[^\S\n]*$)", re.MULTILINE | re.DOTALL)


@cache
def packages() -> dict[str, list[str]]:
    """Dotted names of every package that is installed, and of what has a docstring in it, the package too."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    found = {}
    for package in project["tool"]["setuptools"]["packages"]:
        files = sorted((ROOT / package.replace(".", "/")).glob("*.py"))
        names = [file.stem for file in files if file.stem != "__init__"]
        found[package] = [package] * bool(_docstring(package)) + [f"{package}.{name}" for name in names]
    return found


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages that are no files of docs/, and puts the reference into the navigation."""
    for file, page in OUTSIDE.items():
        files.append(File.generated(config, page, content=(ROOT / file).read_text()))
    for package, modules in packages().items():
        text = "\n\n".join([f"# {package}", *(f"::: {module}" for module in modules)])
        files.append(File.generated(config, _reference(package), content=text + "\n"))
    files.append(File.generated(config, "reference/index.md", content=_index()))
    assert config.nav is not None
    (reference,) = (entry["Reference"] for entry in config.nav if "Reference" in entry)
    reference.append({"API": [reference.pop(), *({name: _reference(name)} for name in packages())]})
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """The page with links that lead where the site has what the repository has in the file named."""
    at = page.file.src_uri
    source = _SOURCE.get(at, f"docs/{at}")
    parts = _FENCE.split(markdown)
    for index in range(0, len(parts), 2):  # what lies between fenced blocks
        parts[index] = _LINK.sub(lambda match: _led(match, source, at, config), parts[index])
    return "".join(parts)


def _led(match: re.Match[str], source: str, at: str, config: MkDocsConfig) -> str:
    """The link of `match` in the repository's file `source`, as it must read on the site's page `at`."""
    text, target = match["text"], match["target"]
    path, _, anchor = target.partition("#")
    if not path or re.match(r"[a-z]+:", target):
        return match.group()
    file = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
    if (place := _place(file, anchor)) is not None:
        return f"{text}({posixpath.relpath(place, posixpath.dirname(at) or '.')})"
    if config.repo_url:
        return f"{text}({config.repo_url.rstrip('/')}/blob/main/{file})"
    return text[1:-1]


def _place(file: str, anchor: str) -> str | None:
    """Where the site has the repository's `file`, None where it has it not."""
    if file in OUTSIDE:
        return OUTSIDE[file] + (f"#{anchor}" if anchor else "")
    if file.startswith("docs/"):
        return file.removeprefix("docs/") + (f"#{anchor}" if anchor else "")
    if f"{file}/README.md" in OUTSIDE:
        return OUTSIDE[f"{file}/README.md"]
    dotted = ".".join(PurePosixPath(file).with_suffix("").parts)
    for package, modules in packages().items():
        if file.endswith(".py") and dotted in modules:
            return f"{_reference(package)}#{dotted}"
        if dotted == package:
            return _reference(package)
    return None


def _reference(package: str) -> str:
    return f"reference/{package}.md"


def _index() -> str:
    """The list of packages with the first line of each one's docstring."""
    tree = (ROOT / "CONTRIBUTING.md").read_text().split("```")[1]
    said = dict(re.findall(r"^(\w+)/ +(.*)$", tree, re.MULTILINE))
    lines = []
    for package in packages():
        what = _docstring(package).partition("\n")[0] or said.get(package, "")
        lines.append(f"* [`{package}`]({package}.md)" + (f": {what}" if what else ""))
    return "# API\n\nMade from the docstrings. Imports go down this list only.\n\n" + "\n".join(lines) + "\n"


def _docstring(package: str) -> str:
    tree = ast.parse((ROOT / package.replace(".", "/") / "__init__.py").read_text())
    return ast.get_docstring(tree) or ""
