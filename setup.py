"""What pyproject.toml cannot say: in a wheel all packages of this repository lie in one, `ddgrasp`.

Here they lie side by side (`export/`, `app/`, ...) under names that other projects take as well. In a wheel
they are `ddgrasp/export/`, `ddgrasp/app/`, ..., and their text is as here but for the names of modules:
`from export import graph` is `from ddgrasp.export import graph`. The pretrained files are in
`ddgrasp/pretrained/`. An editable installation is the repository as it is.
"""

import ast
import re
import shutil
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.build_py import build_py

NAMESPACE = "ddgrasp"
DATA = ("pretrained",)
"""Folders without code that a wheel takes along."""
MODULE_ARGUMENTS = ("import_module", "Stage")
"""Functions whose strings are names of modules, where they look like one."""


def rehomed(text: str, packages: Iterable[str]) -> str:
    """A module's source in which every name of a module in the top-level `packages` begins with NAMESPACE.

    Changed are imports, what hangs on a plain `import rig.world` (in quotes too), strings given to
    MODULE_ARGUMENTS, strings after "-m", and entry points, "export.stage:run".
    """
    lines = text.encode().splitlines(keepends=True)
    for line, column in sorted(set(_places(ast.parse(text), frozenset(packages))), reverse=True):
        there = lines[line - 1]
        lines[line - 1] = there[:column] + f"{NAMESPACE}.".encode() + there[column:]
    return b"".join(lines).decode()


def _places(tree: ast.Module, packages: frozenset[str]) -> Iterator[tuple[int, int]]:
    """(line, byte in it) of every name that gets longer."""
    nodes = list(ast.walk(tree))
    plain = {
        alias.name
        for node in nodes
        if isinstance(node, ast.Import)
        for alias in node.names
        if alias.asname is None and _top(alias.name) in packages
    }
    named = {id(text) for node in nodes for text in _module_strings(node)}
    for node in nodes:
        match node:
            case ast.ImportFrom(level=0, module=str(module)) if _top(module) in packages:
                yield node.lineno, node.col_offset + len("from ")
            case ast.Import(names=names):
                yield from ((each.lineno, each.col_offset) for each in names if _top(each.name) in packages)
            case ast.Attribute() | ast.Name() if ast.unparse(node) in plain:
                yield node.lineno, node.col_offset
            case ast.Constant(value=str(value)) if (
                _is_entry_point(value, packages)
                or (id(node) in named and "." in value and _top(value) in packages)
                or any(value.startswith(f"{module}.") for module in plain)
            ):
                yield node.lineno, node.col_offset + 1


def _module_strings(node: ast.AST) -> list[ast.expr]:
    """What in a call or in a list can be a module's name."""
    match node:
        case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)) if name in MODULE_ARGUMENTS:
            return node.args
        case ast.List(elts=items) | ast.Tuple(elts=items):
            return [b for a, b in zip(items, items[1:], strict=False) if getattr(a, "value", None) == "-m"]
    return []


def _is_entry_point(value: str, packages: frozenset[str]) -> bool:
    module, colon, name = value.partition(":")
    parts = module.split(".")
    return bool(colon) and parts[0] in packages and all(part.isidentifier() for part in [*parts, name])


def _top(name: str) -> str:
    return name.partition(".")[0]


def _moved(packages: Iterable[str]) -> frozenset[str]:
    return frozenset(map(_top, packages)) - {NAMESPACE}


class Namespaced(Distribution):
    """The packages that pyproject.toml lists, under NAMESPACE in all but editable installations."""

    entry_points: dict[str, list[str]] | None
    moved: frozenset[str] = frozenset()
    """Top-level packages of the repository that move."""

    def parse_config_files(self, *args, **kwargs) -> None:
        """Reads pyproject.toml, then gives packages and commands their places."""
        super().parse_config_files(*args, **kwargs)
        if "editable_wheel" in sys.argv:
            return
        listed = self.packages or []
        self.moved = _moved(listed)
        self.package_dir = {f"{NAMESPACE}.{name}": name for name in (*self.moved, *DATA)}
        self.packages = [f"{NAMESPACE}.{name}" if _top(name) in self.moved else name for name in listed]
        self.packages += [f"{NAMESPACE}.{name}" for name in DATA]
        for commands in (self.entry_points or {}).values():
            commands[:] = [re.sub(r"= *(?=(\w+))", self._place, line) for line in commands]

    def _place(self, equals: re.Match) -> str:
        """What stands before the module of an entry point."""
        return f"= {NAMESPACE}." if equals[1] in self.moved else equals[0]


class BuildPy(build_py):
    """Writes the modules with their new names, into a folder without what an earlier build left."""

    distribution: Namespaced

    def run(self) -> None:
        """See `build_py`."""
        if not self.editable_mode:
            shutil.rmtree(self.build_lib, ignore_errors=True)
        super().run()

    def build_module(self, module, module_file, package):
        """See `build_py`."""
        outfile, copied = super().build_module(module, module_file, package)
        if self.distribution.moved:
            text = Path(module_file).read_text(encoding="utf-8")
            Path(outfile).write_text(rehomed(text, self.distribution.moved), encoding="utf-8")
        return outfile, copied


if __name__ == "__main__":
    setup(distclass=Namespaced, cmdclass={"build_py": BuildPy})
