"""The dependency rule: imports go down the list of packages, and the robot side never imports JAX."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from app.commands import COMMANDS
from app.extras import NEEDS, TELLS, distribution

ROOT = Path(__file__).parents[1]
ORDER = (
    "ddgrasp", "mjx_envs", "learning", "ppo", "demos", "sensors", "rig", "foundation", "ddg_jax",
    "student_jax", "export", "deploy", "evaluation", "app",
)  # fmt: skip
"""A package imports itself and those before it."""
JAX = {"jax", "jaxlib", "flax", "optax", "brax", "orbax", "mujoco.mjx", "mujoco_playground"}
JAX_FREE = (
    "ddgrasp", "deploy", "evaluation", "ddgrasp.policy_metadata", "mjx_envs.scene", "mjx_envs.objects",
    "mjx_envs.object_spec", "mjx_envs.draws",
    "mjx_envs.render.ray_geometry", "mjx_envs.render.raycast_numpy", "mjx_envs.camera", "rig.world",
    "sensors.models.active_stereo", "sensors.models.matching", "sensors.recordings.recording",
    "evaluation.camera_comparison", "sensors.recordings.importers",
    "sensors.recordings.realsense", "sensors.recordings.realsense_live", "app.lerobot",
)  # fmt: skip
"""Packages and modules whose module-level imports must not reach JAX, however indirectly."""


def test_imports_go_down_the_list():
    assert upward_imports(ROOT) == []


def test_no_file_imports_itself_by_way_of_others():
    assert circles(ROOT) == []


def test_module_level_imports_of_the_robot_side_never_reach_jax():
    graph = module_graph(ROOT)
    wrong = {
        name: path for name in sorted(graph) if _under(name, JAX_FREE) and (path := _path_to_jax(name, graph))
    }
    assert wrong == {}


def test_what_the_rules_name_is_there():
    """A name that nothing has would be kept by nothing."""
    named = {*JAX_FREE, *(name for names in INSTALLED_WITH.values() for name in names)}
    assert {name for name in named if not any(_under(module, (name,)) for module in modules(ROOT))} == set()
    assert set(ORDER) == {module.split(".")[0] for module in modules(ROOT)}


def test_deploy_names_jax_nowhere_not_even_inside_functions():
    named = {
        f"{module}: {name}"
        for module, file in modules(ROOT).items()
        if module.split(".")[0] == "deploy"
        for name, _ in imports(file, module)
        if _under(name, JAX)
    }
    assert named == set()


def test_importing_every_deploy_module_loads_no_jax():
    names = [name for name in modules(ROOT) if name.split(".")[0] == "deploy"]
    loaded = "sorted({'jax', 'jaxlib', 'flax'} & set(sys.modules))"
    code = f"import sys\nfor name in {names}: __import__(name)\nprint({loaded})"
    out = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_every_package_with_code_is_installed():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    nested = [
        str(path.parent.relative_to(ROOT)) for name in ORDER for path in (ROOT / name).rglob("__init__.py")
    ]
    assert sorted(listed) == sorted(path.replace("/", ".") for path in nested)


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({"ppo/a.py": "from student_jax import b\n"}, ["ppo.a imports student_jax"]),
        ({"ppo/a.py": "def f():\n    import evaluation.report.html\n"}, ["ppo.a imports evaluation"]),
        ({"ddgrasp/x.py": "import ppo.a\n"}, ["ddgrasp.x imports ppo"]),
        ({"ddgrasp/x.py": "def f():\n    import app.cli\n"}, ["ddgrasp.x imports app"]),
        ({"app/pipeline.py": "def f():\n    import ppo.a\n"}, []),
        ({"student_jax/a.py": "from ddgrasp import errors\nimport mjx_envs.scene\n"}, []),
    ],
)
def test_the_rule_finds_violations(tmp_path, files, expected):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    assert upward_imports(tmp_path) == expected


def test_circles_are_found_inside_functions_too(tmp_path):
    files = {
        "ppo/a.py": "from ppo import b\n",
        "ppo/b.py": "def f():\n    from ppo.c import x\n",
        "ppo/c.py": "import ppo.a\n",
        "ppo/d.py": "import ppo.a\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    assert circles(tmp_path) == [["ppo.a", "ppo.b", "ppo.c"]]


def test_the_jax_rule_finds_an_indirect_import(tmp_path):
    files = {
        "deploy/loop.py": "from sensors import cam\n",
        "sensors/cam.py": "import numpy\nfrom mjx_envs.ray import x\n",
        "mjx_envs/ray.py": "import jax.numpy as jnp\n",
        "mjx_envs/lazy.py": "def f():\n    import jax\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    graph = module_graph(tmp_path)
    assert _path_to_jax("deploy.loop", graph) == ["deploy.loop", "sensors.cam", "mjx_envs.ray", "jax.numpy"]
    assert _path_to_jax("mjx_envs.lazy", graph) is None


# --- the parser ----------------------------------------------------------------------------------


def modules(root: Path) -> dict[str, Path]:
    """Dotted name -> file of every module under the packages of ORDER."""
    found = {}
    for package in ORDER:
        for file in sorted((root / package).rglob("*.py")):
            parts = file.relative_to(root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


def imports(file: Path, module: str) -> Iterator[tuple[str, bool]]:
    """(imported name, whether at module level) of every import; `from a import b` names a.b."""
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]

    def visit(node: ast.AST, top: bool) -> Iterator[tuple[str, bool]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                continue
            if isinstance(child, ast.Import):
                yield from ((alias.name, top) for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                base = child.module or ""
                if child.level:
                    base = ".".join([*package.split(".")[: len(package.split(".")) - child.level + 1], base])
                yield from ((f"{base}.{alias.name}".replace("..", "."), top) for alias in child.names)
            inside = isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
            yield from visit(child, top and not inside)

    yield from visit(ast.parse(file.read_text()), True)


def upward_imports(root: Path) -> list[str]:
    """Every import that breaks the order, inside functions too."""
    wrong = []
    for module, file in modules(root).items():
        package = module.split(".")[0]
        for name, _ in imports(file, module):
            target = name.split(".")[0]
            if target in ORDER and ORDER.index(target) > ORDER.index(package):
                wrong.append(f"{module} imports {target}")
    return wrong


def circles(root: Path) -> list[list[str]]:
    """Groups of modules that import each other, imports inside functions included (Tarjan's components)."""
    files = modules(root)
    graph = {module: _targets(module, file, files) for module, file in files.items()}
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found = []

    def visit(module: str) -> None:
        order[module] = low[module] = len(order)
        stack.append(module)
        for target in graph[module]:
            if target not in order:
                visit(target)
            if target in stack:
                low[module] = min(low[module], low[target])
        if low[module] == order[module]:
            group = stack[stack.index(module) :]
            del stack[stack.index(module) :]
            if len(group) > 1:
                found.append(sorted(group))

    for module in graph:
        if module not in order:
            visit(module)
    return found


def _targets(module: str, file: Path, files: dict[str, Path]) -> set[str]:
    """Project modules that `module` imports anywhere."""
    named = (name if name in files else name.rpartition(".")[0] for name, _ in imports(file, module))
    return {name for name in named if name in files and name != module}


def module_graph(root: Path) -> dict[str, list[str]]:
    """Module -> names it imports at module level; project names are resolved to modules."""
    files = modules(root)
    graph = {}
    for module, file in files.items():
        targets = [parent] if (parent := module.rpartition(".")[0]) in files else []
        for name, top in imports(file, module):
            if not top:
                continue
            resolved = name if name in files else name.rpartition(".")[0]
            targets.append(resolved if resolved in files else name)
        graph[module] = targets
    return graph


def _path_to_jax(module: str, graph: dict[str, list[str]]) -> list[str] | None:
    """Chain of imports from `module` to JAX, None if there is none."""
    seen, queue = {module}, [[module]]
    while queue:
        path = queue.pop(0)
        for name in graph.get(path[-1], []):
            if _under(name, JAX):
                return [*path, name]
            if name in graph and name not in seen:
                seen.add(name)
                queue.append([*path, name])
    return None


def _under(name: str, prefixes) -> bool:
    return any(name == prefix or name.startswith(f"{prefix}.") for prefix in prefixes)


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
INSTALLED_WITH = {
    (): ("app.cli", "app.commands", "deploy.policy", "deploy.loop", "deploy.setup", "ddgrasp"),
    ("franka", "realsense"): (
        "deploy.session", "deploy.calibration", "deploy.devices.franka_robot",
        "deploy.devices.realsense_camera", "deploy.devices.realsense_imager",
        "sensors.recordings.realsense_live", "sensors.recordings.importers",
    ),
    ("sim",): ("evaluation.rig_trials", "deploy.viewers", "deploy.devices", "mjx_envs.objects"),
    ("sim", "franka", "fr3"): ("rig.fr3", "rig.meshes", "deploy.fr3_record", "evaluation.rig_sheet"),
}  # fmt: skip
"""Extras -> modules (and what is in packages of that name) that an installation with them must import."""


@pytest.mark.parametrize("extras", INSTALLED_WITH, ids=",".join)
def test_an_extra_has_all_that_its_modules_import(extras):
    graph = module_graph(ROOT)
    waiting = [name for name in graph if _under(name, INSTALLED_WITH[extras])]
    seen, foreign = set(waiting), {}
    while waiting:
        for name in graph[importer := waiting.pop()]:
            if name not in graph:
                foreign.setdefault(distribution(name), importer)
            elif name not in seen:
                seen.add(name)
                waiting.append(name)
    optional = PROJECT["optional-dependencies"]
    there = {*PROJECT["dependencies"], *(line for extra in extras for line in optional[extra])}
    lacking = foreign.keys() - _names(there) - sys.stdlib_module_names
    assert {name: foreign[name] for name in lacking} == {}


def test_what_tells_that_an_extra_is_there_comes_with_it_and_not_without():
    base, optional = _names(PROJECT["dependencies"]), PROJECT["optional-dependencies"]
    for extra, module in TELLS.items():
        assert distribution(module) in _names(optional[extra]) - base
    assert set(NEEDS) <= set(COMMANDS)
    assert {extra for extras in NEEDS.values() for extra in extras} <= set(TELLS)


def test_what_is_imported_is_declared():
    groups = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    declared = _names(line for group in groups for line in group)
    wanted = {
        distribution(name): file
        for folder in (*ORDER, "benchmarks", "tests", "docs")
        for file in sorted((ROOT / folder).rglob("*.py"))
        for name in _foreign(file)
    }
    assert {name: str(file) for name, file in wanted.items() if name not in declared} == {}
    assert {"ml-dtypes", "rerun-sdk", "pyrealsense2", "mkdocs", "beartype"} <= wanted.keys()


def _names(requirements: Iterable[str]) -> set[str]:
    return {re.split(r"[\[<>=;! ]", line)[0] for line in requirements}


def _foreign(file: Path) -> Iterator[str]:
    """Top-level names of the packages of other people that `file` imports, wherever it does."""
    for node in ast.walk(ast.parse(file.read_text())):
        match node:
            case ast.Import():
                names = [alias.name for alias in node.names]
            case ast.ImportFrom(module=str(module), level=0):
                names = [module]
            case ast.Call(
                func=ast.Name(id="import_module") | ast.Attribute(attr="import_module" | "importorskip"),
                args=[ast.Constant(value=str(module)), *_],
            ):
                names = [module]
            case _:
                continue
        for name in {name.split(".")[0] for name in names}:
            ours = (ROOT / name).is_dir() or (ROOT / "tests" / f"{name}.py").is_file()
            if name not in sys.stdlib_module_names and not ours:
                yield name
