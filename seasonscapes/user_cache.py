"""The user's cache folder: what can be made again at any time."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def user_cache_folder() -> Path:
    """Return the program's folder among the caches of the user, by the custom of the platform; it need not exist.

    Raises
    ------
    RuntimeError
        Where the user has no home folder.

    Examples
    --------
    >>> from seasonscapes.user_cache import user_cache_folder
    >>> user_cache_folder().name
    'seasonscapes'
    """
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "seasonscapes"
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or Path.home() / ".cache"
    return Path(base) / "seasonscapes"
