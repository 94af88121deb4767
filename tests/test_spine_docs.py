"""What a reader relies on: docstrings, annotations, short files, links that lead somewhere, a true tree."""

import ast
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from ddgrasp.stages import ON_REQUEST, STAGES

ROOT = Path(__file__).parents[1]
MAX_LINES = 400
PAGES = (
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    *sorted(str(page.relative_to(ROOT)) for page in (ROOT / "pretrained").rglob("README.md")),
    *sorted(str(page.relative_to(ROOT)) for page in (ROOT / "docs").rglob("*.md")),
)
Function = ast.FunctionDef | ast.AsyncFunctionDef


def _packages() -> list[str]:
    """Packages in the order of the tree in CONTRIBUTING.md."""
    return [name for name in _tree() if (ROOT / name / "__init__.py").exists() and name != "benchmarks"]


def _tree() -> list[str]:
    block = (ROOT / "CONTRIBUTING.md").read_text().split("## The tree is the data flow")[1].split("```")[1]
    return re.findall(r"^(\w+)/", block, re.MULTILINE)


def _links(page: str) -> list[str]:
    """Links and pictures of a page that lead into the repository; one into the page itself has its name."""
    text = re.sub(r"^```.*?^```", "", (ROOT / page).read_text(), flags=re.MULTILINE | re.DOTALL)
    links = re.findall(r"\]\((?!https?:)([^)\s]+)\)", text)
    return [Path(page).name + link if link[0] == "#" else link for link in links]


def _anchors(page: Path) -> set[str]:
    """Those that a renderer makes of the headings."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def _files() -> Iterator[Path]:
    for package in _packages():
        yield from sorted((ROOT / package).rglob("*.py"))


def _name(file: Path, node: ast.AST, name: str) -> str:
    return f"{file.relative_to(ROOT)}:{getattr(node, 'lineno', 1)} {name}"


def _public(file: Path) -> Iterator[tuple[Function, bool]]:
    """(function, whether it is a method) of every public function, and of public classes' `__init__`."""

    def visit(node: ast.AST, in_class: bool) -> Iterator[tuple[Function, bool]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, Function):
                if not child.name.startswith("_") or child.name == "__init__":
                    yield child, in_class
            elif isinstance(child, ast.ClassDef):
                if not child.name.startswith("_"):
                    yield from visit(child, True)
            else:
                yield from visit(child, in_class)

    yield from visit(ast.parse(file.read_text()), False)


def _unannotated(function: Function, is_method: bool) -> bool:
    args = function.args
    given = [*args.posonlyargs, *args.args]
    if is_method and not any(ast.unparse(d) == "staticmethod" for d in function.decorator_list):
        given = given[1:]
    given += [*args.kwonlyargs, *(arg for arg in (args.vararg, args.kwarg) if arg)]
    returns = function.returns is not None or function.name == "__init__"
    return not returns or any(arg.annotation is None for arg in given)


def test_every_public_function_and_class_says_what_it_does():
    missing = []
    for file in _files():
        tree = ast.parse(file.read_text())
        if tree.body and not ast.get_docstring(tree):
            missing.append(_name(file, tree, "module"))
        missing += [
            _name(file, f, f.name)
            for f, _ in _public(file)
            if f.name != "__init__" and not ast.get_docstring(f)
        ]
        classes = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name[0] != "_"]
        missing += [_name(file, node, node.name) for node in classes if not ast.get_docstring(node)]
    assert missing == []


def test_every_public_function_is_annotated():
    assert [
        _name(file, f, f.name) for file in _files() for f, method in _public(file) if _unannotated(f, method)
    ] == []


def test_no_docstring_begins_with_of():
    assert [
        _name(file, node, node.value[:40])
        for file in _files()
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith("Of ")
    ] == []


def test_no_file_is_long():
    lengths = {file.relative_to(ROOT): len(file.read_text().splitlines()) for file in _files()}
    assert {file: length for file, length in lengths.items() if length > MAX_LINES} == {}


def test_the_tree_in_contributing_is_the_tree():
    folders = {file.parent.relative_to(ROOT).parts[0] for file in ROOT.glob("*/__init__.py")}
    assert folders <= set(_tree())
    assert {name for name in _tree() if not (ROOT / name).is_dir()} == set()


def test_the_flow_picture_names_the_folder_of_every_stage():
    picture = (ROOT / "docs" / "flow.svg").read_text()
    for stage in STAGES:
        assert f">{stage.module.split('.')[0]}/<" in picture, stage.name


def test_every_stage_of_the_table_has_its_run():
    for stage in (*STAGES, *ON_REQUEST):
        tree = ast.parse((ROOT / f"{stage.module.replace('.', '/')}.py").read_text())
        runs = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "run"]
        assert [ast.unparse(run.args) for run in runs] == ["job: Job"], stage.name


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_files_and_code_names_files_that_exist(page):
    text = (ROOT / page).read_text()
    places = {link: (ROOT / page).parent / link.split("#")[0] for link in _links(page)}
    assert [link for link, place in places.items() if not place.exists()] == []
    outside = [link for link, place in places.items() if not place.resolve().is_relative_to(ROOT.resolve())]
    assert outside == []
    top = {path.name for path in ROOT.iterdir()}
    named = {name for name in re.findall(r"`([\w/]+\.(?:py|md|sh))`", text) if name.split("/")[0] in top}
    named = {name for name in named if "mine" not in name}  # CONTRIBUTING's examples
    named.discard("tests/__init__.py")  # said not to exist
    assert [name for name in sorted(named) if not (ROOT / name).exists()] == []


def test_every_page_of_the_docs_can_be_reached_from_the_readme():
    reached, new = set(), {ROOT / "README.md"}
    while new:
        page = new.pop()
        reached.add(page)
        pages = {(page.parent / link.split("#")[0]).resolve() for link in _links(str(page.relative_to(ROOT)))}
        new |= {other for other in pages if other.suffix == ".md"} - reached
    assert {ROOT / page for page in PAGES} - reached == set()


@pytest.mark.parametrize("page", PAGES)
def test_links_into_a_page_lead_to_a_heading(page):
    targets = [link.split("#") for link in _links(page) if "#" in link]
    assert [f"{file}#{anchor}" for file, anchor in targets
            if anchor not in _anchors((ROOT / page).parent / file)] == []  # fmt: skip


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


def test_the_film_at_the_top_of_the_readme_is_small_and_moves():
    import cv2

    (film,) = [link for link in _links("README.md") if link.endswith(".webp")]
    assert (ROOT / "README.md").read_text().index(film) < 500
    assert (ROOT / film).stat().st_size < 3e6
    ok, pictures = cv2.imreadanimation(str(ROOT / film))
    assert ok and len(pictures.frames) > 100


def test_every_result_in_the_readme_links_to_where_it_was_measured():
    results = (ROOT / "README.md").read_text().split("## Results")[1].split("\n## ")[0]
    lines = results.splitlines()
    rows = [line for line, below in pairwise([*lines, ""]) if line.startswith("| ") and below[:4] != "|---"]
    assert rows
    assert [row for row in rows if not re.search(r"\]\(docs/\w+\.md(#[\w-]+)?\) \|$", row)] == []


def _documented(docstring: str) -> set[str]:
    """Names in the section Args of a docstring."""
    (section,) = re.findall(r"^Args:\n((?:[ \t]+.*\n?|\n)*)", docstring + "\n", re.MULTILINE) or [""]
    lines = [line for line in section.splitlines() if line.strip()]
    indent = min((len(line) - len(line.lstrip()) for line in lines), default=0)
    return {line.strip().split(":")[0] for line in lines if len(line) - len(line.lstrip()) == indent}


def test_docstrings_describe_parameters_that_exist_one_by_one():
    """What the API reference (docs/) demands; "a, b: two numbers" is no parameter."""
    wrong = []
    for file in _files():
        for function, _ in _public(file):
            given = {node.arg for node in ast.walk(function.args) if isinstance(node, ast.arg)}
            unknown = _documented(ast.get_docstring(function) or "") - given
            wrong += [_name(file, function, name) for name in sorted(unknown)]
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ClassDef):
                unknown = _documented(ast.get_docstring(node) or "") - _taken_by(node)
                wrong += [_name(file, node, name) for name in sorted(unknown)]
    assert wrong == []


def _taken_by(node: ast.ClassDef) -> set[str]:
    """Arguments of a class's __init__, its own or a dataclass's."""
    fields = {child.target for child in node.body if isinstance(child, ast.AnnAssign)}
    made = [child.args for child in node.body if isinstance(child, Function) and child.name == "__init__"]
    arguments = {
        argument.arg for args in made for argument in ast.walk(args) if isinstance(argument, ast.arg)
    }
    return arguments | {field.id for field in fields if isinstance(field, ast.Name)}


def test_the_site_shows_every_page_and_every_package():
    pages = {page.removeprefix("docs/") for page in PAGES if page.startswith("docs/")}
    shown = set(re.findall(r": ([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    assert pages <= shown
    made = shown - pages
    assert made == set(re.findall(r'": "([\w/]+\.md)"', (ROOT / "docs" / "_site" / "pages.py").read_text()))


def test_docstrings_and_comments_name_files_that_exist():
    packages = "|".join(_packages())
    named = re.compile(rf"(?<![\w./])((?:{packages}|tests|benchmarks|docs)/[\w/]+\.(?:py|md))")
    found = [(file, name) for file in _files() for name in named.findall(file.read_text())]
    assert len(found) > 50
    missing = [f"{file.relative_to(ROOT)}: {name}" for file, name in found if not (ROOT / name).exists()]
    assert missing == []
