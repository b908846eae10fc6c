"""Imports run one way, and the habits that a linter does not know."""

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "dexzoo"
FILES = sorted(PACKAGE.rglob("*.py"))
ROOMS = sorted({path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in FILES} - {"__init__"})
"""Folders of the package, and the files beside them."""

# Each room may import those of the lines above its own, and none of its own line or below.
LAYERS = [
    {"rotation", "resources", "metrics"},
    {"hand", "perception"},
    {"grasp"},
    {"generators", "models", "sim", "viewing"},
    {"refinement", "verification", "data"},
    {"planning", "collection", "comparison"},
    {"training"},
    {"cli"},
    {"__main__"},
]
BELOW = {room: set().union(*LAYERS[:i]) for i, layer in enumerate(LAYERS) for room in layer}
# The simulator judges; these stay apart from the judge.
WITHOUT_SIMULATOR = ["perception", "hand", "generators", "models", "refinement", "planning", "data"]
MAX_FILES_AT_TOP = 8

pytestmark = pytest.mark.skipif(not FILES, reason="the package's source is not beside the tests")


def name(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


@cache
def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """All nodes of a file but those that only a type checker reads."""
    for node in ast.iter_child_nodes(tree):
        if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
            yield node
            yield from nodes(node)


def imports(path: Path) -> Iterator[str]:
    """Full names of all that a file imports when it runs, wherever in it."""
    for node in nodes(parse(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name(path)}:{node.lineno} imports relatively"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def rooms_imported_by(room: str) -> set[str]:
    """Names of our rooms that one of them imports, itself left out."""
    files = [path for path in FILES if path.relative_to(PACKAGE).parts[0].removesuffix(".py") == room]
    ours = (full.split(".") for path in files for full in imports(path))
    return {parts[1] if parts[1:] else "dexzoo" for parts in ours if parts[0] == "dexzoo"} - {room}


def test_each_room_has_a_layer() -> None:
    assert set(ROOMS) == set(BELOW), "give the new room its line in LAYERS"


@pytest.mark.parametrize("room", ROOMS)
def test_imports_run_one_way(room: str) -> None:
    imported = rooms_imported_by(room)
    assert imported <= set(BELOW), "import a name from the module that defines it, not from the package"
    assert imported <= BELOW[room]


def test_no_files_import_each_other() -> None:
    modules = {".".join(("dexzoo", *path.relative_to(PACKAGE).with_suffix("").parts)): path for path in FILES}
    modules = {module.removesuffix(".__init__"): path for module, path in modules.items()}

    def module_of(full: str) -> str:
        return full if full in modules else full.rpartition(".")[0]

    graph = {
        module: {module_of(full) for full in imports(path) if full.startswith("dexzoo.")}
        for module, path in modules.items()
    }
    assert set().union(*graph.values()) <= set(graph)
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle


@pytest.mark.parametrize("room", WITHOUT_SIMULATOR)
def test_what_is_judged_never_reaches_the_judge(room: str) -> None:
    reached, new = set(), {room}
    while new:
        reached |= new
        new = set().union(*map(rooms_imported_by, new)) - reached
    assert "sim" not in reached


def test_only_the_simulator_imports_mujoco() -> None:
    users = {name(path) for path in FILES if any(full.split(".")[0] == "mujoco" for full in imports(path))}
    assert users
    assert all(user.startswith("sim/") for user in users), users


def test_few_files_stand_at_the_top() -> None:
    assert len(list(PACKAGE.glob("*.py"))) <= MAX_FILES_AT_TOP, "give the new file a room"


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
