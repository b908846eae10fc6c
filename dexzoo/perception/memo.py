"""Results that are computed once and kept."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TypeVar

Result = TypeVar("Result")


class Memo:
    """Keeps results by key, for objects that do not change."""

    def __init__(self) -> None:
        self._kept: dict[Hashable, object] = {}

    def once(self, key: Hashable, make: Callable[[], Result]) -> Result:
        """The result of `make`, computed at the first call with this key.

        Args:
            key: Name of the result, with all that it depends on besides the object itself.
            make: Computes it.

        Returns:
            The result; not to be changed in place.
        """
        if key not in self._kept:
            self._kept[key] = make()
        found: Result = self._kept[key]  # type: ignore[assignment]  # one key names results of one type
        return found
