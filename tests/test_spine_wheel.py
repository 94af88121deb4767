"""The wheel: one name on the import path, everything in it, and nothing of the repository needed."""

import dataclasses
import email
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from types import ModuleType

import pytest

from app.extras import distribution
from ddgrasp.config import Config

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGES = PROJECT["tool"]["setuptools"]["packages"]
TOPS = sorted({name.split(".")[0] for name in PACKAGES})
BUILD = "from setuptools import build_meta; build_meta.build_wheel('dist')"


def _setup_py() -> ModuleType:
    spec = importlib.util.spec_from_file_location("setup_py", ROOT / "setup.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SETUP = _setup_py()
MOVED = set(TOPS) - {SETUP.NAMESPACE}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built from a copy without git, as from an archive of the sources: nothing is left in the repository."""
    copy = tmp_path_factory.mktemp("sources")
    for folder in (*TOPS, *SETUP.DATA):
        shutil.copytree(ROOT / folder, copy / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("setup.py", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, copy)
    (copy / "dist").mkdir()
    subprocess.run([sys.executable, "-c", BUILD], cwd=copy, check=True, capture_output=True, timeout=300)
    (built,) = (copy / "dist").glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    """A folder with what pip would put into site-packages."""
    folder = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def run(installed: Path, folder: Path, code: str) -> str:
    """What `code` prints in `folder` with the wheel and the libraries on the path, the repository not."""
    libraries = [path for path in sys.path if path and Path(path) not in (ROOT, ROOT / "tests")]
    start = f"import sys; sys.path = {[str(installed), *libraries]!r}\n"
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", start + code],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        env={name: value for name, value in os.environ.items() if name != "VIRTUAL_ENV"},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_wheel_has_one_top_level_name(wheel, installed):
    (about,) = installed.glob("*.dist-info")
    assert {path.name for path in installed.iterdir()} == {"ddgrasp", about.name}
    assert (about / "top_level.txt").read_text().split() == ["ddgrasp"]
    assert "ddgrasp = ddgrasp.app.cli:main" in (about / "entry_points.txt").read_text()
    assert wheel.stat().st_size < 20e6


def test_a_wheel_has_every_module_and_file(installed):
    def there(folder: Path) -> set[str]:
        found = (
            path
            for kind in ("py", "json", "npz", "xml", "msgpack", "onnx")
            for path in folder.rglob(f"*.{kind}")
        )
        return {str(path.relative_to(folder)) for path in found}

    expected = {f"{name}/{file}" for name in (*MOVED, *SETUP.DATA) for file in there(ROOT / name)}
    kept_in_clones = ("d435/", "table2/")
    left_out = {
        f"pretrained/{file}" for file in there(ROOT / "pretrained") if file.startswith(kept_in_clones)
    }
    for folder in kept_in_clones:  # else nothing would be compared below
        assert any(file.startswith(f"pretrained/{folder}") for file in left_out)
    assert there(installed / "ddgrasp") == (expected | there(ROOT / "ddgrasp")) - left_out


def test_without_git_the_version_is_the_one_in_pyproject(wheel, installed):
    (about,) = installed.glob("*.dist-info")
    metadata = email.message_from_string((about / "METADATA").read_text())
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    fallback = PROJECT["tool"]["setuptools_scm"]["fallback_version"]
    assert cited is not None and metadata["Version"] == fallback == cited[1]


IMPORT_ALL = """
import importlib, pathlib
folder = pathlib.Path(sys.path[0])
files = (file.relative_to(folder).with_suffix("") for file in (folder / "ddgrasp").rglob("*.py"))
names = [".".join(file.parts) for file in files]
for name in sorted(name.removesuffix(".__init__") for name in names):
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        print("ABSENT", name, error.name)
ours = {name: module for name, module in sys.modules.items() if name.split(".")[0] in TOPS}
elsewhere = {name for name, module in ours.items() if not str(module.__file__).startswith(str(folder))}
print("MODULES", len(ours), "ELSEWHERE", sorted(elsewhere))
from ddgrasp.stages import ON_REQUEST, STAGES
for stage in (*STAGES, *ON_REQUEST):
    assert callable(importlib.import_module(stage.module).run), stage
from ddgrasp.app.commands import parse
from ddgrasp.app.commands.checks import check_config_values
for preset in ("debug", "demo"):
    check_config_values(parse("run", ["--preset", preset]).config)
print(parse("ddg distil", ["--model", "pretrained/ddg", "--data", "d", "--out", "o"]).model)
"""


def test_every_module_of_a_wheel_is_imported_without_the_repository(installed, tmp_path):
    lines = run(installed, tmp_path, f"TOPS = {TOPS}{IMPORT_ALL}").splitlines()
    extras = PROJECT["project"]["optional-dependencies"].values()
    optional = {re.split(r"[\[<>=;! ]", line)[0] for extra in extras for line in extra}
    absent = [line.split() for line in lines if line.startswith("ABSENT")]
    assert {name for _, _, name in absent if distribution(name) not in optional} == set()
    count = sum(1 for package in TOPS for _ in (ROOT / package).rglob("*.py"))
    modules, model = lines[len(absent) :]
    assert modules.endswith("ELSEWHERE []")
    assert int(modules.split()[1]) >= count - len(absent) > 300
    assert model == str(installed / "ddgrasp" / "pretrained" / "ddg")


LACKING = """
for absent in ("mujoco", "jax", "trimesh", "matplotlib"):
    sys.modules[absent] = None
from ddgrasp.app.cli import main
sys.stderr = sys.stdout
deploy = "deploy --policy pretrained/student/policy.onnx"
for command in ("objects list", "run --preset debug", "rig fr3", "objects sheet", deploy):
    print(main(command.split()))
from ddgrasp.app import extras
print(extras.bringing("matplotlib.figure"), extras.bringing("cv2"), extras.bringing("nowhere"))
"""


def test_what_is_not_installed_is_one_line_with_the_extra(installed, tmp_path):
    assert run(installed, tmp_path, LACKING).splitlines() == [
        "ddgrasp: `ddgrasp objects list` needs more than is installed: pip install 'ddgrasp[sim]'.",
        "2",
        "ddgrasp: `ddgrasp run` needs more than is installed: pip install 'ddgrasp[train]'.",
        "2",
        "ddgrasp: `ddgrasp rig fr3` needs more than is installed: pip install 'ddgrasp[fr3]'.",
        "2",
        "ddgrasp: `ddgrasp objects sheet` needs more than is installed: pip install 'ddgrasp[train]'.",
        "2",
        "ddgrasp: mujoco is not installed: pip install 'ddgrasp[sim]'.",
        "1",
        "['franka', 'train'] ['sim', 'realsense'] []",
    ]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("from export import graph\n", "from ddgrasp.export import graph\n"),
        ("from ddgrasp.export import graph\n", "from ddgrasp.export import graph\n"),
        ("from jax import export\n", "from jax import export\n"),
        ("from .export import graph\n", "from .export import graph\n"),
        ("def f():\n  from ppo.a import (\n    b)\n", "def f():\n  from ddgrasp.ppo.a import (\n    b)\n"),
        ("import rig.a as a, os\n", "import ddgrasp.rig.a as a, os\n"),
        (
            'é = 1; import rig.a\nx: "rig.a.B" = rig.a.C(rig)\n',
            'é = 1; import ddgrasp.rig.a\nx: "ddgrasp.rig.a.B" = ddgrasp.rig.a.C(rig)\n',
        ),
        ('importlib.import_module("app.cli")\n', 'importlib.import_module("ddgrasp.app.cli")\n'),
        ('import_module("numpy.linalg")\n', 'import_module("numpy.linalg")\n'),
        ('Stage("ppo", "ppo.stage", ("demos",))\n', 'Stage("ppo", "ddgrasp.ppo.stage", ("demos",))\n'),
        ('[python, "-m", "rig.fr3.serve", "rig"]\n', '[python, "-m", "ddgrasp.rig.fr3.serve", "rig"]\n'),
        ('register(id, at="mjx_envs.gym.env:Env")\n', 'register(id, at="ddgrasp.mjx_envs.gym.env:Env")\n'),
        ('{"deploy.clock": 1, "a": "rig: no camera"}\n', '{"deploy.clock": 1, "a": "rig: no camera"}\n'),
    ],
)  # fmt: skip
def test_names_of_modules_get_longer_and_nothing_else_changes(text, expected):
    assert SETUP.rehomed(text, MOVED) == expected


def test_no_string_that_names_a_module_is_left_behind():
    files = {
        file: file.relative_to(ROOT).with_suffix("") for top in TOPS for file in (ROOT / top).rglob("*.py")
    }
    modules = {".".join(path.parts).removesuffix(".__init__") for path in files.values()}
    dotted = {name for name in modules if "." in name and name.split(".")[0] in MOVED}
    settings = set(_fields(Config))
    left = {
        f"{path}: {name}"
        for file, path in files.items()
        for name in re.findall(r"""(?<![\w`])["']([\w.]+)["']""", SETUP.rehomed(file.read_text(), MOVED))
        if name in dotted - settings
    }
    assert left == set()


def test_only_one_file_knows_where_the_repository_is():
    files = [file for top in TOPS for file in (ROOT / top).rglob("*.py")]
    asking = {str(f.relative_to(ROOT)) for f in files if re.search(r"__file__\).*parent", f.read_text())}
    assert asking == {"ddgrasp/shipped.py"}, "a wheel has other folders: ddgrasp.shipped.PRETRAINED"


def _fields(cls: type, above: str = ""):
    """Names of settings, "deploy.clock"."""
    for field in dataclasses.fields(cls):
        yield above + field.name
        if dataclasses.is_dataclass(field.type) and isinstance(field.type, type):
            yield from _fields(field.type, f"{above}{field.name}.")
