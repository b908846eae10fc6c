"""`python -m dexzoo`."""

import ctypes
import sys

from dexzoo.cli import main

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_LARGEST = 2**31 - 1


def keep_freed_memory() -> None:
    """Have glibc keep what tensors free, instead of giving it back and having it zeroed page by page a step later."""
    setting = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if setting is not None:
        setting(_M_MMAP_THRESHOLD, _LARGEST)
        setting(_M_TRIM_THRESHOLD, _LARGEST)


if __name__ == "__main__":
    keep_freed_memory()
    sys.exit(main())
