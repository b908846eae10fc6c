"""Where the files that travel with the package lie: robots, configs, checkpoints."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).parent


def resource(name: str) -> Path:
    """The folder `name`: inside an installed package, or beside it in a source tree."""
    inside = _PACKAGE / "resources" / name
    return inside if inside.exists() else _PACKAGE.parent / name
