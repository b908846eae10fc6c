"""Imports run one way, and the habits that a linter does not know."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "dexzoo"
FILES = sorted(PACKAGE.rglob("*.py"))
MODULES = sorted({path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in FILES} - {"__init__"})

# Each module may import those of the lines above its own, and none of its own line or below.
LAYERS = [
    {"rotation", "resources", "segmentation"},
    {"grasp", "camera"},
    {"hand_spec", "sensor"},
    {"kinematics", "geometry"},
    {"hand"},
    {"metrics", "sim", "generators"},
    {"models"},
    {"refinement", "verification"},
    {"data"},
    {"planning", "training", "comparison", "plots", "viewer"},
    {"commands"},
    {"cli"},
    {"__main__"},
]
BELOW = {module: set().union(*LAYERS[:i]) for i, layer in enumerate(LAYERS) for module in layer}
BELOW["rotation"] = BELOW["resources"] = set()
# What judges by simulation stays apart from what it judges.
WITHOUT_SIMULATOR = ["models", "generators", "refinement", "planning"]

pytestmark = pytest.mark.skipif(not FILES, reason="the package's source is not beside the tests")


def name(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


@cache
def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def imports(path: Path) -> Iterator[str]:
    """Full names of all that a file imports, wherever in it."""
    for node in ast.walk(parse(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name(path)}:{node.lineno} imports relatively"
            yield str(node.module)
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def modules_imported_by(module: str) -> set[str]:
    """Names of our modules and folders that one of them imports, itself left out."""
    files = [path for path in FILES if path.relative_to(PACKAGE).parts[0].removesuffix(".py") == module]
    found = {full.split(".")[1] for path in files for full in imports(path) if full.startswith("dexzoo.")}
    return found - {module}


def test_each_module_has_a_layer() -> None:
    assert set(MODULES) <= set(BELOW), "give the new module its line in LAYERS"


@pytest.mark.parametrize("module", MODULES)
def test_imports_run_one_way(module: str) -> None:
    imported = modules_imported_by(module)
    assert imported <= set(BELOW), "import a name from the module that defines it, not from the package"
    assert imported <= BELOW[module]


@pytest.mark.parametrize("module", [module for module in WITHOUT_SIMULATOR if module in MODULES])
def test_what_is_judged_never_reaches_the_judge(module: str) -> None:
    reached, new = set(), {module}
    while new:
        reached |= new
        new = set().union(*(modules_imported_by(other) for other in new if other in MODULES)) - reached
    assert "sim" not in reached


def test_only_the_simulator_imports_mujoco() -> None:
    users = {name(path) for path in FILES if any(full.split(".")[0] == "mujoco" for full in imports(path))}
    assert all(user.startswith("sim/") for user in users), users


def test_loading_never_unpickles() -> None:
    for path in FILES:
        modules = {full.split(".")[0] for full in imports(path)}
        assert not modules & {"joblib", "dill", "cloudpickle", "shelve"}, name(path)
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.ImportFrom):
                assert node.module != "pickle", f"{name(path)}:{node.lineno} may unpickle"
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "pickle":
                assert node.attr == "UnpicklingError", f"{name(path)}:{node.lineno} may unpickle"
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "torch.load":
                options = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
                assert options.get("weights_only") == "True", f"{name(path)}:{node.lineno} may unpickle"
            if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
                assert ast.unparse(node.value) == "False", f"{name(path)}:{node.lineno} may unpickle"


def test_the_package_does_not_print() -> None:
    for path in FILES:
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "print":
                pytest.fail(f"{name(path)}:{node.lineno} prints")


@pytest.mark.parametrize("path", FILES, ids=name)
def test_files_are_short(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 400


def test_nothing_random_is_drawn_without_a_seed() -> None:
    for path in FILES:
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.Call):
                call = ast.unparse(node.func)
                unseeded = call.endswith("default_rng") and not (node.args or node.keywords)
                assert not unseeded, f"{name(path)}:{node.lineno} draws without a seed"
                assert call not in {"torch.manual_seed", "np.random.seed"}, (
                    f"{name(path)}:{node.lineno} sets a global seed"
                )
