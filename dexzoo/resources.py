"""Folders of the files that come with the package, and of those that it keeps for a user."""

from __future__ import annotations

import os
from pathlib import Path

_PACKAGE = Path(__file__).parent


def resource(name: str) -> Path:
    """A folder of data: inside an installed package, or in a source tree beside the package or in its assets.

    Args:
        name: robots, configs, checkpoints, or a path such as assets/grasps.
    """
    inside = _PACKAGE / "resources" / name
    if inside.exists():
        return inside
    beside = _PACKAGE.parent / name
    asset = _PACKAGE.parent / "assets" / name
    return asset if asset.exists() and not beside.exists() else beside


def user_cache() -> Path:
    """Folder of files that can be made again: $XDG_CACHE_HOME/dexzoo, or ~/.cache/dexzoo."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dexzoo"
