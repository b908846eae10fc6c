"""The wheel holds all that the program needs, and one version is told everywhere."""

import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest
import yaml

import dexzoo

ROOT = Path(__file__).parent.parent

pytestmark = pytest.mark.xdist_group("package")  # one worker, so that the wheel is built once


def run(*command: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a command away from the source tree's own modules."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", out, ROOT, cwd=out)
    return next(out.glob("*.whl"))


def test_the_wheel_carries_robots_configs_and_checkpoints(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    for folder, source in (("robots", "robots"), ("configs", "configs"), ("checkpoints", "assets/checkpoints")):
        files = [path for path in (ROOT / source).rglob("*") if path.is_file() and path.suffix not in {".py", ".pyc"}]
        missing = {f"dexzoo/resources/{folder}/{path.relative_to(ROOT / source).as_posix()}" for path in files} - names
        assert not missing
    assert "dexzoo/py.typed" in names
    assert not [name for name in names if name.startswith(("tests/", "dexzoo/resources/")) and name.endswith(".py")]


def test_the_installed_program_runs_from_another_folder(wheel: Path, tmp_path: Path) -> None:
    environment, elsewhere = tmp_path / "venv", tmp_path / "elsewhere"
    elsewhere.mkdir()
    venv.create(environment, symlinks=True)
    python = environment / "bin" / "python"
    install = ("install", "--quiet", "--no-deps", "--no-index", "--no-compile", str(wheel))
    run(sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python, *install, cwd=elsewhere)
    # the dependencies are those of this environment; none is downloaded
    purelib = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=elsewhere).stdout.strip()
    (Path(purelib) / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    place = run(python, "-c", "import dexzoo; print(dexzoo.__file__)", cwd=elsewhere).stdout
    assert Path(place.strip()).is_relative_to(purelib)
    assert "em2" in run(python, "-m", "dexzoo", "models", cwd=elsewhere).stdout


@pytest.mark.slow
def test_the_source_distribution_builds_the_same_wheel(wheel: Path, tmp_path: Path) -> None:
    run(sys.executable, "-m", "build", "--sdist", "--no-isolation", "--outdir", tmp_path, ROOT, cwd=tmp_path)
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as archive:
        archive.extractall(tmp_path, filter="data")
    source = next(path for path in tmp_path.iterdir() if path.is_dir())
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path, source, cwd=tmp_path)
    contents = [
        {i.filename: i.CRC for i in zipfile.ZipFile(path).infolist()} for path in (wheel, next(tmp_path.glob("*.whl")))
    ]
    assert contents[0] == contents[1]


def test_one_version_is_told_everywhere() -> None:
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == dexzoo.__version__
    assert f"## [{dexzoo.__version__}]" in (ROOT / "CHANGELOG.md").read_text()


def test_constraints_pin_torch_and_torchvision_in_step() -> None:
    pins = dict(re.findall(r"^([\w.-]+)==(\S+)$", (ROOT / "constraints.txt").read_text(), re.MULTILINE))
    torch, torchvision = ([int(part) for part in pins[name].split(".")] for name in ("torch", "torchvision"))
    assert torchvision == [torch[0] - 2, torch[1] + 15, torch[2]]  # torchvision 0.15.0 was made for torch 2.0.0
